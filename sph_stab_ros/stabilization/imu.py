# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Samples of an inertial measurement unit, and the rotation that its gyro measured."""

from bisect import bisect_right
from collections import deque
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from sph_stab_ros.geometry.arrays import Stamps, Vector, Vectors
from sph_stab_ros.geometry.conventions import NS_PER_S, R_CAMERA_BODY

# Over a longer silence of the gyro nothing is known.
MAX_GAP_NS = NS_PER_S // 10
# Stamps that go back further are those of a new start; others are late and left out.
NEW_START_NS = NS_PER_S // 10
HISTORY_NS = 2 * NS_PER_S
# In the first element of a message's covariance, as REP 145 has it.
NOT_MEASURED = -1.


class ImuError(ValueError):
    """A sample that cannot be used, with the reason in one line for the user."""


@dataclass(frozen=True)
class ImuSample:
    """
    A sample in the IMU's frame; ImuError where it is none.

    ``specific_force_m_s2`` (3,) is what an accelerometer shows, 9.8 m/s² upwards at rest;
    ``angular_velocity_rad_s`` (3,). Either is None where the IMU does not measure it.
    """

    stamp_ns: int
    specific_force_m_s2: Vector | None = None
    angular_velocity_rad_s: Vector | None = None

    def __post_init__(self) -> None:
        """Make arrays of what is given, and check them."""
        for name, title in (('specific_force_m_s2', 'specific force'),
                            ('angular_velocity_rad_s', 'angular velocity')):
            value = getattr(self, name)
            if value is None:
                continue
            value = np.array(value, float)
            if value.shape != (3,) or not np.isfinite(value).all():
                raise ImuError(f'the {title} is {value.tolist()}, not three finite numbers')
            object.__setattr__(self, name, value)
        # What drivers send that do not measure it.
        if self.specific_force_m_s2 is not None and not self.specific_force_m_s2.any():
            raise ImuError('the specific force is zero')


def imu_sample(msg: Any, received_ns: int) -> ImuSample:
    """
    Return the ImuSample of a sensor_msgs Imu, of rclpy's or of a bag's; ImuError where it is none.

    One without a stamp is of when it was received.
    """
    force, rate = msg.linear_acceleration, msg.angular_velocity
    if msg.linear_acceleration_covariance[0] == NOT_MEASURED:
        force = None
    if msg.angular_velocity_covariance[0] == NOT_MEASURED:
        rate = None
    if force is rate is None:
        raise ImuError('by its covariances it measures neither force nor angular velocity')
    stamp_ns = msg.header.stamp.sec * NS_PER_S + msg.header.stamp.nanosec
    return ImuSample(stamp_ns or received_ns, _xyz(force), _xyz(rate))


def _xyz(vector: Any) -> Vector | None:
    return None if vector is None else np.array((vector.x, vector.y, vector.z), float)


def mount_rotation(roll_rad: float, pitch_rad: float, yaw_rad: float) -> Rotation:
    """
    Return ``R_camera_imu`` from roll, pitch and yaw as a URDF states them.

    They turn the IMU, in this order, about the fixed axes x forward, y left and z up of the body
    at the camera; at zero the IMU's axes are these.
    """
    return R_CAMERA_BODY * Rotation.from_euler('xyz', (roll_rad, pitch_rad, yaw_rad))


class ImuHistory:
    """The last two seconds of an IMU, in the camera's axes."""

    def __init__(self) -> None:
        # (stamp_ns, specific force)
        self._forces: deque[tuple[int, Vector]] = deque()
        # (stamp_ns, angular velocity, R_reckoned_camera: the turns so far)
        self._turns: deque[tuple[int, Vector, Rotation]] = deque()

    def clear(self) -> None:
        """Forget everything: the IMU sits otherwise from now on, or its clock was set back."""
        self._forces.clear()
        self._turns.clear()

    def add(self, sample: ImuSample, R_camera_imu: Rotation) -> None:
        """Take in an ImuSample; one that comes late is left out."""
        stamp_ns = sample.stamp_ns
        if sample.specific_force_m_s2 is not None and _is_next(self._forces, stamp_ns):
            self._forces.append((stamp_ns, R_camera_imu.apply(sample.specific_force_m_s2)))
        if sample.angular_velocity_rad_s is not None and _is_next(self._turns, stamp_ns):
            self._add_turn(stamp_ns, R_camera_imu.apply(sample.angular_velocity_rad_s))

    def forces(self, after_ns: int, until_ns: int) -> tuple[Stamps, Vectors]:
        """Return stamps (N,) in (after, until] and specific force (N, 3) in m/s² at each."""
        chosen = [one for one in self._forces if after_ns < one[0] <= until_ns]
        return (np.array([stamp_ns for stamp_ns, _ in chosen], np.int64),
                np.array([force for _, force in chosen]).reshape(-1, 3))

    def gyro_rotation(self, from_ns: int, to_ns: int) -> Rotation | None:
        """Return the camera's turn ``R_from_to``, or None where the gyro does not cover it."""
        if not self._turns or not (
                self._turns[0][0] <= min(from_ns, to_ns)
                and max(from_ns, to_ns) <= self._turns[-1][0] + MAX_GAP_NS):
            return None
        return self._reckoned(from_ns).inv() * self._reckoned(to_ns)

    def _add_turn(self, stamp_ns: int, rate_rad_s: Vector) -> None:
        if self._turns and stamp_ns - self._turns[-1][0] > MAX_GAP_NS:
            self._turns.clear()
        R_reckoned_camera = Rotation.identity()
        if self._turns:
            last_ns, last_rad_s, R_reckoned_last = self._turns[-1]
            R_reckoned_camera = R_reckoned_last * _turn((last_rad_s + rate_rad_s) / 2,
                                                        stamp_ns - last_ns)
        self._turns.append((stamp_ns, rate_rad_s, R_reckoned_camera))

    def _reckoned(self, stamp_ns: int) -> Rotation:
        """Return R_reckoned_camera at a time; beyond the last sample its rate goes on."""
        i = bisect_right(self._turns, stamp_ns, key=lambda one: one[0]) - 1
        (before_ns, rate_rad_s, R_reckoned_before) = self._turns[i]
        next_rad_s = self._turns[min(i + 1, len(self._turns) - 1)][1]
        return R_reckoned_before * _turn((rate_rad_s + next_rad_s) / 2, stamp_ns - before_ns)


def _is_next(samples: deque[Any], stamp_ns: int) -> bool:
    """Make room for a sample, and tell whether it is not late."""
    if samples and stamp_ns < samples[-1][0] - NEW_START_NS:
        samples.clear()
    while samples and samples[0][0] < stamp_ns - HISTORY_NS:
        samples.popleft()
    return not samples or stamp_ns > samples[-1][0]


def _turn(rate_rad_s: Vector, elapsed_ns: int) -> Rotation:
    return Rotation.from_rotvec(rate_rad_s * (elapsed_ns / NS_PER_S))
