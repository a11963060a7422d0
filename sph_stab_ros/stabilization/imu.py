# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Samples of an inertial measurement unit, one by one and many at a time."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from sph_stab_ros.geometry.arrays import Choice, Stamps, Vector, Vectors
from sph_stab_ros.geometry.conventions import R_CAMERA_BODY, stamp_ns

# No sensor goes further: 200 g, and more than the 4000 degrees/s of the fastest gyros.
MAX_FORCE_M_S2 = 2000.
MAX_RATE_RAD_S = 100.
# In the first element of a message's covariance, as REP 145 has it.
NOT_MEASURED = -1.
NEITHER = 'by its covariances it measures neither force nor angular velocity'


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
        for name, title, largest in (
                ('specific_force_m_s2', 'specific force', MAX_FORCE_M_S2),
                ('angular_velocity_rad_s', 'angular velocity', MAX_RATE_RAD_S)):
            value = getattr(self, name)
            if value is None:
                continue
            value = np.array(value, float)
            if value.shape != (3,) or not np.isfinite(value).all():
                raise ImuError(f'the {title} is {value.tolist()}, not three finite numbers')
            if np.abs(value).max() > largest:
                raise ImuError(f'the {title} is {value.tolist()}, impossible: beyond {largest:g}')
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
        raise ImuError(NEITHER)
    return ImuSample(stamp_ns(msg.header.stamp) or received_ns, _xyz(force), _xyz(rate))


def _xyz(vector: Any) -> Vector | None:
    return None if vector is None else np.array((vector.x, vector.y, vector.z), float)


@dataclass(frozen=True)
class ImuSamples:
    """
    Samples of one IMU as arrays, in its frame and in the order in which they came.

    ``stamps_ns`` (N,), ``forces_m_s2`` and ``rates_rad_s`` (N, 3), of which the rows are NaN that
    the IMU does not measure.
    """

    stamps_ns: Stamps
    forces_m_s2: Vectors
    rates_rad_s: Vectors

    @staticmethod
    def of(samples: Iterable[ImuSample]) -> 'ImuSamples':
        """Return ImuSamples of single ones."""
        samples = list(samples)
        return ImuSamples(
            np.array([one.stamp_ns for one in samples], np.int64),
            _rows([one.specific_force_m_s2 for one in samples]),
            _rows([one.angular_velocity_rad_s for one in samples]))

    @staticmethod
    def usable(stamps_ns: Stamps, forces_m_s2: Vectors, rates_rad_s: Vectors,
               has_force: Choice, has_rate: Choice) -> tuple['ImuSamples', list[ImuError]]:
        """
        Return those of N samples that ImuSample takes, and why it does not take the others.

        They are checked together: one by one a fast IMU would cost a part of a core.
        """
        usable = ((~has_force | _is_plausible(forces_m_s2, MAX_FORCE_M_S2))
                  & (~has_force | (forces_m_s2 != 0).any(axis=1))
                  & (~has_rate | _is_plausible(rates_rad_s, MAX_RATE_RAD_S))
                  & (has_force | has_rate))
        errors = []
        for i in np.flatnonzero(~usable):
            try:
                if not has_force[i] and not has_rate[i]:
                    raise ImuError(NEITHER)
                ImuSample(int(stamps_ns[i]), forces_m_s2[i] if has_force[i] else None,
                          rates_rad_s[i] if has_rate[i] else None)
            except ImuError as error:
                errors.append(error)
        return ImuSamples(
            stamps_ns[usable], np.where(has_force[:, None], forces_m_s2, np.nan)[usable],
            np.where(has_rate[:, None], rates_rad_s, np.nan)[usable]), errors


def _is_plausible(vectors: Vectors, largest: float) -> Choice:
    """Tell of which vectors (N, 3) each element may have been measured; NaN never was."""
    return np.all(np.abs(vectors) <= largest, axis=1)


def _rows(vectors: list[Vector | None]) -> Vectors:
    nothing = np.full(3, np.nan)
    return np.array([nothing if one is None else one for one in vectors]).reshape(-1, 3)


def mount_rotation(roll_rad: float, pitch_rad: float, yaw_rad: float) -> Rotation:
    """
    Return ``R_camera_imu`` from roll, pitch and yaw as a URDF states them.

    They turn the IMU, in this order, about the fixed axes x forward, y left and z up of the body
    at the camera; at zero the IMU's axes are these.
    """
    return R_CAMERA_BODY * Rotation.from_euler('xyz', (roll_rad, pitch_rad, yaw_rad))
