# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""
The IMU's messages on the way to the stabiliser, many at a time.

An executor's turn for each message costs 0.27 ms of CPU and more, more than a quarter of a core at
1 kHz, all of it with the interpreter held. So the executor is not told of them: the middleware
keeps them until the next picture, or the next heartbeat, wants them, in the form in which they
travel.
"""

from collections.abc import Callable
from struct import unpack_from
from threading import Lock
from time import time_ns
from typing import Any

import numpy as np
from rclpy.callback_groups import CallbackGroup
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.subscription import Subscription
from sensor_msgs.msg import Imu
from sph_stab_ros.geometry.arrays import Values
from sph_stab_ros.geometry.conventions import NS_PER_S
from sph_stab_ros.ros.diagnostics import Diagnostics
from sph_stab_ros.ros.topics import subscribe
from sph_stab_ros.stabilization.imu import ImuError, ImuSamples, NOT_MEASURED

# Two seconds of a fast one: longer than between two heartbeats.
DEPTH = 2000
# A serialized Imu (CDR): 4 bytes that tell the order of bytes, stamp, frame_id, and from the next
# multiple of 8 on 37 numbers, of which these are used.
HEADER_BYTES = 4
NUMBERS = 37
RATE, RATE_COVARIANCE = slice(13, 16), 16
FORCE, FORCE_COVARIANCE = slice(25, 28), 28


class ImuInput:
    """
    Subscribes to ``imu`` (sensor_msgs/Imu) while it is listened to, as sensor data.

    Parameters
    ----------
    node : rclpy.node.Node
    take : callable
        Takes ImuSamples.
    diagnostics : Diagnostics
        Counts the samples, and those that are none.

    """

    def __init__(self, node: Node, take: Callable[[ImuSamples], None],
                 diagnostics: Diagnostics) -> None:
        self._node = node
        self._take = take
        self._diagnostics = diagnostics
        self._lock = Lock()
        self._nobodys_turn = NobodysTurn()
        self._subscription: Subscription | None = None
        # For a moment: what users say of its quality of service is checked at the start, whether
        # it is listened to by then or later.
        node.destroy_subscription(self._subscribed())

    def listen(self, wanted: bool) -> None:
        """Listen from now on, or do not."""
        with self._lock:
            self._diagnostics.listens_to_imu = wanted
            if wanted and not self._subscription:
                self._subscription = self._subscribed()
            elif self._subscription and not wanted:
                self._node.destroy_subscription(self._subscription)
                self._subscription = None

    def collect(self) -> None:
        """Take in what has come since the last time; may be called from any thread."""
        with self._lock:
            messages = list(self._received())
            if not messages:
                return
            samples, errors = _samples(messages)
            for error in errors:
                self._diagnostics.refuse_imu(error)
            self._diagnostics.count_imu(len(samples.stamps_ns))
            self._take(samples)

    def _subscribed(self) -> Subscription:
        return subscribe(
            self._node, Imu, 'imu', lambda msg: None,
            QoSProfile(depth=DEPTH, reliability=ReliabilityPolicy.BEST_EFFORT),
            raw=True, callback_group=self._nobodys_turn)

    def _received(self) -> Any:
        """Yield serialized messages, and when each was received by the node's clock."""
        if not self._subscription:
            return
        # Nothing but the difference between the clocks where time is simulated.
        ahead_ns = self._node.get_clock().now().nanoseconds - time_ns()
        handle = self._subscription.handle
        with handle:
            while taken := handle.take_message(Imu, True):
                message, info = taken
                yield message, info['received_timestamp'] + ahead_ns


class NobodysTurn(CallbackGroup):
    """A group of subscriptions that no executor waits for."""

    def can_execute(self, entity: Any) -> bool:
        """Say no."""
        return False

    def beginning_execution(self, entity: Any) -> bool:
        """Say no."""
        return False

    def ending_execution(self, entity: Any) -> None:
        """Do nothing."""


def _samples(messages: list[tuple[bytes, int]]) -> tuple[ImuSamples, list[ImuError]]:
    """Return the usable samples of serialized Imus with their times of receipt, as ``usable``."""
    stamps_ns = np.empty(len(messages), np.int64)
    numbers = np.empty((len(messages), NUMBERS))
    for i, (message, received_ns) in enumerate(messages):
        stamp_ns, numbers[i] = deserialized(message)
        stamps_ns[i] = stamp_ns or received_ns
    return ImuSamples.usable(
        stamps_ns, numbers[:, FORCE], numbers[:, RATE],
        numbers[:, FORCE_COVARIANCE] != NOT_MEASURED, numbers[:, RATE_COVARIANCE] != NOT_MEASURED)


def deserialized(message: bytes) -> tuple[int, Values]:
    """Return the stamp in nanoseconds and the numbers (37,) of a serialized Imu."""
    order = '<' if message[1] & 1 else '>'
    sec, nanosec, frame_id_bytes = unpack_from(f'{order}iII', message, HEADER_BYTES)
    end = 12 + frame_id_bytes
    start = HEADER_BYTES + end + -end % 8
    return sec * NS_PER_S + nanosec, np.frombuffer(message, f'{order}f8', NUMBERS, start)
