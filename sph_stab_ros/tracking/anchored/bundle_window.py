# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What a window of keyframes sees, and the equations that it makes of their poses and points."""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_matrix

from sph_stab_ros import kernels
from sph_stab_ros.geometry.arrays import (
    Bearings, Choice, Floats, Indices, Matrix, Values, Vectors)
from sph_stab_ros.tracking.anchored.pose_estimation import NormalEquations


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


def pose_and_point_equations(window: Window, R: Matrix, p: Vectors, rho: Values, w: Values,
                             lenses: bool = False) -> NormalEquations:
    """
    Return the normal equations of observations weighted by w (M,), without prior inverse depths.

    H and g of the free keyframes, H_rp between points and keyframes, H_rr and g_r of the points.
    With ``lenses`` three more columns stand behind those of the keyframes: of the rotation vector
    by which the lenses should be taken ``apart``.
    """
    accumulate = _accumulate if kernels.library is None else _accumulate_compiled
    return accumulate(window, R, p, rho, w, lenses)


def eliminated(H_rp: Floats, H_rr: Values) -> Floats:
    """
    Return what points take from the keyframes' equations: ``H_rpᵀ diag(H_rr)⁻¹ H_rp`` (C, C).

    Of H_rp (P, C) and H_rr (P,), P points and C columns of keyframes.
    """
    # A product with itself takes half of the time.
    by_point = H_rp / np.sqrt(H_rr)[:, None]
    return by_point.T @ by_point


def _accumulate_compiled(window: Window, R: Matrix, p: Vectors, rho: Values, w: Values,
                         lenses: bool) -> NormalEquations:
    of_poses, points = 6 * int(window.free.sum()), len(window.x)
    columns = of_poses + 3 * lenses
    H, g, H_rp = np.zeros((columns, columns)), np.zeros(columns), np.zeros((points, columns))
    H_rr, g_r = np.zeros(points), np.zeros(points)
    kernels.library.bundle_equations(
        len(window.point), columns, of_poses if lenses else -1, window.keyframe,
        window.host[window.point], window.point,
        np.where(window.free, np.cumsum(window.free) - 1, -1), R, p, window.x, rho, window.y,
        window.sqrt_information, w, H, g, H_rp, H_rr, g_r)
    return H, g, H_rp, H_rr, g_r


def _accumulate(window: Window, R: Matrix, p: Vectors, rho: Values, w: Values,
                lenses: bool) -> NormalEquations:
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
    if lenses:
        J = np.concatenate((J, _by_lenses(window.x[window.point], M @ R[host])
                            - _by_lenses(window.y, window.sqrt_information)), axis=2)

    flat = (w[:, None, None] * J).reshape(2 * len(M), -1).T
    by_point = csr_matrix((w, (window.point, each)), shape=(len(window.x), len(M)))
    return (flat @ J.reshape(2 * len(M), -1), flat @ r.ravel(),
            by_point @ np.einsum('mkn,mk->mn', J, J_rho),
            by_point @ np.einsum('mk,mk->m', J_rho, J_rho),
            by_point @ np.einsum('mk,mk->m', J_rho, r))


def _by_lenses(bearings: Bearings, rows: Floats) -> Floats:
    """Return how rows (M, 2, 3) times bearings (M, 3) change where the lenses are taken apart."""
    side = np.where(bearings[:, 2] > 0, 0.5, -0.5)
    return side[:, None, None] * np.cross(bearings[:, None], rows)


def _rays(window: Window, R: Matrix, p: Vectors, rho: Values,
          host: Indices) -> tuple[Vectors, Vectors, Vectors]:
    """Return bearings x, offsets q and what is seen, ``z = x − ρ q``, (M, 3) in the world."""
    x = np.einsum('mij,mj->mi', R[host], window.x[window.point])
    q = p[window.keyframe] - p[host]
    return x, q, x - rho[window.point, None] * q
