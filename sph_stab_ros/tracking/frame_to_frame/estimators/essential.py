# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""
The essential matrix of matched features: eight-point RANSAC, then rotation and epipole.

H. C. Longuet-Higgins, *A computer algorithm for reconstructing a scene from two projections*,
Nature 293, 1981; bearings need no normalisation. M. A. Fischler and R. C. Bolles, *Random sample
consensus*, Communications of the ACM 24(6), 1981. R. Hartley and A. Zisserman, *Multiple View
Geometry in Computer Vision*, section 9.6, for what an essential matrix consists of.
"""

import numpy as np
from scipy.spatial.transform import Rotation

from sph_stab_ros.geometry.arrays import Choice, Floats, Matrix, Vector
from sph_stab_ros.tracking.frame_to_frame.estimators.base import (
    BearingPairs, RotationEstimate, weighted_median)

MIN_INLIERS = 16
SAMPLE_SIZE = 8
BATCH = 128
MAX_SAMPLES = 4096
CONFIDENCE = 0.999
# A match is an inlier within this of its epipolar plane: half a pixel at 640 columns.
INLIER_RAD = 5e-3


def fit_essential(pairs: BearingPairs, seed: int = 0) -> RotationEstimate | None:
    """
    Return the RotationEstimate of ``x'ᵀ E x = 0`` over matches with outliers, or None.

    The eight-point algorithm inside RANSAC, then the linear fit on all inliers, decomposed into
    the smaller of the two rotations and the epipole of which more points lie in front. At pure
    rotation every epipole solves the equation and t_current means nothing; the rotation holds.
    """
    if len(pairs) < MIN_INLIERS:
        return None
    equations = epipolar_equations(pairs)
    inliers = _ransac(pairs, equations, np.random.default_rng(seed))
    if inliers.sum() < MIN_INLIERS:
        return None
    E = linear_fit(equations[inliers])
    # The fit on all inliers is better than the sample's: let it choose its own, once.
    better = epipolar_distance(E[None], pairs)[0] < INLIER_RAD
    if better.sum() >= MIN_INLIERS:
        inliers, E = better, linear_fit(equations[better])
    R, t = decompose(E, pairs[inliers])
    residual_rad = weighted_median(
        epipolar_distance(E[None], pairs[inliers])[0], pairs.weights[inliers])
    return RotationEstimate(R, residual_rad, int(inliers.sum()), t)


def epipolar_equations(pairs: BearingPairs) -> Floats:
    """Return A (N, 9) with ``A vec(E) = x'ᵀ E x``."""
    return np.einsum('ni,nj->nij', pairs.current, pairs.previous).reshape(-1, 9)


def linear_fit(equations: Floats) -> Matrix:
    """
    Return the essential matrices (..., 3, 3) that fit equations (..., N, 9) least squares best.

    Singular values are set to (1, 1, 0).
    """
    if equations.shape[-2] > 9:
        equations = np.swapaxes(equations, -1, -2) @ equations
    E = np.linalg.svd(equations)[2][..., -1, :].reshape(*equations.shape[:-2], 3, 3)
    U, _, Vt = np.linalg.svd(E)
    return U[..., :2] @ Vt[..., :2, :]


def epipolar_distance(E: Matrix, pairs: BearingPairs) -> Floats:
    """
    Return the larger angle (K, N), in radians, of each pair's bearings to their epipolar planes.

    ``sin = |x'ᵀ E x| / |E x|``, and the same with E transposed, for matrices (K, 3, 3).
    """
    normals = E @ pairs.previous.T
    back_normals = np.swapaxes(E, 1, 2) @ pairs.current.T
    products = np.abs(np.einsum('kin,ni->kn', normals, pairs.current))
    shorter = np.minimum(np.linalg.norm(normals, axis=1), np.linalg.norm(back_normals, axis=1))
    return products / np.maximum(shorter, 1e-12)


def _ransac(pairs: BearingPairs, equations: Floats, rng: np.random.Generator) -> Choice:
    """Return the inliers (N,) bool of the best of many eight-point samples."""
    best = np.zeros(len(pairs), bool)
    samples_needed, samples = MAX_SAMPLES, 0
    while samples < samples_needed:
        chosen = rng.random((BATCH, len(pairs))).argpartition(SAMPLE_SIZE, axis=1)[:, :SAMPLE_SIZE]
        inliers = epipolar_distance(linear_fit(equations[chosen]), pairs) < INLIER_RAD
        counts = inliers.sum(axis=1)
        if counts.max() > best.sum():
            best = inliers[counts.argmax()]
            all_inliers = min(best.mean() ** SAMPLE_SIZE, 1 - 1e-9)
            samples_needed = min(MAX_SAMPLES, np.log(1 - CONFIDENCE) / np.log1p(-all_inliers))
        samples += BATCH
    return best


def decompose(E: Matrix, pairs: BearingPairs) -> tuple[Rotation, Vector]:
    """
    Return R_current_previous (Rotation) and the unit t_current (3,) of ``E = [t]× R``.

    Of the two rotations, half a turn about t apart, the smaller one; of the two signs of t the
    one that puts more of the pairs in front of both cameras.
    """
    U, _, Vt = np.linalg.svd(E)
    quarter_turn = np.array(((0., -1., 0.), (1., 0., 0.), (0., 0., 1.)))
    candidates = []
    for turn in (quarter_turn, quarter_turn.T):
        R = U @ turn @ Vt
        candidates.append(Rotation.from_matrix(R * np.sign(np.linalg.det(R))))
    R = min(candidates, key=lambda rotation: rotation.magnitude())
    t = U[:, 2]
    sign = 1. if in_front(R, t, pairs).sum() >= in_front(R, -t, pairs).sum() else -1.
    return R, sign * t


def in_front(R_current_previous: Rotation, t_current: Vector, pairs: BearingPairs) -> Choice:
    """Tell which pairs (N,) meet at positive depths along both rays, for ``X' = R X + t``."""
    x_r = R_current_previous.apply(pairs.previous)
    normal = np.cross(pairs.current, x_r)
    depth = -np.einsum('ni,ni->n', normal, np.cross(pairs.current, t_current))
    depth_current = -np.einsum('ni,ni->n', normal, np.cross(x_r, t_current))
    return (depth > 0) & (depth_current > 0)
