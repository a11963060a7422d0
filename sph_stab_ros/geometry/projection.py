# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""How a picture shows the sphere: which of its pixels is seen along a bearing."""

from dataclasses import dataclass
from typing import ClassVar, Protocol

import cv2
import numpy as np

from sph_stab_ros import kernels
from sph_stab_ros.geometry.arrays import Grey, Image, Mask, Plane, Raster

# Of the order of cv2.remap's own fixed-point step, 1/32 px.
TOLERANCE_PX = 0.1


class Picture(Protocol):
    """What a Projection asks of a Frame, to make it a grey sphere."""

    def grey(self, width: int = 0) -> Grey:
        """Return the picture in grey; a smaller one, at least as wide as this, will do."""


class Projection(Protocol):
    """
    What InverseWarp asks of the picture that it reads from.

    Bearings come as planes x, y, z (h, w) float32, of any length, in the camera's frame.
    """

    @property
    def border(self) -> int:
        """Name what lies beyond the picture's edges, as OpenCV does."""

    @property
    def sphere_width(self) -> int:
        """Width of an equirectangular image with as many pixels per radian."""

    def nodes(self, x: Plane, y: Plane, z: Plane) -> tuple[Plane, Plane, Mask]:
        """
        Return what holds the bearings of nodes, the corners of cells.

        u, v (h, w) float32, their pixels, and (h − 1, w − 1) bool, the cells within which these
        are not to be interpolated.
        """

    def read(self, image: Raster, x: Plane, y: Plane, z: Plane) -> Raster:
        """Return the values (h, w[, C]) of the picture along bearings, exactly."""

    def grey_sphere(self, frame: Picture, width: int) -> Grey:
        """Return the picture of a Frame as a grey sphere (width / 2, width) to track in."""

    def seen(self, width: int) -> Mask | None:
        """Return which pixels of a sphere (width / 2, width) show the world; None are all."""


@dataclass(frozen=True)
class Equirect:
    """
    A sphere ``width`` wide and half as high.

    Reads wrap around at the seam. The last half pixel before a pole, where the sphere goes on
    half a turn away, shows the outermost row: padding would cost as much as a copy.
    """

    width: int
    border: ClassVar[int] = cv2.BORDER_WRAP

    @property
    def sphere_width(self) -> int:
        """Width of the image."""
        return self.width

    def pixels(self, x: Plane, y: Plane, z: Plane) -> tuple[Plane, Plane]:
        """
        Return u, v (h, w) float32 of bearings.

        ``equirect.pixels_from_bearings`` in half the time: planes instead of pairs.
        """
        if kernels.library is not None:
            u, v = np.empty((2, *x.shape), np.float32)
            kernels.library.equirect_pixels(x.size, x, y, z, self.width, u, v)
            return u, v
        rad_to_px = np.float32(self.width / (2 * np.pi))
        u = np.arctan2(x, z) * rad_to_px + np.float32(self.width / 2 - 0.5)
        v = np.arctan2(y, np.hypot(x, z)) * rad_to_px + np.float32(self.width / 4 - 0.5)
        return u, np.clip(v, 0, self.width / 2 - 1, out=v)

    def nodes(self, x: Plane, y: Plane, z: Plane) -> tuple[Plane, Plane, Mask]:
        """Return u, v and the uneven cells: at the seam and around the poles."""
        u, v = self.pixels(x, y, z)
        # Towards the poles the same arc spans more and more columns.
        lat = (v - np.float32(self.width / 4 - 0.5)) * np.float32(2 * np.pi / self.width)
        return u, v, bent_cells(np.maximum(bend(u) * np.cos(lat), bend(v)))

    def read(self, image: Raster, x: Plane, y: Plane, z: Plane) -> Raster:
        """Return the values along bearings with bilinear weights."""
        return cv2.remap(image, *self.pixels(x, y, z), cv2.INTER_LINEAR,
                         borderMode=self.border)

    def grey_sphere(self, frame: Picture, width: int) -> Grey:
        """Return the picture of a Frame as a grey one (width / 2, width)."""
        return to_grey(frame.grey(width), width)

    def seen(self, width: int) -> Mask | None:
        """Return None: the whole sphere is seen."""
        return None


def to_grey(image: Image, width: int | None = None) -> Grey:
    """Return the picture (H, W[, 3]), BGR or grey, as a grey one; a sphere at another width."""
    # Grey first: one channel is reduced in a third of the time of three.
    if image.ndim == 3:
        image = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    if width and image.shape[1] != width:
        image = cv2.resize(image, (width, width // 2), interpolation=cv2.INTER_AREA)
    return image


def bend(values: Plane) -> Plane:
    """Return the nodes' largest second difference (h, w): along u, along v, or of both added."""
    inner = values[1:-1, 1:-1]
    twice = inner + inner
    along_u = values[1:-1, :-2] + values[1:-1, 2:] - twice
    along_v = values[:-2, 1:-1] + values[2:, 1:-1] - twice
    # With opposite signs, as for longitude, the two take turns within a cell.
    largest = np.maximum(np.maximum(abs(along_u), abs(along_v)), abs(along_u + along_v))
    return cv2.copyMakeBorder(largest, 1, 1, 1, 1, cv2.BORDER_REPLICATE)


def bent_cells(bend_px: Plane) -> Mask:
    """
    Tell in which cells interpolation may miss by more than the tolerance.

    Its error is an eighth of the second differences, of which each cell takes the largest of its
    corners'.
    """
    return cv2.dilate(bend_px, np.ones((2, 2)), anchor=(0, 0))[:-1, :-1] > 8 * TOLERANCE_PX
