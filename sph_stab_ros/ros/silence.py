# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Why there are no images, by what the middleware knows of who publishes what."""

from collections.abc import Iterator
from time import monotonic

from rclpy.node import Node
from rclpy.qos import qos_check_compatible, QoSCompatibility
from rclpy.subscription import Subscription
from rclpy.topic_endpoint_info import TopicEndpointInfo
from sph_stab_ros.ros.topics import TRANSPORTS

# Cameras take their time, and so does discovery.
PATIENCE_S = 3.
# Of the topics that images may be on instead.
MAX_LISTED = 5


class SilenceWatch:
    """
    Says why nothing comes once that has lasted: in the log, and to who asks.

    Parameters
    ----------
    node : rclpy.node.Node
    images : rclpy.subscription.Subscription
        To the images.
    transport : str
        Theirs, one of the TRANSPORTS.

    """

    def __init__(self, node: Node, images: Subscription, transport: str) -> None:
        self._node = node
        self._images = images
        self._transport = transport
        self._said = ''
        self.end()

    def end(self) -> None:
        """Hear an image."""
        self._since_s = monotonic()

    def reason(self) -> str:
        """Return why there have been no images for a while, '' where there have been some."""
        if monotonic() - self._since_s < PATIENCE_S:
            self._said = ''
            return ''
        reason = self._reason()
        if reason != self._said:
            self._node.get_logger().warning(f'no images: {reason}')
        self._said = reason
        return reason

    def _reason(self) -> str:
        topic = self._images.topic_name
        ending, wanted = TRANSPORTS[self._transport]
        others = [one for one in self._publishers(topic) if one.topic_type != wanted]
        right = [one for one in self._publishers(topic) if one.topic_type == wanted]
        if right:
            return self._reason_of_silent(right, topic)
        if others:
            return (f'{topic} has a publisher of {others[0].topic_type}; image_transport is '
                    f'{self._transport}, which is {wanted}')
        for other_ending, other_type in TRANSPORTS.values():
            other = topic.removesuffix(ending) + other_ending
            if other_type in [one.topic_type for one in self._publishers(other)]:
                return f'{other} has a publisher; image_transport is {self._transport}'
        image_types = {msgtype for _, msgtype in TRANSPORTS.values()}
        elsewhere = sorted(
            name for name, types in self._node.get_topic_names_and_types()
            if image_types & {*types} and any(self._publishers(name)))
        return f'nobody publishes {topic}' + (
            f'; images are on {", ".join(elsewhere[:MAX_LISTED])}' if elsewhere else '')

    def _reason_of_silent(self, publishers: list[TopicEndpointInfo], topic: str) -> str:
        """Return why nothing comes from publishers of the right type."""
        for one in publishers:
            fits, why = qos_check_compatible(one.qos_profile, self._images.qos_profile)
            if fits != QoSCompatibility.ERROR:
                return f'{topic} has a publisher, but nothing comes'
        why = why.removeprefix('ERROR: ').strip(' ;').lower()
        return f'{topic} has a publisher of another quality of service: {why}'

    def _publishers(self, topic: str) -> Iterator[TopicEndpointInfo]:
        """Yield the publishers of a topic but for the node's own."""
        own = self._node.get_name(), self._node.get_namespace()
        for one in self._node.get_publishers_info_by_topic(topic):
            if (one.node_name, one.node_namespace) != own:
                yield one
