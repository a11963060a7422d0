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

from sph_stab_ros.geometry.arrays import Bearings, Faces, Grey, Mask, Pixels, Plane, Raster
from sph_stab_ros.geometry.equirect import bearing_grid
from sph_stab_ros.geometry.projection import bend, bent_cells, Picture
from sph_stab_ros.geometry.warp import equirect_warp

# Pictures are reduced for a grey sphere so much smaller.
MIN_REDUCTION = 0.75
# The face of what is on none, and where that would lie in the picture: outside.
NOWHERE = 255
OUTSIDE_PX = -10000
# By so many pixels of a sphere the mask keeps off the edge of what is seen.
MARGIN_PX = 1.5

Self = TypeVar('Self', bound='PixelMap')


class PixelMap(Protocol):
    """
    A Projection by two maps, bearings to pixels and pixels to bearings, and what is seen.

    A picture may have several faces, between which the first map jumps. Cells across the edges of
    faces and of what is seen, and those within which the map bends, are uneven and computed pixel
    by pixel. What is on no face is not seen and black.
    """

    size_wh: tuple[int, int]
    border: ClassVar[int] = cv2.BORDER_CONSTANT

    @property
    def sphere_width(self) -> int:
        """Width of an equirectangular image with as many pixels per radian."""

    def pixels(self, x: Plane, y: Plane, z: Plane) -> tuple[Plane, Plane, Faces]:
        """
        Return u, v (h, w) of bearings of any length, and on which face they are, if on any.

        Pixels lie within the centres of the outermost pixels of a face, as what lies beyond them
        is another face, or nothing. Those of bearings that are on none mean nothing.
        """

    def bearings(self, uv: Pixels) -> tuple[Bearings, Mask]:
        """Return where pixels (h, w, 2) look, unit vectors (h, w, 3), and which show anything."""

    def resized(self: Self, size_wh: tuple[int, int]) -> Self:
        """Return the projection of the picture at another size, squeezed perhaps."""

    def nodes(self, x: Plane, y: Plane, z: Plane) -> tuple[Plane, Plane, Mask]:
        """Return u, v, outside where nothing is seen, and the uneven cells."""
        return self.nodes_at(*self.pixels(x, y, z))

    def nodes_at(self, u: Plane, v: Plane, face: Faces) -> tuple[Plane, Plane, Mask]:
        """Return what ``nodes`` does, of pixels and their faces."""
        u, v = (np.where(face == NOWHERE, np.float32(OUTSIDE_PX), one) for one in (u, v))
        first = face[:-1, :-1]
        uneven = (first != face[:-1, 1:]) | (first != face[1:, :-1]) | (first != face[1:, 1:])
        return u, v, uneven | bent_cells(self.bend_px(u, v))

    def bend_px(self, u: Plane, v: Plane) -> Plane:
        """Return the second differences of nodes' pixels, as far as they matter."""
        return np.maximum(bend(u), bend(v))

    def read(self, image: Raster, x: Plane, y: Plane, z: Plane) -> Raster:
        """Return the values along bearings with bilinear weights, zero where nothing is seen."""
        u, v, face = self.pixels(x, y, z)
        values = cv2.remap(image, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        values[face == NOWHERE] = 0
        return values

    def grey_sphere(self, frame: Picture, width: int) -> Grey:
        """Return the picture of a Frame as a grey sphere (width / 2, width)."""
        scale = width / self.sphere_width
        if scale > MIN_REDUCTION:
            return equirect_warp(width)(frame.grey(), Rotation.identity(), self)
        # What is left out of a picture much finer would flicker.
        size_wh = round(self.size_wh[0] * scale), round(self.size_wh[1] * scale)
        grey = cv2.resize(frame.grey(size_wh[0]), size_wh, interpolation=cv2.INTER_AREA)
        return equirect_warp(width)(grey, Rotation.identity(), self.resized(size_wh))

    def seen(self, width: int) -> Mask | None:
        """Return which pixels of a sphere (width / 2, width) show the world; None are all."""
        x = bearing_grid(width)
        step = np.float32(MARGIN_PX * 2 * np.pi / width)
        seen = np.ones(x.shape[:2], bool)
        # Off by that in any direction it is still seen.
        for nudge in np.concatenate((np.zeros((1, 3)), np.eye(3), -np.eye(3))):
            *_, face = self.pixels(*cv2.split(x + step * nudge.astype(np.float32)))
            seen &= face != NOWHERE
        return None if seen.all() else seen
