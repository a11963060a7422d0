# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The last two seconds of an IMU as arrays, and the rotation that its gyro measured."""

import numpy as np
from scipy.spatial.transform import Rotation

from sph_stab_ros.geometry.arrays import Stamps, Vector, Vectors
from sph_stab_ros.geometry.conventions import NS_PER_S
from sph_stab_ros.stabilization.imu import ImuSamples

# Over a longer silence of the gyro nothing is known.
MAX_GAP_NS = NS_PER_S // 10
# Stamps that go back further are those of a new start; others are late and left out.
NEW_START_NS = NS_PER_S // 10
HISTORY_NS = 2 * NS_PER_S


class ImuHistory:
    """The last two seconds of an IMU, in the camera's axes."""

    def __init__(self) -> None:
        self._forces = _Series()
        self._rates = _Series()

    def clear(self) -> None:
        """Forget everything: the IMU sits otherwise from now on, or its clock was set back."""
        self._forces.clear()
        self._rates.clear()

    def add(self, samples: ImuSamples, R_camera_imu: Rotation) -> None:
        """Take in ImuSamples; those that come late are left out."""
        for series, vectors in ((self._forces, samples.forces_m_s2),
                                (self._rates, samples.rates_rad_s)):
            measured = ~np.isnan(vectors[:, 0])
            if measured.any():
                series.add(samples.stamps_ns[measured], R_camera_imu.apply(vectors[measured]))

    def all_forces(self) -> tuple[Stamps, Vectors]:
        """Return stamps (N,) and specific force (N, 3) in m/s² at each."""
        return self._forces.stamps_ns, self._forces.vectors

    def forces(self, after_ns: int, until_ns: int) -> tuple[Stamps, Vectors]:
        """Return stamps (N,) in (after, until] and specific force (N, 3) in m/s² at each."""
        stamps_ns = self._forces.stamps_ns
        chosen = slice(*np.searchsorted(stamps_ns, (after_ns, until_ns), side='right'))
        return stamps_ns[chosen], self._forces.vectors[chosen]

    def gyro_rotation(self, from_ns: int, to_ns: int) -> Rotation | None:
        """Return the camera's turn ``R_from_to``, or None where the gyro does not cover it."""
        if from_ns > to_ns:
            turn = self.gyro_rotation(to_ns, from_ns)
            return None if turn is None else turn.inv()
        stamps_ns, rates_rad_s = self._rates.stamps_ns, self._rates.vectors
        # A silence ends what is known before it.
        silences = np.flatnonzero(np.diff(stamps_ns) > MAX_GAP_NS)
        known = silences[-1] + 1 if silences.size else 0
        if known == len(stamps_ns) or not (
                stamps_ns[known] <= from_ns and to_ns <= stamps_ns[-1] + MAX_GAP_NS):
            return None
        # The rate between two samples is their mean; beyond the last one it goes on.
        means_rad_s = (rates_rad_s + np.concatenate((rates_rad_s[1:], rates_rad_s[-1:]))) / 2
        first, last = (np.searchsorted(stamps_ns, (from_ns, to_ns), side='right') - 1).tolist()
        elapsed_s = np.diff(stamps_ns[first:last + 1]) / NS_PER_S
        R_first_from = _turn(means_rad_s[first], from_ns - int(stamps_ns[first]))
        R_last_to = _turn(means_rad_s[last], to_ns - int(stamps_ns[last]))
        R_first_last = _product(Rotation.from_rotvec(
            np.vstack((means_rad_s[first:last] * elapsed_s[:, None], np.zeros(3)))))
        return R_first_from.inv() * R_first_last * R_last_to


class _Series:
    """Vectors with stamps that increase, of the last two seconds."""

    def __init__(self) -> None:
        self.clear()

    def clear(self) -> None:
        """Forget everything."""
        self.stamps_ns: Stamps = np.empty(0, np.int64)
        self.vectors: Vectors = np.empty((0, 3))

    def add(self, stamps_ns: Stamps, vectors: Vectors) -> None:
        """Take in vectors (N, 3) with their stamps (N,), but for those that come late."""
        chosen: list[int] = []
        last_ns = int(self.stamps_ns[-1]) if len(self.stamps_ns) else None
        for i, stamp_ns in enumerate(stamps_ns.tolist()):
            if last_ns is not None and stamp_ns < last_ns - NEW_START_NS:
                self.clear()
                chosen.clear()
                last_ns = None
            if last_ns is None or stamp_ns > last_ns:
                chosen.append(i)
                last_ns = stamp_ns
        if not chosen:
            return
        self.stamps_ns = np.concatenate((self.stamps_ns, stamps_ns[chosen]))
        self.vectors = np.concatenate((self.vectors, vectors[chosen]))
        recent = slice(np.searchsorted(self.stamps_ns, self.stamps_ns[-1] - HISTORY_NS), None)
        self.stamps_ns, self.vectors = self.stamps_ns[recent], self.vectors[recent]


def _product(rotations: Rotation) -> Rotation:
    """Return the product of N > 0 rotations in their order, halving their number each time."""
    while len(rotations) > 1:
        even = len(rotations) // 2 * 2
        pairs = rotations[:even:2] * rotations[1:even:2]
        rotations = (pairs if even == len(rotations)
                     else Rotation.concatenate((pairs, rotations[even:])))
    return rotations[0]


def _turn(rate_rad_s: Vector, elapsed_ns: int) -> Rotation:
    return Rotation.from_rotvec(rate_rad_s * (elapsed_ns / NS_PER_S))
