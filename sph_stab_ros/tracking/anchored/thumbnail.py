# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Coarse alignment of two tiny spheres by their grey values: a start for everything finer."""

from collections.abc import Iterator, Sequence
from functools import lru_cache
from typing import Protocol, TypeVar

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from sph_stab_ros.geometry.arrays import Bearings, Choice, Grey, Plane, Values, Vector
from sph_stab_ros.geometry.equirect import bearing_grid, pad_sphere, row_solid_angles
from sph_stab_ros.geometry.projection import Equirect
from sph_stab_ros.geometry.rotations import rotation_from_matrix

WIDTH = 64
BLUR_PX = 1.0
# Table nearer to the poles than this have no usable gradient along longitude.
MAX_LATITUDE_RAD = np.deg2rad(75)
ITERATIONS = 10
STEP_TOLERANCE_RAD = 1e-3
# Grey values are scaled to unit variance; residuals beyond this count less (Huber).
HUBER = 0.5
# Headings from which to start where nothing is known.
YAW_STARTS_RAD = np.deg2rad((0, 60, -60, 120, -120, 180))


class Thumbnail:
    """A grey sphere (H, W) reduced to 32 × 64, of zero mean and unit variance."""

    def __init__(self, grey: Grey) -> None:
        small = cv2.resize(grey, (WIDTH, WIDTH // 2), interpolation=cv2.INTER_AREA)
        margin_px = 4
        padded = pad_sphere(small.astype(np.float32), margin_px)
        blurred = cv2.GaussianBlur(padded, (0, 0), BLUR_PX)
        contrast = blurred.std()
        self.padded = (blurred - blurred.mean()) / max(contrast, 1.)
        self.margin_px = margin_px
        self.image = self.padded[margin_px:-margin_px, margin_px:-margin_px]

    def read(self, bearings: Bearings) -> Values:
        """Return the values (N,) along bearings (3, N) float32."""
        u, v = Equirect(WIDTH).pixels(*bearings)
        return cv2.remap(self.padded, u + self.margin_px, v + self.margin_px,
                         cv2.INTER_LINEAR).ravel()


class _Seen(Protocol):
    thumbnail: Thumbnail


# A keyframe, of which nothing else is asked.
Showing = TypeVar('Showing', bound=_Seen)


def align_thumbnails(reference: Thumbnail, current: Thumbnail,
                     R_current_reference: Rotation) -> Rotation:
    """
    Return the R_current_reference that makes two Thumbnails agree, starting from a guess.

    Gauss–Newton on ``Σ w ρ(I_c(R x) − I_r(x))``, inverse compositional: the gradient of the
    reference, ``∂I_r(exp(ω) x)/∂ω = x × ∇I_r``, is used throughout.
    """
    rows, weights = _rows_used()
    grid = bearing_grid(WIDTH)[rows].reshape(-1, 3).T
    J = rotation_gradient(reference.padded, reference.margin_px)[rows].reshape(-1, 3)
    expected = reference.image[rows].ravel()
    R = R_current_reference.as_matrix()
    for _ in range(ITERATIONS):
        seen = current.read(R.astype(np.float32) @ grid)
        residual = seen - expected
        w = weights * np.minimum(1, HUBER / np.maximum(np.abs(residual), 1e-6))
        weighted = w[:, None] * J
        # By singular values, because a picture may not tell of all axes.
        omega = cv2.solve(weighted.T @ J, weighted.T @ residual, flags=cv2.DECOMP_SVD)[1]
        R = R @ cv2.Rodrigues(-omega.astype(float))[0]
        if np.linalg.norm(omega) < STEP_TOLERANCE_RAD:
            break
    return rotation_from_matrix(R)


def difference(reference: Thumbnail, current: Thumbnail, R_current_reference: Rotation) -> float:
    """Return by how much two Thumbnails differ in the mean, in standard deviations of either."""
    rows, weights = _rows_used()
    grid = bearing_grid(WIDTH)[rows].reshape(-1, 3).T
    seen = current.read(R_current_reference.as_matrix().astype(np.float32) @ grid)
    return np.average(np.abs(seen - reference.image[rows].ravel()), weights=weights)


def likely_turns(keyframes: Sequence[Showing],
                 thumbnail: Thumbnail) -> list[tuple[Showing, Rotation]]:
    """Return pairs of a keyframe and R_camera_key of a Thumbnail's camera, likeliest first."""
    turns = []
    for keyframe in keyframes:
        for yaw_rad in YAW_STARTS_RAD:
            R = align_thumbnails(
                keyframe.thumbnail, thumbnail, Rotation.from_rotvec((0, yaw_rad, 0)))
            turns.append((difference(keyframe.thumbnail, thumbnail, R), keyframe, R))
    return [turn[1:] for turn in sorted(turns, key=lambda turn: turn[0])]


@lru_cache(maxsize=1)
def _rows_used() -> tuple[Choice, Values]:
    """Return the rows used and the weights (N,) of their pixels."""
    lat = np.pi / 2 - (np.arange(WIDTH // 2) + 0.5) * 2 * np.pi / WIDTH
    rows = np.abs(lat) < MAX_LATITUDE_RAD
    return rows, np.repeat(row_solid_angles(WIDTH)[rows], WIDTH).astype(np.float32)


def rotation_gradient(padded: Plane, margin_px: int) -> Plane:
    """Return x × ∇I (H, W, 3) of a padded sphere, ∇I its gradient along the sphere per radian."""
    along_u, along_v = _gradient(padded, margin_px)
    per_u, per_v = _turned_directions(along_u.shape[1])
    return along_u[..., None] * per_u + along_v[..., None] * per_v


def change_by_rotation(padded: Plane, margin_px: int, omega: Vector) -> Plane:
    """Return ω · (x × ∇I) (H, W) for a small rotation omega (3,) in a third of the time."""
    along_u, along_v = _gradient(padded, margin_px)
    per_u, per_v = (one.reshape(-1, 3) @ omega for one in _turned_directions(along_u.shape[1]))
    return along_u * per_u.reshape(along_u.shape) + along_v * per_v.reshape(along_v.shape)


def _gradient(padded: Plane, margin_px: int) -> Iterator[Plane]:
    """Return ∂I per radian of longitude and of latitude downwards, (H, W) each."""
    inside = slice(margin_px, -margin_px)
    px_per_rad = np.float32((padded.shape[1] - 2 * margin_px) / (2 * np.pi))
    return (cv2.Scharr(padded, cv2.CV_32F, *axes, scale=px_per_rad / 32)[inside, inside]
            for axes in ((1, 0), (0, 1)))


@lru_cache(maxsize=2)
def _turned_directions(width: int) -> tuple[Plane, Plane]:
    """Return x × east / cos lat and x × south, each (H, W, 3) float32, of every pixel."""
    x = bearing_grid(width)
    cos_lat = np.maximum(np.hypot(x[..., 0], x[..., 2]), 1e-3)[..., None]
    east = np.stack((x[..., 2], np.zeros_like(x[..., 0]), -x[..., 0]), axis=-1) / cos_lat
    south = np.cross(x, east)
    return south / cos_lat, -east
