# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Equirectangular geometry: pixels and bearings, solid angles, padding across seam and poles."""

from functools import lru_cache
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sph_stab_ros.geometry.arrays import Bearings, Pixels, Values

Element = TypeVar('Element', bound=np.generic)


def bearings_from_pixels(uv: ArrayLike, width: int) -> Bearings:
    """
    Return unit bearings (..., 3) of pixels (..., 2), given as (u, v), in an image ``width`` wide.

    Any real ``u`` is accepted (it wraps); ``v`` beyond the image runs over the pole, as the
    sphere does.
    """
    uv = np.asarray(uv)
    px_to_rad = 2 * np.pi / width
    lon = (uv[..., 0] + 0.5) * px_to_rad - np.pi
    lat = np.pi / 2 - (uv[..., 1] + 0.5) * px_to_rad
    cos_lat = np.cos(lat)
    return np.stack((cos_lat * np.sin(lon), -np.sin(lat), cos_lat * np.cos(lon)), axis=-1)


def pixels_from_bearings(bearings: ArrayLike, width: int) -> Pixels:
    """
    Return pixels (..., 2), as (u, v), of bearings (..., 3) of any length.

    ``u`` lies in [−0.5, W − 0.5], ``v`` in [−0.5, H − 0.5]. At the poles, where longitude means
    nothing, ``u`` is the image centre's.
    """
    x, y, z = np.moveaxis(np.asarray(bearings), -1, 0)
    rad_to_px = width / (2 * np.pi)
    lon = np.arctan2(x, z)
    lat = np.arctan2(-y, np.hypot(x, z))
    u, v = (lon + np.pi) * rad_to_px - 0.5, (np.pi / 2 - lat) * rad_to_px - 0.5
    return np.stack((u, v), axis=-1)


@lru_cache(maxsize=8)
def bearing_grid(width: int) -> Bearings:
    """Return the read-only float32 bearings (W/2, W, 3) of every pixel centre."""
    v, u = np.mgrid[:width // 2, :width]
    grid = bearings_from_pixels(np.stack((u, v), axis=-1), width).astype(np.float32)
    grid.flags.writeable = False
    return grid


@lru_cache(maxsize=8)
def row_solid_angles(width: int) -> Values:
    """
    Return the solid angle (W/2,) in steradians of one pixel of each row.

    Exact, ``Δlon · Δ(sin lat)``, so that the whole image adds up to 4π.
    """
    edges_lat = np.pi / 2 - np.arange(width // 2 + 1) * (2 * np.pi / width)
    areas = 2 * np.pi / width * -np.diff(np.sin(edges_lat))
    areas.flags.writeable = False
    return areas


def pad_sphere(image: NDArray[Element], margin_px: int) -> NDArray[Element]:
    """
    Return (H, W, ...) continued by ``margin_px`` on all four sides, as the sphere goes on.

    Left and right wrap around; beyond a pole the rows come back mirrored and turned by half a
    revolution. ``W`` must be even and ``margin_px`` at most H.
    """
    height, width = image.shape[:2]
    m, half = margin_px, width // 2
    padded = np.empty((height + 2 * m, width + 2 * m, *image.shape[2:]), image.dtype)
    padded[m:m + height, m:m + width] = image
    for rows, mirrored in ((slice(0, m), image[:m][::-1]),
                           (slice(m + height, None), image[height - m:][::-1])):
        padded[rows, m:m + half] = mirrored[:, half:]
        padded[rows, m + half:m + width] = mirrored[:, :half]
    padded[:, :m] = padded[:, width:width + m]
    padded[:, m + width:] = padded[:, m:2 * m]
    return padded


def is_equirect(shape: tuple[int, ...]) -> bool:
    """Tell whether an image shape (H, W, ...) is a non-empty sphere, W = 2 H."""
    height, width = shape[:2]
    return height > 0 and width == 2 * height
