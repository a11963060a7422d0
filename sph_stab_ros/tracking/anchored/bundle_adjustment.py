# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""
Bundle adjustment: rotations and positions of keyframes and inverse depths of points, together.

A point belongs to the keyframe h in which its texture was taken: there its bearing x is exact by
definition, and its inverse depth ρ counts from there. Keyframe k sees it along
``R_kᵀ (R_h x − ρ (p_k − p_h))``, with R = R_world_camera. Points are eliminated by the Schur
complement (B. Triggs, P. McLauchlan, R. Hartley and A. Fitzgibbon, *Bundle adjustment: a modern
synthesis*, Vision Algorithms: Theory and Practice, 2000).
"""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_matrix
from scipy.spatial.transform import Rotation

from sph_stab_ros import kernels
from sph_stab_ros.geometry.arrays import (
    Bearings, Choice, Floats, Indices, Matrix, Values, Vectors)
from sph_stab_ros.tracking.anchored.pose_estimation import (
    cauchy_weights, MEDIAN_2D, NormalEquations, PoseOptions)

# How much more certain the length that sets the unit is than what is seen makes it.
GAUGE_STIFFNESS = 1e6


@dataclass(frozen=True)
class BundleOptions:
    """How a window is adjusted."""

    # A window is adjusted again with the next keyframe: what few steps leave those will do. A step
    # as short, in radians and in units of length, is the last one.
    max_iterations: int = 4
    step_tolerance: float = 1e-5
    # A residual of so many standard deviations counts half (Cauchy's loss), as for poses.
    cauchy_width: float = 2.0
    # The residuals' own scale, in the deviations expected, is believed within these: narrower than
    # for poses, since who moves has mostly been sorted out.
    min_scale: float = 0.5
    max_scale: float = 1.5
    # Relative to the diagonal: the first damping, the least after a step that made it worse, by
    # what it changes, and that at which it is given up.
    first_damping: float = 1e-4
    min_damping_after_failure: float = 1e-3
    damping_factor: float = 10
    max_damping: float = 1e3
    # In the inverse unit of length, as for poses.
    max_inverse_depth: float = PoseOptions.max_inverse_depth


@dataclass(frozen=True)
class Window:
    """
    K keyframes, P points and M observations of points in keyframes.

    ``R`` (K, 3, 3) and ``p`` (K, 3) are the keyframes' poses, ``free`` (K,) bool tells which to
    adjust. ``host`` (P,) is the keyframe of each point, ``x`` (P, 3) its bearing in the host's
    camera, ``inverse_depths`` and ``information`` (P,) ρ0 and its inverse variance. ``keyframe``
    and ``point`` (M,) tell what was seen where, ``y`` (M, 3) along which bearing in the
    keyframe's camera, ``sqrt_information`` (M, 2, 3) with what certainty, as for a pose.
    """

    R: Matrix
    p: Vectors
    free: Choice
    host: Indices
    x: Bearings
    inverse_depths: Values
    information: Values
    keyframe: Indices
    point: Indices
    y: Bearings
    sqrt_information: Floats


@dataclass(frozen=True)
class Adjusted:
    """
    The Window's R, p and inverse depths after adjustment.

    ``information`` (P,) of the inverse depths, ``weights`` (M,) ≤ 1 the trust in each observation,
    ``scale`` the residuals' standard deviation,
    ``covariance`` (6F, 6F) that of the F free keyframes' rotation vectors, in the world, and
    positions, as far as the fixed ones are exact.
    """

    R: Matrix
    p: Vectors
    inverse_depths: Values
    information: Values
    weights: Values
    scale: float
    covariance: Floats


def adjust(window: Window, options: BundleOptions, keep_distance: bool = False) -> Adjusted:
    """
    Return the Adjusted window: robust least squares by Levenberg–Marquardt.

    D. W. Marquardt, *An algorithm for least-squares estimation of nonlinear parameters*, Journal
    of the SIAM 11(2), 1963, damped in proportion to the diagonal as there.

    With ``keep_distance`` the free keyframe farthest from the origin stays as far from it: the
    unit of length, where nothing else sets it. The last one may have come back to the origin.
    """
    kept_along = _farthest(window) if keep_distance else None
    R, p, rho = window.R, window.p, window.inverse_depths
    damping = options.first_damping
    sizes = residual_lengths(window, R, p, rho)
    for _ in range(options.max_iterations):
        equations = normal_equations(window, R, p, rho, sizes, options, kept_along)
        cost = _cost(window, rho, sizes, options.cauchy_width, equations.scale)
        while True:
            step, R_new, p_new, rho_new = _step(
                window, equations, damping, R, p, rho, options.max_inverse_depth)
            sizes_new = residual_lengths(window, R_new, p_new, rho_new)
            better = _cost(
                window, rho_new, sizes_new, options.cauchy_width, equations.scale) <= cost
            if better or damping > options.max_damping:
                break
            damping = (max(damping, options.min_damping_after_failure)
                       * options.damping_factor)
        if not better:
            break
        R, p, rho, sizes = R_new, p_new, rho_new, sizes_new
        damping /= options.damping_factor
        if np.abs(step).max() < options.step_tolerance:
            break
    return Adjusted(R, p, rho, equations.H_rr, equations.weights, equations.scale,
                    np.linalg.inv(equations.reduced(0.)))


@dataclass(frozen=True)
class Equations:
    """
    Normal equations: keyframes' H and g, points' H_rr and g_r, and H_rp between them.

    The free keyframes do not move along the unit vector ``kept_along`` (6F,), if given.
    """

    H: Floats
    g: Floats
    H_rp: Floats
    H_rr: Values
    g_r: Values
    weights: Values
    scale: float
    kept_along: Floats | None

    def reduced(self, damping: float) -> Floats:
        """Return the matrix of the keyframes alone (Schur complement), damped."""
        S = self.H - (self.H_rp / (self.H_rr * (1 + damping))[:, None]).T @ self.H_rp
        S[np.diag_indices_from(S)] += damping * np.diag(self.H) + 1e-9
        if self.kept_along is not None:
            # Behind the damping, which would slow down what moves across.
            stiffness = GAUGE_STIFFNESS * self.kept_along ** 2 @ np.diag(S)
            S += stiffness * np.outer(self.kept_along, self.kept_along)
        return S


def residual_lengths(window: Window, R: Matrix, p: Vectors, rho: Values) -> Values:
    """Return the lengths (M,) of the residuals."""
    r = residuals(window, R, p, rho)
    return np.sqrt(np.einsum('mk,mk->m', r, r))


def residuals(window: Window, R: Matrix, p: Vectors, rho: Values) -> Floats:
    """Return the residuals ``W (b − y)`` (M, 2)."""
    host = window.host[window.point]
    if kernels.library is not None:
        r = np.empty((len(host), 2))
        kernels.library.bundle_residuals(
            len(host), window.keyframe, host, window.point, R, p, window.x, rho, window.y,
            window.sqrt_information, r)
    else:
        _, _, z = _rays(window, R, p, rho, host)
        b = np.einsum('mij,mi->mj', R[window.keyframe], z)
        b /= np.sqrt(np.einsum('mi,mi->m', z, z))[:, None]
        r = np.einsum('mki,mi->mk', window.sqrt_information, b - window.y)
    return r


def normal_equations(window: Window, R: Matrix, p: Vectors, rho: Values, sizes: Values,
                     options: BundleOptions, kept_along: Floats | None = None) -> Equations:
    """
    Return the Equations of residuals of such sizes (M,), weighted by them.

    ``W db = M dz`` with ``dz = ω_h × x − ω_k × z − ρ (dp_k − dp_h) − q dρ``, all in the world.
    """
    scale = float(np.clip(
        np.median(sizes) / MEDIAN_2D, options.min_scale, options.max_scale))
    weights = cauchy_weights(sizes, options.cauchy_width * scale)
    H, g, H_rp, H_rr, g_r = pose_and_point_equations(window, R, p, rho, weights / scale ** 2)
    return Equations(H, g, H_rp, window.information + H_rr,
                     g_r + window.information * (rho - window.inverse_depths), weights, scale,
                     kept_along)


def pose_and_point_equations(window: Window, R: Matrix, p: Vectors, rho: Values,
                             w: Values) -> NormalEquations:
    """
    Return the normal equations of observations weighted by w (M,), without prior inverse depths.

    H and g of the free keyframes, H_rp between points and keyframes, H_rr and g_r of the points.
    """
    accumulate = _accumulate if kernels.library is None else _accumulate_compiled
    return accumulate(window, R, p, rho, w)


def _accumulate_compiled(window: Window, R: Matrix, p: Vectors, rho: Values,
                         w: Values) -> NormalEquations:
    columns, points = 6 * window.free.sum(), len(window.x)
    H, g, H_rp = np.zeros((columns, columns)), np.zeros(columns), np.zeros((points, columns))
    H_rr, g_r = np.zeros(points), np.zeros(points)
    kernels.library.bundle_equations(
        len(window.point), columns, window.keyframe, window.host[window.point], window.point,
        np.where(window.free, np.cumsum(window.free) - 1, -1), R, p, window.x, rho, window.y,
        window.sqrt_information, w, H, g, H_rp, H_rr, g_r)
    return H, g, H_rp, H_rr, g_r


def _accumulate(window: Window, R: Matrix, p: Vectors, rho: Values, w: Values) -> NormalEquations:
    host = window.host[window.point]
    x, q, z = _rays(window, R, p, rho, host)
    A = window.sqrt_information @ np.swapaxes(R[window.keyframe], 1, 2)
    length = np.sqrt(np.einsum('mi,mi->m', z, z))[:, None]
    b = z / length
    along_b = np.einsum('mki,mi->mk', A, b)
    M = (A - along_b[..., None] * b[:, None]) / length[..., None]
    r = along_b - np.einsum('mki,mi->mk', window.sqrt_information, window.y)
    J_rho = -np.einsum('mki,mi->mk', M, q)
    along = rho[window.point, None, None] * M
    # Fixed keyframes go to a last place, which is thrown away.
    count = window.free.sum()
    slots = np.where(window.free, np.cumsum(window.free) - 1, count)
    J = np.zeros((len(M), 2, count + 1, 6))
    each = np.arange(len(M))
    J[each, :, slots[window.keyframe], :3] -= np.cross(z[:, None], M)
    J[each, :, slots[window.keyframe], 3:] -= along
    J[each, :, slots[host], :3] += np.cross(x[:, None], M)
    J[each, :, slots[host], 3:] += along
    J = J[:, :, :-1].reshape(len(M), 2, -1)

    flat = (w[:, None, None] * J).reshape(2 * len(M), -1).T
    by_point = csr_matrix((w, (window.point, each)), shape=(len(window.x), len(M)))
    return (flat @ J.reshape(2 * len(M), -1), flat @ r.ravel(),
            by_point @ np.einsum('mkn,mk->mn', J, J_rho),
            by_point @ np.einsum('mk,mk->m', J_rho, J_rho),
            by_point @ np.einsum('mk,mk->m', J_rho, r))


def _rays(window: Window, R: Matrix, p: Vectors, rho: Values,
          host: Indices) -> tuple[Vectors, Vectors, Vectors]:
    """Return bearings x, offsets q and what is seen, ``z = x − ρ q``, (M, 3) in the world."""
    x = np.einsum('mij,mj->mi', R[host], window.x[window.point])
    q = p[window.keyframe] - p[host]
    return x, q, x - rho[window.point, None] * q


def _farthest(window: Window) -> Floats:
    """Return the unit vector (6F,) along which the farthest free keyframe leaves the origin."""
    p = window.p[window.free]
    distances = np.linalg.norm(p, axis=1)
    farthest = np.argmax(distances)
    along = np.zeros((len(p), 6))
    along[farthest, 3:] = p[farthest] / max(distances[farthest], 1e-9)
    return along.ravel()


def _cost(window: Window, rho: Values, sizes: Values, cauchy_width: float,
          scale: float) -> float:
    width = cauchy_width * scale
    return ((cauchy_width ** 2 * np.log1p((sizes / width) ** 2)).sum()
            + window.information @ (rho - window.inverse_depths) ** 2)


def _step(window: Window, equations: Equations, damping: float, R: Matrix, p: Vectors,
          rho: Values, max_inverse_depth: float) -> tuple[Floats, Matrix, Vectors, Values]:
    H_rr = equations.H_rr * (1 + damping)
    step = -np.linalg.solve(equations.reduced(damping),
                            equations.g - equations.H_rp.T @ (equations.g_r / H_rr))
    rho = np.clip(rho - (equations.g_r + equations.H_rp @ step) / H_rr, 0., max_inverse_depth)
    turns, moves = np.split(step.reshape(-1, 6), 2, axis=1)
    R, p, free = R.copy(), p.copy(), window.free
    R[free] = Rotation.from_rotvec(turns).as_matrix() @ R[free]
    p[free] += moves
    return step, R, p, rho
