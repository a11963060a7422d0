# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""
Rotation and translation against points whose inverse depths are known more or less (6 DoF).

A point was first seen from the position c, at bearing x (both in the world) and inverse depth ρ;
from position p it is seen along ``R (x − ρ (p − c))``, R = R_camera_world. With ρ unknown this
says how far a bearing is off its epipolar plane, one equation; with ρ known, two. Depths that
carry their own uncertainty need no choice between the two, nor between rotation with and without
translation (J. Civera, A. J. Davison and J. M. M. Montiel, *Inverse depth parametrization for
monocular SLAM*, IEEE Transactions on Robotics 24(5), 2008).
"""

from dataclasses import dataclass, replace
from typing import TypeAlias

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from sph_stab_ros import kernels
from sph_stab_ros.geometry.arrays import (
    Bearings, Choice, Floats, Matrix, Values, Vector, Vectors)
from sph_stab_ros.geometry.rotations import rotation_from_matrix
from sph_stab_ros.tracking.anchored.table import Table

# Of the absolute value of a Gaussian in one dimension, and of its length in two.
MEDIAN_1D, MEDIAN_2D = 0.6745, 1.1774

# H and g of poses, H_rp between depths and poses, H_rr and g_r of depths.
NormalEquations: TypeAlias = tuple[Floats, Floats, Floats, Values, Values]
# R, p, inverse depths, sizes, weights and scale of a PoseEstimate, and H.
Fit: TypeAlias = tuple[Matrix, Vector, Values, Values, Values, float, Floats]


@dataclass(frozen=True)
class Points(Table):
    """
    N points as known, and as seen by one camera.

    ``x`` (N, 3) are bearings in the world from the positions ``origins`` (N, 3);
    ``inverse_depths`` and ``information`` (N,) are ρ0 and its inverse variance; ``y`` (N, 3) the
    bearings seen, in the camera; ``sqrt_information`` (N, 2, 3) two tangents of the sphere at y,
    divided by the standard deviations along them.
    """

    x: Bearings
    origins: Vectors
    inverse_depths: Values
    information: Values
    y: Bearings
    sqrt_information: Floats

    def as_new(self, information: float) -> 'Points':
        """Return these Points with ρ0 as if it were not known yet: 1, with this information."""
        return replace(self, inverse_depths=np.ones(len(self.x)),
                       information=np.full(len(self.x), information))


@dataclass(frozen=True)
class Loss:
    """
    A robust loss, by the weights of iteratively reweighted least squares: Cauchy's to a power.

    P. W. Holland and R. E. Welsch, *Robust regression using iteratively reweighted
    least-squares*, Communications in Statistics A6(9), 1977. By default for what is one scene but
    for a few.
    """

    # A residual of so many standard deviations counts half.
    width: float = 2.0
    # 1 is Cauchy's. 2 is S. Geman and D. McClure's, of which outliers do not pull, however many
    # they are: for a start that is good already.
    power: int = 1
    # How many times wider it is in the first iteration; half of that in each one after. Who starts
    # wide falls into fewer wrong valleys (A. Blake and A. Zisserman, *Visual Reconstruction*,
    # 1987).
    wide_start: float = 4.0
    # The residuals' own scale, in the deviations expected, is believed within these. With more
    # that move by themselves it would grow until nothing is an outlier any more; a smaller one is
    # taken for chance.
    min_scale: float = 0.3
    max_scale: float = 2.0

    def inliers(self, sizes: Values, scale: float) -> Choice:
        """Tell which whitened residuals of such sizes (N,) are worth more than a quarter."""
        return cauchy_weights(sizes, self.width * scale) > 0.25


@dataclass(frozen=True)
class PoseOptions:
    """How a pose is fitted to points."""

    loss: Loss = Loss()
    # It ends after a step that is as short, in radians (a three-hundredth of a pixel) and in units
    # of length, but not before the loss is as narrow as it will be.
    max_iterations: int = 10
    min_iterations: int = 4
    step_tolerance: float = 3e-5
    # Of depths at a known pose, for which all points are independent.
    depth_iterations: int = 4
    # In the inverse unit of length: nothing is nearer than a fifth of the distance at which
    # landmarks are taken to be at first.
    max_inverse_depth: float = 5.0


@dataclass(frozen=True)
class PoseEstimate:
    """
    R_camera_world (Rotation) and position (3,), in the unit of the depths.

    ``inverse_depths`` (N,) are the refined ones, ``sizes`` (N,) the lengths of the whitened
    residuals, ``weights`` (N,) ≤ 1 the trust in each point, ``scale`` the residuals' standard
    deviation, ``covariance`` (6, 6) that of R's rotation vector, in the camera, and of p.
    """

    R_camera_world: Rotation
    position: Vector
    inverse_depths: Values
    sizes: Values
    weights: Values
    scale: float
    covariance: Floats


def fit_pose(points: Points, R_camera_world: Rotation, position: Vector, position_sigma: float,
             options: PoseOptions, say: Values | float = 1.,
             inverse_depths: Values | None = None) -> PoseEstimate:
    """
    Return the PoseEstimate that takes Points to where they are seen.

    Minimises ``Σ v ρ_C(|W (b − y)| / s) + Σ λ (ρ − ρ0)² + |p − p0|² / σ²``, b the unit vector
    along ``R (x − ρ (p − c))``, over R, p and all ρ by Gauss–Newton with a robust Loss, narrowing.
    Each ρ is eliminated from the 6×6 normal equations (Schur complement, as in bundle adjustment);
    s is the residuals' own scale, v = ``say`` (N,) ≤ 1 the say of each point. R (Rotation),
    p0 = ``position`` (3,) and ``inverse_depths`` (N,), by default ρ0, are the start.
    """
    fit = _fit if kernels.library is None else _fit_compiled
    R, p, rho, sizes, weights, scale, H = fit(
        points, R_camera_world.as_matrix(), position,
        points.inverse_depths if inverse_depths is None else inverse_depths, position_sigma,
        options, np.broadcast_to(say, len(points)))
    return PoseEstimate(
        rotation_from_matrix(R), p, rho, sizes, weights, scale, np.linalg.inv(H))


def _fit_compiled(points: Points, R: Matrix, p: Vector, rho: Values, position_sigma: float,
                  options: PoseOptions, say: Values) -> Fit:
    loss, (sizes, weights), H = options.loss, np.empty((2, len(points))), np.empty((6, 6))
    R, p, rho, scale = R.copy(), p.copy(), rho.copy(), np.empty(1)
    kernels.library.fit_pose(
        len(points), points.x, points.origins, points.inverse_depths, points.information, points.y,
        points.sqrt_information, say, position_sigma, options.max_iterations,
        options.min_iterations, options.step_tolerance, options.max_inverse_depth, loss.width,
        loss.power, loss.wide_start, loss.min_scale, loss.max_scale, R, p, rho, sizes, weights,
        scale, H, np.empty((10, len(points))))
    return R, p, rho, sizes, weights, scale[0], H


def _fit(points: Points, R: Matrix, p: Vector, rho: Values, position_sigma: float,
         options: PoseOptions, say: Values) -> Fit:
    loss, position, information = options.loss, p, points.information
    known = np.ones(len(points))
    for iteration in range(options.max_iterations):
        r = residuals(points, R, p, rho)
        sizes = np.sqrt(np.einsum('nk,nk->n', r, r))
        expected = MEDIAN_1D + (MEDIAN_2D - MEDIAN_1D) * known
        scale = min(max(median(sizes / expected), loss.min_scale), loss.max_scale)
        widened = scale * max(1., loss.wide_start / 2 ** iteration)
        weights = cauchy_weights(sizes, loss.width * widened) ** loss.power
        H, g, H_rp, H_rr, g_r = equations(points, R, p, rho, r, say * weights / scale ** 2)
        H -= (H_rp / H_rr[:, None]).T @ H_rp
        g -= (g_r / H_rr) @ H_rp
        known = information / H_rr
        H[3:, 3:] += np.eye(3) / position_sigma ** 2
        g[3:] += (p - position) / position_sigma ** 2
        # In a quarter of NumPy's time.
        step = -cv2.solve(H, g)[1].ravel()
        # A point behind the camera has no inverse depth; at infinity it has zero.
        rho = np.clip(rho - (g_r + H_rp @ step) / H_rr, 0., options.max_inverse_depth)
        R = cv2.Rodrigues(step[:3])[0] @ R
        p = p + step[3:]
        if iteration + 1 >= options.min_iterations and np.abs(step).max() < options.step_tolerance:
            break
    return R, p, rho, sizes, weights, scale, H


def fit_depths(points: Points, pose: PoseEstimate, options: PoseOptions) -> PoseEstimate:
    """
    Return the PoseEstimate of other Points seen by the camera of a PoseEstimate.

    Only their inverse depths are fitted: they have no say in the pose.
    """
    R, p = pose.R_camera_world.as_matrix(), pose.position
    rho = depths_at(points, R, p, options)
    sizes = np.linalg.norm(residuals(points, R, p, rho), axis=1)
    return replace(pose, inverse_depths=rho, sizes=sizes,
                   weights=cauchy_weights(sizes, options.loss.width * pose.scale))


def depths_at(points: Points, R: Matrix, p: Vector, options: PoseOptions) -> Values:
    """Return the inverse depths (N,) that fit a known pose best."""
    if kernels.library is not None:
        rho = points.inverse_depths.copy()
        kernels.library.fit_depths(
            len(points), points.x, points.origins, points.inverse_depths, points.information,
            points.y, points.sqrt_information, options.depth_iterations,
            options.max_inverse_depth, R, p, rho)
        return rho
    rho, equally = points.inverse_depths, np.ones(len(points))
    for _ in range(options.depth_iterations):
        r = residuals(points, R, p, rho)
        _, _, _, H_rr, g_r = equations(points, R, p, rho, r, equally)
        rho = np.clip(rho - g_r / H_rr, 0., options.max_inverse_depth)
    return rho


def cauchy_weights(sizes: Values, width: float) -> Values:
    """Return the weights of residuals of such sizes, in (0, 1]: ½ of those as large as width."""
    return 1 / (1 + (sizes / width) ** 2)


def median(values: Values) -> float:
    """Return the upper median of values (N,), in a fifth of NumPy's time for a few hundred."""
    return np.partition(values, len(values) // 2)[len(values) // 2]


def residuals(points: Points, R: Matrix, p: Vector, rho: Values) -> Floats:
    """Return ``W (b − y)`` (N, 2), b the unit vector along ``z = R (x − ρ (p − c))``."""
    if kernels.library is not None:
        r = np.empty((len(points), 2))
        kernels.library.pose_residuals(len(points), R, p, points.x, points.origins, rho, points.y,
                                       points.sqrt_information, r)
        return r
    z = (points.x - rho[:, None] * (p - points.origins)) @ R.T
    b = z / np.linalg.norm(z, axis=1, keepdims=True)
    return np.einsum('nki,ni->nk', points.sqrt_information, b - points.y)


def equations(points: Points, R: Matrix, p: Vector, rho: Values, r: Floats,
              w: Values) -> NormalEquations:
    """
    Return the normal equations of residuals r (N, 2), weighted by w (N,), and of prior depths.

    H (6, 6) and g (6,) of the pose, H_rp (N, 6) between depths and pose, H_rr and g_r (N,) of
    the depths. ``W db = M dz`` with ``M = W (I − b bᵀ) / |z|`` and, q = p − c,
    ``dz = ω × z − ρ R dp − R q dρ``.
    """
    q = p - points.origins
    z = (points.x - rho[:, None] * q) @ R.T
    length = np.linalg.norm(z, axis=1)[:, None]
    b = z / length
    along_b = np.einsum('nki,ni->nk', points.sqrt_information, b)
    M = (points.sqrt_information - along_b[..., None] * b[:, None]) / length[..., None]
    MR = M @ R
    J = np.concatenate((np.cross(z[:, None], M), -rho[:, None, None] * MR), axis=2)
    wJ_rho = -w[:, None] * np.einsum('nki,ni->nk', MR, q)
    flat = (w[:, None, None] * J).reshape(-1, 6).T
    H_rr = points.information + np.einsum('nk,nk->n', wJ_rho, wJ_rho / w[:, None])
    g_r = (points.information * (rho - points.inverse_depths)
           + np.einsum('nk,nk->n', wJ_rho, r))
    return (flat @ J.reshape(-1, 6), flat @ r.ravel(), np.einsum('nk,nki->ni', wJ_rho, J),
            H_rr, g_r)
