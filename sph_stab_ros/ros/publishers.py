# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The publishers of the node: as much of each stabilised frame as somebody subscribes to."""

from collections.abc import Iterable

from rclpy.node import Node
from rclpy.publisher import Publisher
from sph_stab_ros.config import Settings
from sph_stab_ros.recording.messages import COMPRESSED_IMAGE, IMAGE, TRANSFORMS
from sph_stab_ros.ros.cpu_meter import CpuMeter
from sph_stab_ros.ros.diagnostics import ThrottledLog
from sph_stab_ros.ros.messages import make, message_type
from sph_stab_ros.ros.topics import advertise, compressed_topic, is_wanted
from sph_stab_ros.ros.views import View
from sph_stab_ros.stabilization.outputs import (
    COMPRESSED, fits_into_tree, orientation_outputs, Output, picture_outputs, topics,
    TRANSFORMS_TOPIC)
from sph_stab_ros.stabilization.stabilized_frame import StabilizedFrame

# Orientations are small, and who records them wants them all.
DEPTHS = {'orientation': 10, 'orientation_covariance': 10, 'virtual_orientation': 10,
          TRANSFORMS_TOPIC: 100}


class Outputs:
    """
    The publishers and views of the node; everything has the stamp of the image.

    Parameters
    ----------
    node : rclpy.node.Node
    settings : Settings
    log : ThrottledLog
        Told of messages to the views that make no sense.
    cpu : CpuMeter
        Counts the stages 'warp' and 'publish'.

    """

    def __init__(self, node: Node, settings: Settings, log: ThrottledLog, cpu: CpuMeter) -> None:
        self._config = settings.config
        self._cpu = cpu
        self._log = node.get_logger()
        self._publishers: dict[str, Publisher] = {}
        self._picture_publishers: list[Publisher] = []
        for topic, type_name in topics(settings.views).items():
            try:
                msg_type = message_type(type_name)
            except ImportError:
                # It comes with a ROS installation only.
                if type_name != TRANSFORMS:
                    raise
                self._log.info('no transforms on /tf: tf2_msgs is not installed')
                continue
            name = topic
            if type_name == COMPRESSED_IMAGE:
                name = compressed_topic(node, topic.removesuffix(COMPRESSED))
            publisher = advertise(node, msg_type, name, DEPTHS.get(topic, 5))
            self._publishers[topic] = publisher
            if type_name in (IMAGE, COMPRESSED_IMAGE):
                self._picture_publishers.append(publisher)
        self._views = [View(node, name, settings, log) for name in settings.views]

    def reconfigure(self, settings: Settings, names: set[str]) -> None:
        """Take on Settings of which the parameters ``names`` were set just now."""
        self._config = settings.config
        for view in self._views:
            view.reconfigure(settings, names)

    def look_home(self) -> None:
        """Let all views look at the stabilised frame's front."""
        for view in self._views:
            view.look_home()

    @property
    def pictures_wanted(self) -> bool:
        """Tell whether anybody subscribes to pictures."""
        return any(map(is_wanted, self._picture_publishers))

    def publish_orientation(self, stabilized: StabilizedFrame) -> list[Output]:
        """
        Publish where the camera of a StabilizedFrame looks.

        Return what is to be published of its pictures, along where the views look now.
        """
        config, cameras = self._config, [view.camera() for view in self._views]
        self.publish(orientation_outputs(stabilized, config, cameras))
        frame_id = stabilized.frame.frame_id
        if config.publish_tf and self._is_wanted(TRANSFORMS_TOPIC) and not fits_into_tree(
                frame_id, config, cameras):
            self._log.warning(f"no transforms on /tf: the images have the frame_id '{frame_id}'",
                              once=True)
        return list(picture_outputs(stabilized, config, cameras))

    def publish(self, outputs: Iterable[Output]) -> None:
        """Publish those Outputs that somebody subscribes to."""
        for output in outputs:
            if not self._is_wanted(output.topic):
                continue
            if output.draw:
                with self._cpu.stage('warp'):
                    output.draw()
            with self._cpu.stage('publish'):
                self._publishers[output.topic].publish(output.message(make))

    def _is_wanted(self, topic: str) -> bool:
        return topic in self._publishers and is_wanted(self._publishers[topic])
