# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Coarse alignment of two tiny spheres by their grey values: a start for everything finer."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Protocol, TypeVar

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from sph_stab_ros.geometry.arrays import Bearings, Choice, Grey, Plane, Values, Vector
from sph_stab_ros.geometry.equirect import bearing_grid, pad_sphere, row_solid_angles
from sph_stab_ros.geometry.projection import Equirect
from sph_stab_ros.geometry.rotations import rotation_from_matrix


@dataclass(frozen=True)
class ThumbnailOptions:
    """How thumbnails are made and aligned."""

    # In pixels, of 5.6° each: what moves by itself hardly shows, and alignment costs little.
    width: int = 64
    # Standard deviation of the blur in these: none would alias, more would hide what is small.
    blur_px: float = 1.0
    # Rows nearer to the poles than this have no usable gradient along longitude.
    max_latitude_rad: float = np.deg2rad(75)
    # At most so many; a step as short, of a hundredth of a pixel, is the last one.
    max_iterations: int = 10
    step_tolerance_rad: float = 1e-3
    # Residuals beyond this count less, in standard deviations of the picture's grey values.
    huber: float = 0.5
    # Headings from which to start where nothing is known: one of them is within 30°.
    yaw_starts_rad: tuple[float, ...] = tuple(np.deg2rad((0, 60, -60, 120, -120, 180)))


class Thumbnail:
    """
    A grey sphere (H, W) reduced to 32 × 64, of zero mean and unit variance.

    The small blurry image of G. Klein and D. Murray, *Improving the agility of keyframe-based
    SLAM*, European Conference on Computer Vision, 2008.
    """

    def __init__(self, grey: Grey, options: ThumbnailOptions) -> None:
        self.options = options
        small = cv2.resize(
            grey, (options.width, options.width // 2), interpolation=cv2.INTER_AREA)
        margin_px = 4
        padded = pad_sphere(small.astype(np.float32), margin_px)
        blurred = cv2.GaussianBlur(padded, (0, 0), options.blur_px)
        contrast = blurred.std()
        self.padded = (blurred - blurred.mean()) / max(contrast, 1.)
        self.margin_px = margin_px
        self.image = self.padded[margin_px:-margin_px, margin_px:-margin_px]

    def read(self, bearings: Bearings) -> Values:
        """Return the values (N,) along bearings (3, N) float32."""
        u, v = Equirect(self.options.width).pixels(*bearings)
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

    Gauss–Newton on ``Σ w ρ(I_c(R x) − I_r(x))``, ρ P. J. Huber's loss; inverse compositional
    (S. Baker and I. Matthews, *Lucas–Kanade 20 years on: a unifying framework*, International
    Journal of Computer Vision 56(3), 2004): the gradient of the reference,
    ``∂I_r(exp(ω) x)/∂ω = x × ∇I_r``, is used throughout.
    """
    options = reference.options
    rows, weights = _rows_used(options)
    grid = bearing_grid(options.width)[rows].reshape(-1, 3).T
    J = rotation_gradient(reference.padded, reference.margin_px)[rows].reshape(-1, 3)
    expected = reference.image[rows].ravel()
    R = R_current_reference.as_matrix()
    for _ in range(options.max_iterations):
        seen = current.read(R.astype(np.float32) @ grid)
        residual = seen - expected
        w = weights * np.minimum(1, options.huber / np.maximum(np.abs(residual), 1e-6))
        weighted = w[:, None] * J
        # By singular values, because a picture may not tell of all axes.
        omega = cv2.solve(weighted.T @ J, weighted.T @ residual, flags=cv2.DECOMP_SVD)[1]
        R = R @ cv2.Rodrigues(-omega.astype(float))[0]
        if np.linalg.norm(omega) < options.step_tolerance_rad:
            break
    return rotation_from_matrix(R)


def difference(reference: Thumbnail, current: Thumbnail, R_current_reference: Rotation) -> float:
    """Return by how much two Thumbnails differ in the mean, in standard deviations of either."""
    rows, weights = _rows_used(reference.options)
    grid = bearing_grid(reference.options.width)[rows].reshape(-1, 3).T
    seen = current.read(R_current_reference.as_matrix().astype(np.float32) @ grid)
    return np.average(np.abs(seen - reference.image[rows].ravel()), weights=weights)


def likely_turns(keyframes: Sequence[Showing],
                 thumbnail: Thumbnail) -> list[tuple[Showing, Rotation]]:
    """Return pairs of a keyframe and R_camera_key of a Thumbnail's camera, likeliest first."""
    turns = []
    for keyframe in keyframes:
        for yaw_rad in thumbnail.options.yaw_starts_rad:
            R = align_thumbnails(
                keyframe.thumbnail, thumbnail, Rotation.from_rotvec((0, yaw_rad, 0)))
            turns.append((difference(keyframe.thumbnail, thumbnail, R), keyframe, R))
    return [turn[1:] for turn in sorted(turns, key=lambda turn: turn[0])]


@lru_cache(maxsize=1)
def _rows_used(options: ThumbnailOptions) -> tuple[Choice, Values]:
    """Return the rows used and the weights (N,) of their pixels."""
    width = options.width
    lat = np.pi / 2 - (np.arange(width // 2) + 0.5) * 2 * np.pi / width
    rows = np.abs(lat) < options.max_latitude_rad
    return rows, np.repeat(row_solid_angles(width)[rows], width).astype(np.float32)


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
