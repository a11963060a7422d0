# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The IMU's messages on the way to the stabiliser."""

from collections.abc import Callable

from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.subscription import Subscription
from sensor_msgs.msg import Imu
from sph_stab_ros.ros.diagnostics import Diagnostics
from sph_stab_ros.ros.image_topics import subscribe
from sph_stab_ros.stabilization.imu import imu_sample, ImuError, ImuSample

# What comes while the executor is busy otherwise.
DEPTH = 100


class ImuInput:
    """
    Subscribes to ``imu`` (sensor_msgs/Imu) while it is listened to, as sensor data.

    Parameters
    ----------
    node : rclpy.node.Node
    take : callable
        Takes each ImuSample.
    diagnostics : Diagnostics
        Counts the samples, and those that are none.

    """

    def __init__(self, node: Node, take: Callable[[ImuSample], None],
                 diagnostics: Diagnostics) -> None:
        self._node = node
        self._take = take
        self._diagnostics = diagnostics
        self._subscription: Subscription | None = None
        self._listening = False
        # For a moment: what users say of its quality of service is checked at the start, whether
        # it is listened to by then or later.
        node.destroy_subscription(self._subscribed())

    def listen(self, wanted: bool) -> None:
        """Listen from now on, or do not."""
        if wanted == self._listening:
            return
        self._listening = self._diagnostics.listens_to_imu = wanted
        if wanted:
            self._subscription = self._subscribed()
        elif self._subscription:
            self._node.destroy_subscription(self._subscription)

    def _subscribed(self) -> Subscription:
        return subscribe(
            self._node, Imu, 'imu', self._on_imu,
            QoSProfile(depth=DEPTH, reliability=ReliabilityPolicy.BEST_EFFORT))

    def _on_imu(self, msg: Imu) -> None:
        try:
            sample = imu_sample(msg, self._node.get_clock().now().nanoseconds)
        except ImuError as error:
            self._diagnostics.refuse_imu(error)
        else:
            self._diagnostics.count_imu()
            self._take(sample)
