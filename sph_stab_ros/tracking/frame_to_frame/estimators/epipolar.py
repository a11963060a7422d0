# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The rotation and epipole that make all flow run along epipolar circles (5 DoF)."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from sph_stab_ros.geometry.arrays import Floats, Values, Vector, Vectors
from sph_stab_ros.tracking.frame_to_frame.estimators.base import (
    BearingPairs, FitStatus, RotationEstimate, weighted_median)
from sph_stab_ros.tracking.frame_to_frame.estimators.levenberg_marquardt import (
    levenberg_marquardt, Linearised)

MIN_PAIRS = 50
# Mean cosine between the derotated flow and the direction of the epipole. Parallax p in
# isotropic noise σ gives √(π/8) p/σ · (I0 + I1)(p²/4σ²) e^(−p²/4σ²): this is p = σ. Below,
# the flow's directions say more about its noise than about the motion.
MIN_ALIGNMENT = 0.55
# Ω at which flow counts a quarter. On plain walls flow is interpolated and points anywhere: in the
# worst of three real stereo pairs Σ Ω² errs by 0.5–0.7°, bounded by 0.2–0.3°.
BOUND_RAD = 0.5
# Steps end when shorter than these, on the way and at the end. The last ones move the epipole
# along its flat valley: the rotation is then within 0.01° of its own end, in half of the steps.
ON_THE_WAY_RAD, END_RAD = 1e-2, 1e-4


@dataclass(frozen=True)
class State:
    """Rotation R and epipole q (3,) of Eq. 8."""

    R: Rotation
    q: Vector

    def moved(self, step: Floats) -> 'State':
        """Return the state one step (5,) away: R turned by 3, q moved along its tangents by 2."""
        q = self.q + tangent_basis(self.q) @ step[3:]
        return State(Rotation.from_rotvec(step[:3]) * self.R, q / np.linalg.norm(q))


def fit_epipolar(pairs: BearingPairs, start: RotationEstimate,
                 bound_rad: float = BOUND_RAD) -> RotationEstimate | None:
    """
    Return the RotationEstimate of Eq. 8 from the start of another estimator, or None.

    Minimises ``Σ w Ω²`` over rotation and epipole by Levenberg–Marquardt, where Ω is the angle
    between ``N_q = q × x`` and ``N_f = (x + f) × x`` (Eqs. 4–8), and from there the bounded
    ``Σ w Ω² / (1 + Ω²/c²)``, c = ``bound_rad``; an infinite bound leaves it at Eq. 8.

    At pure rotation Eq. 8 has no minimum, and noise leads it degrees astray: where the flow left
    by the start does not point along its epipole (MIN_ALIGNMENT), the start is returned with the
    status NO_PARALLAX.

    The epipole starts from the start's own or from the flow's, whichever fits better: with one
    start alone the fit can fall into a wrong valley.
    """
    if len(pairs) < MIN_PAIRS:
        return None
    weights = pairs.weights / pairs.weights.sum()
    R = start.R_current_previous
    epipoles = [epipole_of_flow(pairs, R)]
    if start.t_current is not None:
        epipoles.append(start.t_current)
    q = max(epipoles, key=lambda q: weights @ np.cos(flow_angles(pairs, R, q)))
    if weights @ np.cos(flow_angles(pairs, R, q)) < MIN_ALIGNMENT:
        return replace(start, status=FitStatus.NO_PARALLAX)
    end = State(R, q)
    for bound, tolerance in ((np.inf, ON_THE_WAY_RAD), (bound_rad, END_RAD)):
        end = levenberg_marquardt(
            end, lambda state: linearise(state, pairs, weights, bound), State.moved,
            tolerance)
    normals = np.cross(end.q, end.R.apply(pairs.previous))
    off_plane = np.abs(np.einsum('ni,ni->n', normals, pairs.current)) \
        / np.maximum(np.linalg.norm(normals, axis=1), 1e-12)
    return RotationEstimate(end.R, weighted_median(off_plane, weights), len(pairs), end.q)


def flow_angles(pairs: BearingPairs, R_current_previous: Rotation, q: Vector) -> Values:
    """Return Ω (N,) in (−π, π]: how far the derotated flow points aside of the epipole q (3,)."""
    x_r = R_current_previous.apply(pairs.previous)
    return np.arctan2(*_sine_cosine(x_r, pairs.current, q))


def epipole_of_flow(pairs: BearingPairs, R_current_previous: Rotation) -> Vector:
    """
    Return the unit epipole (3,) that a known rotation leaves to the flow.

    The smallest eigenvector of ``Σ w n nᵀ``, ``n = x_r × x'`` (long where the parallax is), on
    the side that the flow points to.
    """
    x_r = R_current_previous.apply(pairs.previous)
    n = np.cross(x_r, pairs.current)
    q = np.linalg.eigh((pairs.weights[:, None] * n).T @ n)[1][:, 0]
    return q * (1. if pairs.weights @ (pairs.current - x_r) @ q >= 0 else -1.)


def tangent_basis(q: Vector) -> Floats:
    """Return two unit columns (3, 2) that span the tangent plane of the sphere at q (3,)."""
    return np.linalg.svd(q[None])[2][1:].T


def _sine_cosine(x: Vectors, x_moved: Vectors, q: Vector) -> tuple[Values, Values]:
    """
    Return s, c (N,) with ``Ω = atan2(s, c)``.

    N_q and N_f both lie in the tangent plane at x, so that
    ``s = x · (N_q × N_f) = x · (q × x')`` and ``c = N_q · N_f = q·x' − (q·x)(x·x')``, x' = x + f.
    """
    s = np.einsum('ni,ni->n', x, np.cross(q, x_moved))
    c = x_moved @ q - (x @ q) * np.einsum('ni,ni->n', x, x_moved)
    return s, c


def linearise(
        state: State, pairs: BearingPairs, weights: Values, bound_rad: float) -> Linearised:
    """Linearise √w Ω under R ← exp(ω) R, q ← q + B s: Ω' = (c s' − s c') / (s² + c²)."""
    # Bearings as columns (3, N): a row is a vector of all pairs, which NumPy goes through fastest.
    x, x_moved, q = state.R.as_matrix() @ pairs.previous.T, pairs.current.T, state.q
    across = np.cross(x_moved, x, axis=0)
    q_dot_x, x_dot_moved = q @ x, np.einsum('in,in->n', x, x_moved)
    s, c = q @ across, q @ x_moved - q_dot_x * x_dot_moved
    # dx = ω × x turns a scalar x·a into ω·(x × a); dq = B s turns q·b into s·(Bᵀ b).
    ds_dR = x_dot_moved * q[:, None] - q_dot_x * x_moved
    dc_dR = x_dot_moved * np.cross(q, x.T).T + q_dot_x * across
    B = tangent_basis(q)
    ds_dq = B.T @ across
    dc_dq = B.T @ x_moved - x_dot_moved * (B.T @ x)
    J = np.vstack((c * ds_dR - s * dc_dR, c * ds_dq - s * dc_dq)) / np.maximum(
        s * s + c * c, 1e-18)
    omega = np.arctan2(s, c)
    # The weights of iterated least squares for ρ = Ω² / (1 + Ω²/c²).
    bounded = 1 / (1 + (omega / bound_rad) ** 2)
    weighted = weights * bounded ** 2 * J
    return Linearised(
        weighted @ J.T, weighted @ omega, float(weights @ (omega ** 2 * bounded)))
