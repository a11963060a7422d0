# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Operations on rotations, where SciPy and NumPy are too slow for every frame."""

from collections.abc import Iterable
import math

import numpy as np
from scipy.spatial.transform import Rotation

from sph_stab_ros.geometry.arrays import Covariance, Matrix, Vectors

# Of the length of a unit quaternion, the same as tf2's.
QUATERNION_TOLERANCE = 0.01

try:
    Rotation.from_matrix(np.eye(3), assume_valid=True)
    _VALID = {'assume_valid': True}
except TypeError:
    # Before SciPy 1.17, which was quick without.
    _VALID = {}


def rotation_from_matrix(R: Matrix) -> Rotation:
    """
    Return the Rotation of R (3, 3), which is one within rounding.

    SciPy 1.17 takes 0.15 ms to make sure of that, and 0.02 ms without; a frame has two.
    """
    return Rotation.from_matrix(R, **_VALID)


def is_unit_quaternion(quaternion: Iterable[float]) -> bool:
    """Tell whether four numbers are a unit quaternion within QUATERNION_TOLERANCE; NaN is none."""
    return abs(math.hypot(*quaternion) - 1) <= QUATERNION_TOLERANCE


def cross(a: Vectors, b: Vectors) -> Vectors:
    """Return a × b (N, 3), in a third of NumPy's time."""
    return a[:, [1, 2, 0]] * b[:, [2, 0, 1]] - a[:, [2, 0, 1]] * b[:, [1, 2, 0]]


def rotate_covariance(covariance: Covariance, R_a_b: Rotation) -> Covariance:
    """Return in frame a what is the covariance (3, 3) of a vector in frame b."""
    R = R_a_b.as_matrix()
    return R @ covariance @ R.T


def standard_deviation_rad(covariance: Covariance) -> float:
    """Return the standard deviation about the least certain axis, of a covariance in rad²."""
    return float(np.sqrt(max(np.linalg.eigvalsh(covariance)[-1], 0)))
