# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Stamped orientations: interpolation, and files in the TUM format."""

from decimal import Decimal
import logging
import math
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation, Slerp

from sph_stab_ros.geometry.arrays import Choice
from sph_stab_ros.geometry.conventions import NS_PER_S
from sph_stab_ros.geometry.rotations import is_unit_quaternion

logger = logging.getLogger(__name__)

MAX_STAMP_NS = 2**63 - 1
# Its square must still be one.
MIN_NORM = 1e-100


class Trajectory:
    """
    Orientations over time.

    Parameters
    ----------
    stamps_ns : (N,) int64
        Strictly increasing, N ≥ 1.
    rotations : Rotation of length N

    """

    def __init__(self, stamps_ns: ArrayLike, rotations: Rotation) -> None:
        self.stamps_ns = np.asarray(stamps_ns, np.int64)
        self.rotations = rotations
        if self.stamps_ns.ndim != 1 or not len(self.stamps_ns):
            raise ValueError('a trajectory needs a list of at least one stamp')
        if len(self.stamps_ns) != len(rotations):
            raise ValueError(f'{len(self.stamps_ns)} stamps for {len(rotations)} orientations')
        if np.any(np.diff(self.stamps_ns) <= 0):
            raise ValueError('the stamps of a trajectory must increase strictly')

    def __len__(self) -> int:
        return len(self.stamps_ns)

    def covers(self, stamps_ns: ArrayLike) -> Choice:
        """Tell which of the stamps (M,) lie between the first and the last one, as (M,) bool."""
        stamps_ns = np.asarray(stamps_ns, np.int64)
        return (self.stamps_ns[0] <= stamps_ns) & (stamps_ns <= self.stamps_ns[-1])

    def at(self, stamps_ns: ArrayLike) -> Rotation:
        """Return the orientations at stamps (M,) by slerp; ValueError outside of them."""
        stamps_ns = np.asarray(stamps_ns, np.int64)
        if not np.all(self.covers(stamps_ns)):
            raise ValueError('orientations are asked for outside of the trajectory')
        if len(self) == 1:
            return self.rotations[np.zeros(stamps_ns.shape, int)]
        # Relative to the first stamp: as float, seconds since 1970 keep only 0.2 µs.
        slerp = Slerp((self.stamps_ns - self.stamps_ns[0]) / NS_PER_S, self.rotations)
        return slerp((stamps_ns - self.stamps_ns[0]) / NS_PER_S)

    def relative_to_first(self) -> 'Trajectory':
        """Return the same motion seen from its first orientation: R_first⁻¹ R."""
        return Trajectory(self.stamps_ns, self.rotations[0].inv() * self.rotations)


def tum_line(stamp_ns: int, rotation: Rotation) -> str:
    """Return ``stamp 0 0 0 qx qy qz qw`` and a newline; the stamp in seconds, 9 decimals."""
    sign = '-' if stamp_ns < 0 else ''
    seconds, nanoseconds = divmod(abs(int(stamp_ns)), NS_PER_S)
    x, y, z, w = rotation.as_quat()
    return f'{sign}{seconds}.{nanoseconds:09d} 0 0 0 {x:.9f} {y:.9f} {z:.9f} {w:.9f}\n'


def write_tum(path: str | Path, trajectory: Trajectory) -> None:
    """Write a Trajectory as a TUM file; its positions are zero."""
    Path(path).write_text(
        ''.join(map(tum_line, trajectory.stamps_ns, trajectory.rotations)))


def read_tum(path: str | Path) -> Trajectory:
    """
    Return the Trajectory of a TUM file; ValueError with the line's number where it is not one.

    A recording with repeated or backward stamps gives such lines too; what is not later than all
    lines before is left out, and quaternions are normalised, either with a warning.
    """
    stamps_ns: list[int] = []
    quaternions: list[list[float]] = []
    left_out = 0
    try:
        text = Path(path).read_text('utf-8-sig')
    except UnicodeDecodeError:
        raise ValueError(f'{path} is not a text') from None
    for number, line in enumerate(text.splitlines(), 1):
        fields = line.split('#')[0].split()
        if not fields:
            continue
        try:
            stamp, _, _, _, *numbers = fields
            exact_ns = Decimal(stamp) * NS_PER_S
            quaternion = [float(q) for q in numbers]
            # Before it becomes a number of a billion digits.
            is_right = abs(exact_ns) <= MAX_STAMP_NS and len(quaternion) == 4 and (
                MIN_NORM < math.hypot(*quaternion) < math.inf)
        except (ValueError, ArithmeticError):
            is_right = False
        if not is_right:
            raise ValueError(f'{path}, line {number}: not "stamp x y z qx qy qz qw"')
        stamp_ns = int(exact_ns)
        if stamps_ns and stamp_ns <= stamps_ns[-1]:
            left_out += 1
            continue
        stamps_ns.append(stamp_ns)
        quaternions.append(quaternion)
    if not stamps_ns:
        raise ValueError(f'{path} holds no orientations')
    if left_out:
        logger.warning('%s: %d lines are not later than those before and are left out',
                       path, left_out)
    normalised = sum(not is_unit_quaternion(one) for one in quaternions)
    if normalised:
        logger.warning('%s: %d lines with a quaternion not of unit length, normalised',
                       path, normalised)
    return Trajectory(stamps_ns, Rotation.from_quat(quaternions))
