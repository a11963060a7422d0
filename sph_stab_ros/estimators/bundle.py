# Copyright 2026 The sph_stab_ros developers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""
Bundle adjustment: rotations and positions of keyframes and inverse depths of points, together.

A point belongs to the keyframe h in which its texture was taken: there its bearing x is exact by
definition, and its inverse depth ρ counts from there. Keyframe k sees it along
``R_kᵀ (R_h x − ρ (p_k − p_h))``, with R = R_world_camera.
"""

from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.spatial.transform import Rotation

from sph_stab_ros.estimators.pose import CAUCHY, cauchy_weights, MAX_INVERSE_DEPTH, MEDIAN_2D

ITERATIONS = 4
STEP_TOLERANCE = 1e-5
MIN_SCALE, MAX_SCALE = 0.5, 1.5
# Levenberg–Marquardt: relative to the diagonal.
FIRST_DAMPING, DAMPED, MAX_DAMPING = 1e-4, 1e-3, 1e3
DAMPING_FACTOR = 10
# Of the fixed length that sets the unit, per unit.
GAUGE_INFORMATION = 1e8


@dataclass(frozen=True)
class Window:
    """
    K keyframes, P points and M sightings of points in keyframes.

    ``R`` (K, 3, 3) and ``p`` (K, 3) are the keyframes' poses, ``free`` (K,) bool tells which to
    adjust. ``host`` (P,) is the keyframe of each point, ``x`` (P, 3) its bearing in the host's
    camera, ``inverse_depths`` and ``information`` (P,) ρ0 and its inverse variance. ``keyframe``
    and ``point`` (M,) tell what was seen where, ``y`` (M, 3) along which bearing in the
    keyframe's camera, ``whitening`` (M, 2, 3) with what certainty, as for a pose.
    """

    R: np.ndarray
    p: np.ndarray
    free: np.ndarray
    host: np.ndarray
    x: np.ndarray
    inverse_depths: np.ndarray
    information: np.ndarray
    keyframe: np.ndarray
    point: np.ndarray
    y: np.ndarray
    whitening: np.ndarray


@dataclass(frozen=True)
class Adjusted:
    """
    The Window's R, p and inverse depths after adjustment.

    ``information`` (P,) of the inverse depths, ``weights`` (M,) ≤ 1 the trust in each sighting,
    ``covariance`` (6F, 6F) that of the F free keyframes' rotation vectors, in the world, and
    positions, as far as the fixed ones are exact.
    """

    R: np.ndarray
    p: np.ndarray
    inverse_depths: np.ndarray
    information: np.ndarray
    weights: np.ndarray
    covariance: np.ndarray


def adjust(window, keep_distance=False):
    """
    Return the Adjusted window: robust least squares by Levenberg–Marquardt.

    With ``keep_distance`` the last keyframe stays as far from the origin as it is: the unit of
    length, where nothing else sets it.
    """
    problem = _Problem(window, keep_distance)
    R, p, rho = window.R, window.p, window.inverse_depths
    damping = FIRST_DAMPING
    seen = problem.look(R, p, rho)
    for _ in range(ITERATIONS):
        equations = problem.equations(R, p, rho, seen)
        cost = problem.cost(seen, rho, equations.scale)
        while True:
            step, R_new, p_new, rho_new = problem.step(equations, damping, R, p, rho)
            seen_new = problem.look(R_new, p_new, rho_new)
            better = problem.cost(seen_new, rho_new, equations.scale) <= cost
            if better or damping > MAX_DAMPING:
                break
            damping = max(damping, DAMPED) * DAMPING_FACTOR
        if not better:
            break
        R, p, rho, seen = R_new, p_new, rho_new, seen_new
        damping /= DAMPING_FACTOR
        if np.abs(step).max() < STEP_TOLERANCE:
            break
    return Adjusted(R, p, rho, equations.H_rr, equations.weights,
                    np.linalg.inv(equations.reduced(0.)))


@dataclass(frozen=True)
class _Seen:
    """How points are seen: residuals r (M, 2), their sizes (M,), and what led there."""

    x: np.ndarray
    q: np.ndarray
    z: np.ndarray
    r: np.ndarray
    sizes: np.ndarray


@dataclass(frozen=True)
class _Equations:
    """Normal equations: keyframes' H and g, points' H_rr and g_r, and H_rp between them."""

    H: np.ndarray
    g: np.ndarray
    H_rp: np.ndarray
    H_rr: np.ndarray
    g_r: np.ndarray
    weights: np.ndarray
    scale: float

    def reduced(self, damping):
        """Return the matrix of the keyframes alone (Schur complement), damped."""
        S = self.H - (self.H_rp / (self.H_rr * (1 + damping))[:, None]).T @ self.H_rp
        S[np.diag_indices_from(S)] += damping * np.diag(self.H) + 1e-9
        return S


class _Problem:

    def __init__(self, window, keep_distance):
        self._window = window
        self._count = int(window.free.sum())
        self._host = window.host[window.point]
        # Fixed ones go to a last place, which is thrown away.
        slots = np.where(window.free, np.cumsum(window.free) - 1, self._count)
        self._slots = slots[window.keyframe], slots[self._host]
        sightings = np.arange(len(window.point))
        self._by_point = sparse.csr_matrix(
            (np.ones(len(sightings)), (window.point, sightings)),
            shape=(len(window.x), len(sightings)))
        distance = np.linalg.norm(window.p[-1])
        self._kept_along = window.p[-1] / distance if keep_distance and distance > 0 else None

    def look(self, R, p, rho):
        window = self._window
        x = np.einsum('mij,mj->mi', R[self._host], window.x[window.point])
        q = p[window.keyframe] - p[self._host]
        z = x - rho[window.point, None] * q
        b = np.einsum('mij,mi->mj', R[window.keyframe], z)
        b /= np.sqrt(np.einsum('mi,mi->m', z, z))[:, None]
        r = np.einsum('mki,mi->mk', window.whitening, b - window.y)
        return _Seen(x, q, z, r, np.sqrt(np.einsum('mk,mk->m', r, r)))

    def cost(self, seen, rho, scale):
        width = CAUCHY * scale
        window = self._window
        return ((CAUCHY ** 2 * np.log1p((seen.sizes / width) ** 2)).sum()
                + window.information @ (rho - window.inverse_depths) ** 2)

    def equations(self, R, p, rho, seen):
        window = self._window
        scale = np.clip(np.median(seen.sizes) / MEDIAN_2D, MIN_SCALE, MAX_SCALE)
        weights = cauchy_weights(seen.sizes, scale)
        w = weights / scale ** 2
        # W db = M dz with dz = ω_h × x − ω_k × z − ρ (dp_k − dp_h) − q dρ, all in the world.
        A = window.whitening @ np.swapaxes(R[window.keyframe], 1, 2)
        length = np.sqrt(np.einsum('mi,mi->m', seen.z, seen.z))[:, None, None]
        b = seen.z[:, None] / length
        M = (A - np.einsum('mki,mji->mkj', A, b) * b) / length
        along = rho[window.point, None, None] * M
        J = np.zeros((len(M), 2, self._count + 1, 6))
        each = np.arange(len(M))
        keyframe, host = self._slots
        J[each, :, keyframe, :3] -= np.cross(seen.z[:, None], M)
        J[each, :, keyframe, 3:] -= along
        J[each, :, host, :3] += np.cross(seen.x[:, None], M)
        J[each, :, host, 3:] += along
        J = J[:, :, :-1].reshape(len(M), 2, -1)
        J_rho = -np.einsum('mki,mi->mk', M, seen.q)

        wJ = w[:, None, None] * J
        flat = wJ.reshape(2 * len(M), -1)
        H = flat.T @ J.reshape(2 * len(M), -1)
        if self._kept_along is not None:
            H[-3:, -3:] += GAUGE_INFORMATION * np.outer(self._kept_along, self._kept_along)
        return _Equations(
            H, flat.T @ seen.r.ravel(), self._by_point @ np.einsum('mkn,mk->mn', wJ, J_rho),
            window.information + self._by_point @ (w * np.einsum('mk,mk->m', J_rho, J_rho)),
            self._by_point @ (w * np.einsum('mk,mk->m', J_rho, seen.r))
            + window.information * (rho - window.inverse_depths), weights, scale)

    def step(self, equations, damping, R, p, rho):
        H_rr = equations.H_rr * (1 + damping)
        step = -np.linalg.solve(equations.reduced(damping),
                                equations.g - equations.H_rp.T @ (equations.g_r / H_rr))
        rho = np.clip(rho - (equations.g_r + equations.H_rp @ step) / H_rr, 0., MAX_INVERSE_DEPTH)
        turns, moves = np.split(step.reshape(-1, 6), 2, axis=1)
        R, p, free = R.copy(), p.copy(), self._window.free
        R[free] = Rotation.from_rotvec(turns).as_matrix() @ R[free]
        p[free] += moves
        return step, R, p, rho
