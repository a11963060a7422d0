# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""
The rotation under which the flow's directional moment vanishes (3 degrees of freedom).

Translation alone makes flow of equal and opposite directions at antipodes, whatever the depths, so
its moment is zero; rotation alone makes a moment of full strength. The rotation sought is the
one whose removal makes the moment vanish.
"""

import numpy as np
from scipy.spatial.transform import Rotation

from sph_stab_ros.geometry.arrays import Values, Vector
from sph_stab_ros.tracking.frame_to_frame.estimators.base import (
    BearingPairs, RotationEstimate, weighted_median)
from sph_stab_ros.tracking.frame_to_frame.estimators.levenberg_marquardt import (
    levenberg_marquardt, Linearised)

MIN_PAIRS = 50
# Smoothing of |f|, from beyond the largest rotation expected down to below the flow's noise
# (0.1 px at 480 columns is 1.3e-3 rad).
SMOOTHING_RAD = (0.3, 0.03, 3e-3, 3e-4)


def fit_moment(pairs: BearingPairs, start: Rotation | None = None) -> RotationEstimate | None:
    """
    Return the RotationEstimate whose derotated flow has no directional moment, or None.

    Minimises ``|M|``, ``M = Σ w x_r × f / |f|`` with ``f = x' − x_r``, ``x_r = R x`` (Eqs. 2, 3,
    9, 10), by Levenberg–Marquardt from ``start`` (the identity by default).

    ``M`` is minus the gradient of ``Σ w |f|``, so it also vanishes where that is largest, at the
    opposite rotation, and plain Levenberg–Marquardt ends there as soon as the rotation is large
    against noise and parallax. Hence the two safeguards: ``|f|`` is smoothed to ``√(|f|² + ε²)``
    with ε falling, and only steps that lower ``Σ w |f|`` are taken. What they lead to is the
    L1 fit of a rotation.

    Masks must be symmetric under x → −x, or translation does have a moment.
    """
    if len(pairs) < MIN_PAIRS:
        return None
    R = start or Rotation.identity()
    weights = pairs.weights / pairs.weights.sum()
    for smoothing_rad in SMOOTHING_RAD:
        R = levenberg_marquardt(
            R, lambda R: linearise(R, pairs, weights, smoothing_rad), retract)
    flow_rad = np.linalg.norm(pairs.current - R.apply(pairs.previous), axis=1)
    return RotationEstimate(R, weighted_median(flow_rad, weights), len(pairs))


def retract(R: Rotation, omega: Vector) -> Rotation:
    return Rotation.from_rotvec(omega) * R


def linearise(R: Rotation, pairs: BearingPairs, weights: Values,
              smoothing_rad: float) -> Linearised:
    """
    Linearise M under R ← exp(ω) R.

    With g = x_r × x' and ρ = √(|f|² + ε²):
    M = Σ w g / ρ,  ∂M/∂ω = Σ w ((x_r x'ᵀ − (x_r·x') I) / ρ + g gᵀ / ρ³).
    """
    x_r = pairs.previous @ R.as_matrix().T
    g = np.cross(x_r, pairs.current)
    flow = pairs.current - x_r
    rho = np.sqrt(np.einsum('ij,ij->i', flow, flow) + smoothing_rad ** 2)
    w = weights / rho
    M = w @ g
    outer = (w[:, None] * x_r).T @ pairs.current
    J = outer - np.trace(outer) * np.eye(3) + ((w / rho ** 2)[:, None] * g).T @ g
    return Linearised(J.T @ J, J.T @ M, float(weights @ rho))
