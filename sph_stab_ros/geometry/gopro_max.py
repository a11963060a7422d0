# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The two tracks of a GoPro Max, one above the other: an equi-angular cube with a cut."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from sph_stab_ros.geometry.arrays import Bearings, Faces, Floats, Mask, Pixels, Plane
from sph_stab_ros.geometry.cubemap import ASPECT_TOLERANCE, Cubemap, EQUI_ANGULAR
from sph_stab_ros.geometry.pixel_map import PixelMap

MIDDLE = 1


@dataclass(frozen=True)
class Strip:
    """
    One track's picture: three faces, of which the outer ones are cut in two.

    Each half of an outer face goes on for ``twice_px / 2`` beyond the cut, where the border of the
    two lenses is: so many columns are there twice.
    """

    size_wh: tuple[int, int]
    outer_px: int
    twice_px: int


# As max2sphere of trek-view (Paul Bourke) has them, of 5.6K and 3K; they fit real pictures.
STRIPS = (Strip((4096, 1344), 1376, 64), Strip((2272, 736), 768, 32))


@dataclass(frozen=True)
class GoProMax(PixelMap):
    """The Projection of the first track of a GoPro Max above the second one."""

    size_wh: tuple[int, int]
    strip: Strip

    @property
    def sphere_width(self) -> int:
        """Width of a sphere with as many pixels around."""
        return self._cube.sphere_width

    def pixels(self, x: Plane, y: Plane, z: Plane) -> tuple[Plane, Plane, Faces]:
        """Return u, v of bearings and their faces, of which each half is one where it is cut."""
        u, v, face = self._cube.pixels(x, y, z)
        columns = (u + np.float32(0.5)) / np.float32(self._cube.size_wh[0] / 6)
        half = np.clip(columns.astype(np.int32), 0, 5)
        starts, widths = self._halves
        within = columns - half.astype(np.float32)
        u = starts[half] + within * widths[half] - np.float32(0.5)
        return u, v, face | np.uint8(8) * (half % 2).astype(np.uint8) * (half // 2 != MIDDLE)

    def bearings(self, uv: Pixels) -> tuple[Bearings, Mask]:
        """Return where pixels look; all show something, some the same as others."""
        starts, widths = self._halves
        # Each half reaches over the cut, to where the next one begins.
        cuts = (starts + widths)[:-1] + (starts[1:] - (starts + widths)[:-1]) / 2
        half = np.searchsorted(cuts, uv[..., 0] + 0.5, side='right')
        columns = half + (uv[..., 0] + 0.5 - starts[half]) / widths[half]
        return self._cube.bearings(np.stack(
            (columns * self._cube.size_wh[0] / 6 - 0.5, uv[..., 1]), axis=-1))

    def resized(self, size_wh: tuple[int, int]) -> 'GoProMax':
        """Return the projection of the picture at another size."""
        return GoProMax(size_wh, self.strip)

    @cached_property
    def _cube(self) -> Cubemap:
        """Return the Cubemap whose faces, as high as these, have neither cut nor overlap."""
        height = self.size_wh[1]
        return Cubemap((3 * height // 2, height), EQUI_ANGULAR, True)

    @cached_property
    def _halves(self) -> tuple[Floats, Floats]:
        """Return where the halves of the faces (6,) begin in a row, and how wide they are."""
        width, outer, twice = self.strip.size_wh[0], self.strip.outer_px, self.strip.twice_px
        inner = width - 2 * outer
        narrow = (outer - twice) / 2
        widths = np.array([narrow, narrow, inner / 2, inner / 2, narrow, narrow])
        left = outer + inner
        starts = np.array([0, narrow + twice, outer, outer + inner / 2, left,
                           left + narrow + twice])
        scale = self.size_wh[0] / width
        return (starts * scale).astype(np.float32), (widths * scale).astype(np.float32)


def gopro_max(size_wh: tuple[int, int]) -> GoProMax | None:
    """Return the GoProMax of pictures (width, height), None where no mode makes such."""
    width, height = size_wh
    for strip in STRIPS:
        expected = height / 2 * strip.size_wh[0] / strip.size_wh[1]
        if abs(width - expected) < ASPECT_TOLERANCE / 4 * expected:
            return GoProMax(size_wh, strip)
    return None
