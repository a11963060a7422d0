# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Subscribers and whole participants that come and go during the soak test."""

from collections import Counter
from itertools import cycle
from typing import Any

from geometry_msgs.msg import PoseWithCovarianceStamped, QuaternionStamped
import rclpy
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.subscription import Subscription
from sensor_msgs.msg import CameraInfo, CompressedImage, Image

OUTPUTS: dict[str, type[Any]] = {
    'orientation': QuaternionStamped,
    'orientation_covariance': PoseWithCovarianceStamped,
    'stabilized/image': Image,
    'stabilized/image/compressed': CompressedImage,
    'view/image': Image,
    'view/image/compressed': CompressedImage,
    'view/camera_info': CameraInfo}
# So often somebody subscribes, and comes or leaves as a participant of his own.
SUBSCRIBER_PERIOD_S, GUEST_PERIOD_S = 2, 7


class Participant:
    """Somebody in the middleware, with an executor of his own."""

    def __init__(self, name: str, namespace: str) -> None:
        self._context = Context()
        rclpy.init(args=[], context=self._context)
        self.node = rclpy.create_node(name, namespace=namespace, context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)
        self.received: Counter[str] = Counter()

    def subscribe(self, topic: str) -> Subscription:
        """Return a new subscription to one of OUTPUTS; what arrives is counted."""
        return self.node.create_subscription(
            OUTPUTS[topic], topic, lambda msg: self.received.update((topic,)), 5)

    def serve(self, seconds: float) -> None:
        """Take in messages for so long."""
        self._executor.spin_once(timeout_sec=seconds)

    def leave(self) -> None:
        """Leave the middleware."""
        self._executor.shutdown()
        self.node.destroy_node()
        self._context.try_shutdown()


class Comings:
    """Subscribers that come and go: of each output in turn, alone or as a new participant."""

    def __init__(self, host: Participant) -> None:
        self._host = host
        self._topics = cycle(OUTPUTS)
        self._subscriptions: list[Subscription] = []
        self._guest: Participant | None = None

    def turn(self, second: int) -> None:
        """Do what is due in this second."""
        if second % SUBSCRIBER_PERIOD_S == 0:
            self._subscriptions.append(self._host.subscribe(next(self._topics)))
            if len(self._subscriptions) > len(OUTPUTS) // 2:
                self._host.node.destroy_subscription(self._subscriptions.pop(0))
        if second % GUEST_PERIOD_S == 0:
            if self._guest:
                self.close()
            else:
                self._guest = Participant('guest', self._host.node.get_namespace())
                for topic in OUTPUTS:
                    self._guest.subscribe(topic)

    def serve(self) -> None:
        """Let the guest take in a message."""
        if self._guest:
            self._guest.serve(0.)

    def close(self) -> None:
        """Send the guest away."""
        if self._guest:
            self._guest.leave()
            self._guest = None
