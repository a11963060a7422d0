# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Projections given by where bearings lie in the picture; all else follows from that."""

from typing import ClassVar, Protocol, TypeVar

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from sph_stab_ros.geometry.arrays import Bearings, Grey, Mask, Pixels, Plane, Raster
from sph_stab_ros.geometry.equirect import bearing_grid
from sph_stab_ros.geometry.projection import bend, bent_cells, Picture, to_grey
from sph_stab_ros.geometry.warp import equirect_warp

# Pictures are reduced for a grey sphere so much smaller.
MIN_REDUCTION = 0.75
# Where what is not seen would lie: so far off that cells at the edge of what is seen are uneven.
OUTSIDE_PX = -10000

Self = TypeVar('Self', bound='PixelMap')


class PixelMap(Protocol):
    """
    A Projection by two maps, bearings to pixels and pixels to bearings, and what is seen.

    Wherever the first jumps or bends, at the edges of faces and of what is seen, cells are uneven
    and computed pixel by pixel. What is not seen is black.
    """

    size_wh: tuple[int, int]
    border: ClassVar[int] = cv2.BORDER_CONSTANT

    @property
    def sphere_width(self) -> int:
        """Width of an equirectangular image with as many pixels per radian."""

    def pixels(self, x: Plane, y: Plane, z: Plane) -> tuple[Plane, Plane, Mask]:
        """
        Return u, v (h, w) of bearings of any length, and which are seen.

        Pixels lie within the centres of the outermost pixels of a face, as what lies beyond them
        is another face, or nothing. Those of bearings that are not seen mean nothing.
        """

    def bearings(self, uv: Pixels) -> tuple[Bearings, Mask]:
        """Return where pixels (h, w, 2) look, unit vectors (h, w, 3), and which show anything."""

    def resized(self: Self, size_wh: tuple[int, int]) -> Self:
        """Return the projection of the picture at another size, squeezed perhaps."""

    def nodes(self, x: Plane, y: Plane, z: Plane) -> tuple[Plane, Plane, Mask]:
        """Return u, v, far outside where nothing is seen, and the uneven cells."""
        return self.nodes_at(*self.pixels(x, y, z))

    def nodes_at(self, u: Plane, v: Plane, seen: Mask) -> tuple[Plane, Plane, Mask]:
        """Return what ``nodes`` does, of pixels and of which are seen."""
        u, v = (np.where(seen, one, np.float32(OUTSIDE_PX)) for one in (u, v))
        return u, v, bent_cells(self.bend_px(u, v))

    def bend_px(self, u: Plane, v: Plane) -> Plane:
        """Return the second differences of nodes' pixels, as far as they matter."""
        return np.maximum(bend(u), bend(v))

    def read(self, image: Raster, x: Plane, y: Plane, z: Plane) -> Raster:
        """Return the values along bearings with bilinear weights, zero where nothing is seen."""
        u, v, seen = self.pixels(x, y, z)
        values = cv2.remap(image, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        values[~seen] = 0
        return values

    def grey_sphere(self, frame: Picture, width: int) -> Grey:
        """Return the picture of a Frame as a grey sphere (width / 2, width)."""
        scale = width / self.sphere_width
        if scale > MIN_REDUCTION:
            return equirect_warp(width)(to_grey(frame.image), Rotation.identity(), self)
        # What is left out of a picture much finer would flicker.
        size_wh = round(self.size_wh[0] * scale), round(self.size_wh[1] * scale)
        grey = cv2.resize(
            to_grey(frame.at_least(size_wh[0])), size_wh, interpolation=cv2.INTER_AREA)
        return equirect_warp(width)(grey, Rotation.identity(), self.resized(size_wh))

    def seen(self, width: int) -> Mask | None:
        """Return which pixels of a sphere (width / 2, width) show the world; None are all."""
        *_, seen = self.pixels(*cv2.split(bearing_grid(width)))
        if seen.all():
            return None
        # What is read across the edge of what is seen is half black.
        around = cv2.copyMakeBorder(np.uint8(seen), 0, 0, 1, 1, cv2.BORDER_WRAP)
        return cv2.erode(around, np.ones((3, 3), np.uint8))[:, 1:-1] > 0
