# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""
Rolling shutter: a picture that is read row by row, or column by column, while the camera turns.

Bearings, orientations and stamps are those of the middle of the read-out. What then lies along a
bearing is seen along another one, by as much of the camera's turn as its row is early or late.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from sph_stab_ros.config import (
    COLUMNS, DUAL_FISHEYE, LEFT_RIGHT, NOT_JOINED, StabilizerConfig)
from sph_stab_ros.geometry.arrays import Bearings, Grey, Mask, Plane, Raster, Vector
from sph_stab_ros.geometry.equirect import bearing_grid, pixels_from_bearings
from sph_stab_ros.geometry.projection import Picture, Projection

# Wide enough to take the nearest pixel: it is off by a thousandth of the read-out at most.
SHARES_WIDTH = 640


def readout_shares(projection: Projection, size_wh: tuple[int, int],
                   config: StabilizerConfig = StabilizerConfig()) -> Plane:
    """
    Return when directions are read from a picture (width, height): (320, 640), from -½ to ½.

    The pixels of a sphere, in shares of the read-out before or after its middle.
    """
    x, y, z = cv2.split(bearing_grid(SHARES_WIDTH))
    axis = 0 if config.tracker.rolling_shutter_by == COLUMNS else 1
    at_px = projection.nodes(x, y, z)[axis]
    lenses = lenses_along(size_wh, config)[axis]
    share = (at_px + np.float32(0.5)) * np.float32(lenses / size_wh[axis])
    # Two lenses have a sensor each, which are read at the same time.
    return np.clip(share - np.clip(np.floor(share), 0, lenses - 1) - np.float32(0.5), -0.5, 0.5)


def lenses_along(size_wh: tuple[int, int], config: StabilizerConfig) -> tuple[int, int]:
    """Return how many lenses' pictures a picture (width, height) holds across, and down."""
    if config.join != NOT_JOINED:
        return (2, 1) if config.join == LEFT_RIGHT else (1, 2)
    if config.projection == DUAL_FISHEYE:
        return (2, 1) if size_wh[0] > size_wh[1] else (1, 2)
    return 1, 1


def shares_along(shares: Plane, bearings: Bearings) -> Plane:
    """Return when bearings (..., 3) are read (...), by ``readout_shares``."""
    u, v = np.moveaxis(np.rint(pixels_from_bearings(bearings, SHARES_WIDTH)).astype(int), -1, 0)
    return shares[np.clip(v, 0, SHARES_WIDTH // 2 - 1), u % SHARES_WIDTH]


def rate_at_end(rate: Vector, rate_before: Vector) -> Vector:
    """
    Return the rate (3,) at the end of an interval, of the mean ones in it and the one before.

    To the second order, of intervals that are equally long.
    """
    return 1.5 * rate - 0.5 * rate_before


@dataclass(frozen=True)
class RollingShutter:
    """
    A Projection read row by row, while the camera turns by the rotation vector ``turn`` (3,).

    In the camera's own frame, from the first row to the last; ``shares`` are its
    ``readout_shares``.
    """

    projection: Projection
    shares: Plane
    turn: Vector

    @property
    def border(self) -> int:
        """Name what lies beyond the picture's edges, as OpenCV does."""
        return self.projection.border

    @property
    def sphere_width(self) -> int:
        """Width of an equirectangular image with as many pixels per radian."""
        return self.projection.sphere_width

    def nodes(self, x: Plane, y: Plane, z: Plane) -> tuple[Plane, Plane, Mask]:
        """Return what holds the bearings of nodes, as Projection does."""
        return self.projection.nodes(*self._as_read(x, y, z))

    def read(self, image: Raster, x: Plane, y: Plane, z: Plane) -> Raster:
        """Return the values along bearings."""
        return self.projection.read(image, *self._as_read(x, y, z))

    def grey_sphere(self, frame: Picture, width: int) -> Grey:
        """Return the picture of a Frame as a grey sphere, as it was read."""
        return self.projection.grey_sphere(frame, width)

    def seen(self, width: int) -> Mask | None:
        """Return which pixels of a sphere show the world."""
        return self.projection.seen(width)

    def _as_read(self, x: Plane, y: Plane, z: Plane) -> tuple[Plane, Plane, Plane]:
        share = shares_along(self.shares, np.stack((x, y, z), axis=-1))
        # bearing - share * cross(turn, bearing)
        a, b, c = (share * np.float32(one) for one in self.turn)
        return x - (b * z - c * y), y - (c * x - a * z), z - (a * y - b * x)
