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
Rotation and translation against points whose inverse depths are known more or less (6 DoF).

A point was first seen from the position c, at bearing x (both in the world) and inverse depth ρ;
from position p it is seen along ``R (x − ρ (p − c))``, R = R_camera_world. With ρ unknown this
says how far a bearing is off its epipolar plane, one equation; with ρ known, two. Depths that
carry their own uncertainty need no choice between the two, nor between rotation with and without
translation.
"""

from dataclasses import dataclass, fields, replace

import numpy as np
from scipy.spatial.transform import Rotation

ITERATIONS = 10
MIN_ITERATIONS = 4
STEP_TOLERANCE = 3e-5
DEPTH_ITERATIONS = 4
# Cauchy's loss, in standard deviations; four times as wide in the first iteration.
CAUCHY = 2.0
WIDE_START = 4.0
# Of the absolute value of a Gaussian in one dimension, and of its length in two.
MEDIAN_1D, MEDIAN_2D = 0.6745, 1.1774
# The residuals' scale, in the deviations expected. Where things of their own motion hold half of
# the picture it would grow until nothing is an outlier any more.
MIN_SCALE, MAX_SCALE = 0.3, 2.0
MAX_INVERSE_DEPTH = 5.0
# A scale above this says that not all of it is one scene, and other starts are tried.
DOUBTFUL_SCALE = 1.5
SECTORS = 8
SECTOR_HALF_RAD = np.deg2rad(45)
TRUNCATION = 4.0
MIN_POINTS = 20
THINNED_POINTS = 60


@dataclass(frozen=True)
class Points:
    """
    N points as known, and as seen by one camera.

    ``x`` (N, 3) are bearings in the world from the positions ``origins`` (N, 3);
    ``inverse_depths`` and ``information`` (N,) are ρ0 and its inverse variance; ``y`` (N, 3) the
    bearings seen, in the camera; ``whitening`` (2, N, 3) two tangents of the sphere at y, divided
    by the standard deviations along them.
    """

    x: np.ndarray
    origins: np.ndarray
    inverse_depths: np.ndarray
    information: np.ndarray
    y: np.ndarray
    whitening: np.ndarray

    def __len__(self):
        return len(self.x)

    def __getitem__(self, index):
        return Points(*(getattr(self, one.name)[index] for one in fields(self)[:-1]),
                      self.whitening[:, index])


@dataclass(frozen=True)
class PoseEstimate:
    """
    R_camera_world (Rotation) and position (3,), in the unit of the depths.

    ``inverse_depths`` (N,) are the refined ones, ``sizes`` (N,) the lengths of the whitened
    residuals, ``weights`` (N,) ≤ 1 the trust in each point, ``scale`` the residuals' standard
    deviation, ``covariance`` (6, 6) that of R's rotation vector, in the camera, and of p.
    """

    R_camera_world: Rotation
    position: np.ndarray
    inverse_depths: np.ndarray
    sizes: np.ndarray
    weights: np.ndarray
    scale: float
    covariance: np.ndarray


def fit_pose(points, R_camera_world, position, position_sigma, wide_start=WIDE_START,
             max_scale=MAX_SCALE):
    """
    Return the PoseEstimate that takes Points to where they are seen.

    Minimises ``Σ ρ_C(|W (b − y)| / s) + Σ λ (ρ − ρ0)² + |p − p0|² / σ²``, b the unit vector along
    ``R (x − ρ (p − c))``, over R, p and all ρ by Gauss–Newton with Cauchy's robust loss,
    narrowing. Each ρ is eliminated from the 6×6 normal equations (Schur complement); s is the
    residuals' own scale. R (Rotation), p0 = ``position`` (3,) and ρ0 are the start.
    """
    R, p, rho = R_camera_world.as_matrix(), position, points.inverse_depths
    W, information = points.whitening, points.information
    known = np.ones(len(points))
    for iteration in range(ITERATIONS):
        q = p - points.origins
        z = (points.x - rho[:, None] * q) @ R.T
        r, M = _residuals(z, points.y, W)
        sizes = np.sqrt(np.einsum('kn,kn->n', r, r))
        expected = MEDIAN_1D + (MEDIAN_2D - MEDIAN_1D) * known
        scale = np.clip(np.median(sizes / expected), MIN_SCALE, max_scale)
        weights = cauchy_weights(sizes, scale * max(1., wide_start / 2 ** iteration))
        w = weights / scale ** 2

        # W db = M dz, dz = ω × z − ρ R dp − R q dρ.
        zx, zy, zz = z.T
        mx, my, mz = M[..., 0], M[..., 1], M[..., 2]
        MR = M @ R
        J = np.empty((6, *r.shape))
        J[0], J[1], J[2] = zy * mz - zz * my, zz * mx - zx * mz, zx * my - zy * mx
        J[3:] = -rho * np.moveaxis(MR, -1, 0)
        J_rho = -np.einsum('kni,ni->kn', MR, q)

        wJ = w * J
        H_pr = np.einsum('ikn,kn->in', wJ, J_rho)
        H_rr = information + w * np.einsum('kn,kn->n', J_rho, J_rho)
        known = information / H_rr
        g_r = w * np.einsum('kn,kn->n', J_rho, r) + information * (rho - points.inverse_depths)
        H = wJ.reshape(6, -1) @ J.reshape(6, -1).T - (H_pr / H_rr) @ H_pr.T
        g = wJ.reshape(6, -1) @ r.ravel() - H_pr @ (g_r / H_rr)
        H[3:, 3:] += np.eye(3) / position_sigma ** 2
        g[3:] += (p - position) / position_sigma ** 2
        step = -np.linalg.solve(H, g)
        # A point behind the camera has no inverse depth; at infinity it has zero.
        rho = np.clip(rho - (g_r + step @ H_pr) / H_rr, 0., MAX_INVERSE_DEPTH)
        R = Rotation.from_rotvec(step[:3]).as_matrix() @ R
        p = p + step[3:]
        if iteration + 1 >= MIN_ITERATIONS and np.abs(step).max() < STEP_TOLERANCE:
            break
    return PoseEstimate(
        Rotation.from_matrix(R), p, rho, sizes, weights, scale, np.linalg.inv(H))


def fit_depths(points, pose):
    """
    Return the PoseEstimate of other Points seen by the camera of a PoseEstimate.

    Only their inverse depths are fitted: they have no say in the pose.
    """
    R = pose.R_camera_world.as_matrix()
    x, q = points.x @ R.T, (pose.position - points.origins) @ R.T
    rho = points.inverse_depths
    for _ in range(DEPTH_ITERATIONS):
        r, M = _residuals(x - rho[:, None] * q, points.y, points.whitening)
        J_rho = -np.einsum('kni,ni->kn', M, q)
        gradient = (np.einsum('kn,kn->n', J_rho, r)
                    + points.information * (rho - points.inverse_depths))
        rho = np.clip(
            rho - gradient / (points.information + np.einsum('kn,kn->n', J_rho, J_rho)),
            0., MAX_INVERSE_DEPTH)
    r, _ = _residuals(x - rho[:, None] * q, points.y, points.whitening)
    sizes = np.linalg.norm(r, axis=0)
    return replace(pose, inverse_depths=rho, sizes=sizes,
                   weights=cauchy_weights(sizes, pose.scale))


def fit_pose_among_movers(points, R_camera_world, position, position_sigma):
    """
    Return the best of several fit_pose, where much may move by itself.

    Who carries the camera, or walks beside it, holds one side of the picture: each sector of
    azimuths is left out in turn for a start.
    """
    first = fit_pose(points, R_camera_world, position, position_sigma)
    if first.scale <= DOUBTFUL_SCALE:
        return first
    # Every third point tells as well which start is good.
    some = points[::3] if len(points) > 3 * THINNED_POINTS else points
    azimuths = np.arctan2(some.y[:, 0], some.y[:, 2])
    tried = [fit_pose(some, first.R_camera_world, first.position, position_sigma,
                      wide_start=1., max_scale=1.)]
    for centre in 2 * np.pi / SECTORS * np.arange(SECTORS):
        away = np.abs((azimuths - centre + np.pi) % (2 * np.pi) - np.pi) > SECTOR_HALF_RAD
        if away.sum() < MIN_POINTS:
            continue
        start = fit_pose(some[away], R_camera_world, position, position_sigma)
        tried.append(fit_pose(some, start.R_camera_world, start.position, position_sigma,
                              wide_start=1., max_scale=1.))
    best = min(tried, key=lambda pose: np.minimum(pose.sizes, TRUNCATION).sum())
    return fit_pose(points, best.R_camera_world, best.position, position_sigma,
                    wide_start=1., max_scale=1.)


def cauchy_weights(sizes, scale):
    """Return the weights of residuals of such sizes, in (0, 1]."""
    return 1 / (1 + (sizes / (CAUCHY * scale)) ** 2)


def _residuals(z, y, whitening):
    """
    Return ``W (b − y)`` (2, N) with b along z (N, 3), and its derivative by z (2, N, 3).

    That is ``W (I − b bᵀ) / |z|``.
    """
    length = np.sqrt(np.einsum('ni,ni->n', z, z))
    b = z / length[:, None]
    r = np.einsum('kni,ni->kn', whitening, b - y)
    along = np.einsum('kni,ni->kn', whitening, b)
    return r, (whitening - along[..., None] * b) / length[:, None]
