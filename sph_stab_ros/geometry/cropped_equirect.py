# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Equirectangular pictures of any size, of the sphere or of a part of it."""

from dataclasses import dataclass, replace

import cv2
import numpy as np

from sph_stab_ros.config import CropConfig
from sph_stab_ros.geometry.arrays import Bearings, Faces, Mask, Pixels, Plane, Raster
from sph_stab_ros.geometry.pixel_map import NOWHERE, PixelMap
from sph_stab_ros.geometry.projection import bend, bent_cells

# Of the sphere: narrower gaps are none.
GAP = 1e-6


@dataclass(frozen=True)
class CroppedEquirect(PixelMap):
    """
    The Projection of a picture that shows a part of an equirectangular one, in pixels of any size.

    Where its edges are, as shares of the whole width and height. ``right`` may lie beyond 1: the
    sphere goes on around.
    """

    size_wh: tuple[int, int]
    left: float = 0.
    top: float = 0.
    right: float = 1.
    bottom: float = 1.

    @property
    def sphere_width(self) -> int:
        """Width of a sphere that has no more pixels than the picture, across or down."""
        across = self.size_wh[0] / (self.right - self.left)
        down = self.size_wh[1] / (self.bottom - self.top)
        return 2 * round(min(across / 2, down))

    @property
    def is_around(self) -> bool:
        """Tell whether the picture goes on at its right edge where it begins at its left."""
        return self.right - self.left > 1 - GAP

    def pixels(self, x: Plane, y: Plane, z: Plane) -> tuple[Plane, Plane, Faces]:
        """Return u, v of bearings and which are seen."""
        u, v, face = self._unbounded(x, y, z)
        width, height = self.size_wh
        return np.clip(u, 0, width - 1), np.clip(v, 0, height - 1), face

    def bearings(self, uv: Pixels) -> tuple[Bearings, Mask]:
        """Return where pixels look; all of them show something."""
        across, down = np.moveaxis((uv + 0.5) / self.size_wh, -1, 0)
        lon = (self.left + across * (self.right - self.left) - 0.5) * (2 * np.pi)
        down_rad = (self.top + down * (self.bottom - self.top) - 0.5) * np.pi
        cos_lat = np.cos(down_rad)
        xyz = np.stack((cos_lat * np.sin(lon), np.sin(down_rad), cos_lat * np.cos(lon)), axis=-1)
        return xyz, np.ones(lon.shape, bool)

    def resized(self, size_wh: tuple[int, int]) -> 'CroppedEquirect':
        """Return the projection of the picture at another size."""
        return replace(self, size_wh=size_wh)

    def nodes(self, x: Plane, y: Plane, z: Plane) -> tuple[Plane, Plane, Mask]:
        """Return u, v and the uneven cells: at the seam, at the edges and around the poles."""
        u, v, uneven = super().nodes(x, y, z)
        if self.is_around:
            # Between the outermost columns values come from both.
            beyond = (u <= 0) | (u >= self.size_wh[0] - 1)
            uneven |= bent_cells(beyond * np.float32(self.size_wh[0]))
        return u, v, uneven

    def bend_px(self, u: Plane, v: Plane) -> Plane:
        """Return how nodes bend: towards the poles the same arc spans more and more columns."""
        down = (v + np.float32(0.5)) * np.float32((self.bottom - self.top) / self.size_wh[1])
        from_horizon = np.clip(down + np.float32(self.top - 0.5), -0.5, 0.5)
        return np.maximum(np.cos(from_horizon * np.float32(np.pi)) * bend(u), bend(v))

    def read(self, image: Raster, x: Plane, y: Plane, z: Plane) -> Raster:
        """Return the values along bearings, on around the seam where the picture is."""
        if not self.is_around:
            return super().read(image, x, y, z)
        u, v, face = self._unbounded(x, y, z)
        values = cv2.remap(image, u, np.clip(v, 0, self.size_wh[1] - 1), cv2.INTER_LINEAR,
                           borderMode=cv2.BORDER_WRAP)
        values[face == NOWHERE] = 0
        return values

    def _unbounded(self, x: Plane, y: Plane, z: Plane) -> tuple[Plane, Plane, Faces]:
        """Return u, v of bearings, up to half a pixel beyond the outermost, and which are seen."""
        across = np.arctan2(x, z) / np.float32(2 * np.pi) + np.float32(0.5 - self.left)
        across = across % 1 / np.float32(self.right - self.left)
        down = np.arctan2(y, np.hypot(x, z)) / np.float32(np.pi) + np.float32(0.5 - self.top)
        down = down / np.float32(self.bottom - self.top)
        seen = (across <= 1) & (down >= 0) & (down <= 1)
        width, height = self.size_wh
        return (across * width - np.float32(0.5), down * height - np.float32(0.5),
                np.uint8(NOWHERE) * ~seen)


def cropped_equirect(crop: CropConfig, size_wh: tuple[int, int]) -> CroppedEquirect:
    """Return the CroppedEquirect of pictures (width, height) by a CropConfig."""
    return CroppedEquirect(
        size_wh, crop.left / crop.full_width, crop.top / crop.full_height,
        (crop.left + crop.width) / crop.full_width, (crop.top + crop.height) / crop.full_height)
