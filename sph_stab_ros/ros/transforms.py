# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""
The stabilised frame and the virtual cameras as transforms, from the camera down.

No frame of the robot's tree gets another parent: the stabilised frame is a child of the image's
frame, wherever that hangs, and the virtual cameras are children of the stabilised frame. tf2_msgs
comes with a ROS installation only.
"""

from geometry_msgs.msg import Quaternion, Transform, TransformStamped
from sph_stab_ros.ros.image_topics import advertise, is_wanted
from std_msgs.msg import Header

try:
    from tf2_msgs.msg import TFMessage
except ImportError:
    TFMessage = None


class TransformPublisher:
    """Publishes on /tf how the camera, the stabilised frame and its leaves are turned."""

    def __init__(self, node, stabilized_frame):
        self._stabilized_frame = stabilized_frame
        self._log = node.get_logger()
        self._publisher = None
        if TFMessage is None:
            self._log.info('no transforms on /tf: tf2_msgs is not installed')
        else:
            self._publisher = advertise(node, TFMessage, '/tf', depth=100)

    @property
    def wanted(self):
        """Whether anybody subscribes to /tf."""
        return self._publisher is not None and is_wanted(self._publisher)

    def publish(self, header, R_world_camera, leaves):
        """Publish under the image's Header; ``leaves`` maps frames to their ``R_world_leaf``."""
        if header.frame_id in ('', self._stabilized_frame, *leaves):
            self._log.warning(
                f"no transforms on /tf: the images have the frame_id '{header.frame_id}'",
                once=True)
            return
        self._publisher.publish(TFMessage(transforms=camera_transforms(
            header, R_world_camera, self._stabilized_frame, leaves)))


def camera_transforms(header, R_world_camera, stabilized_frame, leaves):
    """
    Return the TransformStamped from camera to stabilised frame, and from there to each leaf.

    ``header`` is the image's; ``leaves`` maps frames to their orientations ``R_world_leaf``. A
    transform holds the rotation that maps the child's coordinates into the parent's.
    """
    world = Header(stamp=header.stamp, frame_id=stabilized_frame)
    return [_transform(header, stabilized_frame, R_world_camera.inv()),
            *(_transform(world, frame, R_world_leaf) for frame, R_world_leaf in leaves.items())]


def _transform(header, child_frame, R_parent_child):
    x, y, z, w = R_parent_child.as_quat().tolist()
    return TransformStamped(
        header=header, child_frame_id=child_frame,
        transform=Transform(rotation=Quaternion(x=x, y=y, z=z, w=w)))
