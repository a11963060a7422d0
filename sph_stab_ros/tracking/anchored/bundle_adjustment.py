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
from functools import cached_property

import numpy as np
from scipy.spatial.transform import Rotation

from sph_stab_ros.geometry.arrays import Floats, Matrix, Values, Vectors
from sph_stab_ros.tracking.anchored.bundle_window import (
    eliminated, pose_and_point_equations, residual_lengths, Window)
from sph_stab_ros.tracking.anchored.pose_estimation import (
    cauchy_weights, MEDIAN_2D, PoseOptions)

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

    @cached_property
    def _eliminated(self) -> Floats:
        return eliminated(self.H_rp, self.H_rr)

    def reduced(self, damping: float) -> Floats:
        """Return the matrix of the keyframes alone (Schur complement), damped."""
        S = self.H - self._eliminated / (1 + damping)
        S[np.diag_indices_from(S)] += damping * np.diag(self.H) + 1e-9
        if self.kept_along is not None:
            # Behind the damping, which would slow down what moves across.
            stiffness = GAUGE_STIFFNESS * self.kept_along ** 2 @ np.diag(S)
            S += stiffness * np.outer(self.kept_along, self.kept_along)
        return S


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
