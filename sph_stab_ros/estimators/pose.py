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

A point at bearing x and inverse depth ρ is seen from position p along ``R (x − ρ p)``. With ρ
unknown it says how far that is off its epipolar plane, one equation; with ρ known, two. Depths
that carry their own uncertainty need no choice between the two, nor between rotation with and
without translation.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

ITERATIONS = 10
STEP_TOLERANCE = 1e-5
# Cauchy's constant: residuals of this many standard deviations count half.
CAUCHY = 2.0
# The loss starts so many times wider and narrows by half with each iteration: what is near would
# else be an outlier to what is far before the translation is known.
WIDE_START = 4.0
# Median lengths of normal vectors of one and two dimensions: a free depth takes one away.
MEDIAN_1D, MEDIAN_2D = 0.6745, 1.1774
# No motion between two frames moves the position further; fixes what no point does.
POSITION_SIGMA = 3.0
MIN_SCALE = 1e-2


@dataclass(frozen=True)
class PoseEstimate:
    """
    Rotation R and position p (3,), in the unit of the depths.

    ``inverse_depths`` (N,) are the refined ones, ``information`` (N,) what this view told about
    them, ``weights`` (N,) ≤ 1 the trust in each point, ``scale`` the standard deviation of the
    whitened residuals, ``covariance`` (6, 6) that of the rotation vector and p.
    """

    R: Rotation
    position: np.ndarray
    inverse_depths: np.ndarray
    information: np.ndarray
    weights: np.ndarray
    scale: float
    covariance: np.ndarray


def fit_pose(x, y, whitening, inverse_depths, information, position):
    """
    Return the PoseEstimate that takes points to where they are seen.

    Minimises ``Σ ρ_C(|W (b − y)| / s) + Σ λ (ρ − ρ0)²``, b the unit vector along ``R (x − ρ p)``,
    over R, p and all ρ by Gauss–Newton with Cauchy's robust loss, narrowing, from R = I. Each ρ is
    eliminated from the 6×6 normal equations (Schur complement); s is the residuals' own scale.

    Parameters
    ----------
    x, y : (N, 3)
        Bearings at the origin, and now.
    whitening : (2, N, 3)
        W: two tangents of the sphere at y, divided by the standard deviations along them.
    inverse_depths, information : (N,)
        ρ0 and λ, its inverse variance.
    position : (3,)
        Where to start p.

    """
    R, p, rho = np.eye(3), position, inverse_depths
    known = np.ones(len(x))
    for iteration in range(ITERATIONS):
        z = (x - rho[:, None] * p) @ R.T
        length = np.sqrt(np.einsum('ni,ni->n', z, z))
        b = z / length[:, None]
        r = np.einsum('kni,ni->kn', whitening, b - y)
        size = np.sqrt(np.einsum('kn,kn->n', r, r))
        expected = MEDIAN_1D + (MEDIAN_2D - MEDIAN_1D) * known
        scale = max(np.median(size / expected), MIN_SCALE)
        width = CAUCHY * scale * max(1., WIDE_START / 2 ** iteration)
        weights = 1 / (1 + (size / width) ** 2)
        w = weights / scale ** 2

        # W db = M dz with M = W (I − b bᵀ) / |z| and dz = ω × z − ρ R dp − R p dρ.
        M = (whitening - np.einsum('kni,ni->kn', whitening, b)[..., None] * b) / length[:, None]
        zx, zy, zz = z.T
        mx, my, mz = M[..., 0], M[..., 1], M[..., 2]
        J = np.empty((6, *r.shape))
        J[0], J[1], J[2] = zy * mz - zz * my, zz * mx - zx * mz, zx * my - zy * mx
        J[3:] = -rho * np.moveaxis(M @ R, -1, 0)
        J_rho = -M @ (R @ p)

        wJ = w * J
        H_pr = np.einsum('ikn,kn->in', wJ, J_rho)
        seen = w * np.einsum('kn,kn->n', J_rho, J_rho)
        H_rr = information + seen
        known = information / H_rr
        g_r = w * np.einsum('kn,kn->n', J_rho, r) + information * (rho - inverse_depths)
        H = wJ.reshape(6, -1) @ J.reshape(6, -1).T - (H_pr / H_rr) @ H_pr.T
        H[3:, 3:] += np.eye(3) / POSITION_SIGMA ** 2
        g = wJ.reshape(6, -1) @ r.ravel() - H_pr @ (g_r / H_rr)
        step = -np.linalg.solve(H, g)
        # A point behind the camera has no inverse depth; at infinity it has zero.
        rho = np.maximum(rho - (g_r + step @ H_pr) / H_rr, 0.)
        R = Rotation.from_rotvec(step[:3]).as_matrix() @ R
        p = p + step[3:]
        if np.abs(step).max() < STEP_TOLERANCE:
            break
    return PoseEstimate(Rotation.from_matrix(R), p, rho, seen, weights, scale, np.linalg.inv(H))
