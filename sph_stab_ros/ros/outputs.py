# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What the node publishes of each stabilised frame: as much as somebody subscribes to."""

from geometry_msgs.msg import PoseWithCovarianceStamped, QuaternionStamped
import numpy as np
from sph_stab_ros.images.front_marker import mark_sphere
from sph_stab_ros.ros.image_topics import advertise, ImagePublisher, is_wanted
from sph_stab_ros.ros.messages import orientation_message, pose_message
from sph_stab_ros.ros.transforms import TransformPublisher
from sph_stab_ros.ros.views import View
from std_msgs.msg import Header

SAME_FRAME_RAD = 1e-9


class Outputs:
    """
    The publishers of the node; everything has the stamp of the image.

    Parameters
    ----------
    node : rclpy.node.Node
    settings : Settings
    log : ThrottledLog
        Told of messages to the views that make no sense.
    cpu : CpuMeter
        Counts the stages 'warp' and 'publish'.

    """

    def __init__(self, node, settings, log, cpu):
        self._config = settings.config
        self._cpu = cpu
        self._orientation = advertise(node, QuaternionStamped, 'orientation', depth=10)
        self._pose = advertise(
            node, PoseWithCovarianceStamped, 'orientation_covariance', depth=10)
        self._sphere = ImagePublisher(node, 'stabilized/image')
        self._views = [View(node, name, settings, log) for name in settings.views]
        self._transforms = TransformPublisher(node, self._config.stabilized_frame)

    def reconfigure(self, settings, names):
        """Take on Settings of which the parameters ``names`` were set just now."""
        self._config = settings.config
        for view in self._views:
            view.reconfigure(settings, names)

    def look_home(self):
        """Let all views look at the stabilised frame's front."""
        for view in self._views:
            view.look_home()

    @property
    def pictures_wanted(self):
        """Tell whether anybody subscribes to pictures."""
        return self._sphere.wanted or any(view.picture_wanted for view in self._views)

    def publish_orientation(self, stabilized, image_header):
        """
        Publish where the camera of a StabilizedFrame looks, made of an image with a Header.

        Return the present Looks, for the pictures to go with it.
        """
        header = Header(stamp=image_header.stamp, frame_id=self._config.stabilized_frame)
        looks = [view.look() for view in self._views]
        with self._cpu.stage('publish'):
            if is_wanted(self._orientation):
                self._orientation.publish(orientation_message(header, stabilized.R_world_camera))
            if stabilized.covariance is not None and is_wanted(self._pose):
                self._pose.publish(
                    pose_message(header, stabilized.R_world_camera, stabilized.covariance))
            if self._config.publish_tf and self._transforms.wanted:
                self._transforms.publish(
                    image_header, stabilized.R_world_camera, self._leaves(stabilized, looks))
        return looks

    def publish_pictures(self, stabilized, stamp, looks):
        """Publish the stabilised sphere, and the views along the Looks."""
        if self._sphere.wanted:
            with self._cpu.stage('warp'):
                image = stabilized.sphere()
                if self._config.front_marker == 'all':
                    mark_sphere(image, stabilized.R_camera_virtual.inv(),
                                np.deg2rad(self._config.front_yaw_deg))
            with self._cpu.stage('publish'):
                is_virtual = stabilized.R_world_virtual.magnitude() > SAME_FRAME_RAD
                header = Header(stamp=stamp, frame_id=(
                    self._config.virtual_frame if is_virtual else self._config.stabilized_frame))
                self._sphere.publish(header, image, self._config.jpeg_quality)
        for view, look in zip(self._views, looks):
            view.publish(stabilized, stamp, look, self._cpu)

    def _leaves(self, stabilized, looks):
        """Return the frames in the world and their orientations, ``R_world_leaf``."""
        R_world_virtual = stabilized.R_world_virtual
        return {self._config.virtual_frame: R_world_virtual,
                **{view.frame_id: R_world_virtual * look.R_virtual_view
                   for view, look in zip(self._views, looks)}}
