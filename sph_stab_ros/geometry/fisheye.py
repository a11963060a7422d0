# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""One fisheye circle in a picture, or two, as cameras with two lenses stream them."""

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TypeAlias

import cv2
import numpy as np

from sph_stab_ros.config import FisheyeConfig
from sph_stab_ros.geometry.arrays import Bearings, Faces, Grey, Mask, Pixels, Plane, Raster
from sph_stab_ros.geometry.lens_model import Lens, lens_of
from sph_stab_ros.geometry.pixel_map import NOWHERE, PixelMap
from sph_stab_ros.geometry.projection import Picture

# Relative difference of width to height up to which a picture is taken for a scaled one.
ASPECT_TOLERANCE = 0.005

# u, v and the angle off the axis.
LensPixels: TypeAlias = tuple[Plane, ...]


@dataclass(frozen=True)
class Fisheye(PixelMap):
    """The Projection of a picture with one circle, which shows what is so near to its axis."""

    size_wh: tuple[int, int]
    lens: Lens
    max_angle_rad: float

    @property
    def sphere_width(self) -> int:
        """Width of an equirectangular image with as many pixels from zenith to horizon."""
        return 4 * round(self.lens.radius_px * min(self.lens.aspect, 1))

    def pixels(self, x: Plane, y: Plane, z: Plane) -> tuple[Plane, Plane, Faces]:
        """Return u, v of bearings, and which the circle and the picture show."""
        return _shown(self.lens.pixels(cv2.merge((x, y, z))), self.size_wh, self.max_angle_rad)

    def bearings(self, uv: Pixels) -> tuple[Bearings, Mask]:
        """Return where pixels look, and which lie in the circle."""
        return _looks(self.lens, uv, self.max_angle_rad)

    def resized(self, size_wh: tuple[int, int]) -> 'Fisheye':
        """Return the projection of the picture at another size."""
        scales = np.divide(size_wh, self.size_wh).tolist()
        return Fisheye(size_wh, self.lens.scaled(*scales), self.max_angle_rad)


@dataclass(frozen=True)
class DualFisheye(PixelMap):
    """
    The Projection of a picture with a circle for each half of the sphere and a little more.

    Each bearing is read from the one of ``lenses``, front and rear, whose axis it is nearer to; in
    a band ``blend_rad`` wide along the border between the two one fades into the other. Where the
    lenses lie apart what is as far away as they are told meets there.
    """

    size_wh: tuple[int, int]
    lenses: tuple[Lens, Lens]
    max_angle_rad: float
    blend_rad: float

    @property
    def sphere_width(self) -> int:
        """Width of an equirectangular image with as many pixels from zenith to horizon."""
        return 4 * round(sum(lens.radius_px * min(lens.aspect, 1) for lens in self.lenses) / 2)

    def pixels(self, x: Plane, y: Plane, z: Plane) -> tuple[Plane, Plane, Faces]:
        """Return u, v of bearings in the circle of the nearer lens, and which it shows."""
        front, rear, share = self._both(x, y, z)
        return self._nearer(front, rear, share)

    def bearings(self, uv: Pixels) -> tuple[Bearings, Mask]:
        """Return where pixels look through the lens whose circle they are in, and which do."""
        near_front, near_rear = (
            np.linalg.norm((uv - lens.center_px) / (lens.radius_px, lens.radius_px * lens.aspect),
                           axis=-1) for lens in self.lenses)
        is_front = near_front < near_rear
        front, rear = (_looks(lens, uv, self.max_angle_rad) for lens in self.lenses)
        return (np.where(is_front[..., None], front[0], rear[0]),
                np.where(is_front, front[1], rear[1]))

    def resized(self, size_wh: tuple[int, int]) -> 'DualFisheye':
        """Return the projection of the picture at another size."""
        scales = np.divide(size_wh, self.size_wh).tolist()
        front, rear = (lens.scaled(*scales) for lens in self.lenses)
        return DualFisheye(size_wh, (front, rear), self.max_angle_rad, self.blend_rad)

    def nodes(self, x: Plane, y: Plane, z: Plane) -> tuple[Plane, Plane, Mask]:
        """Return u, v and which cells do not interpolate: also those where the lenses overlap."""
        front, rear, share = self._both(x, y, z)
        u, v, uneven = self.nodes_at(*self._nearer(front, rear, share))
        blended = np.uint8((share > 0) & (share < 1))
        return u, v, uneven | (cv2.dilate(blended, np.ones((2, 2)), anchor=(0, 0))[:-1, :-1] > 0)

    def read(self, image: Raster, x: Plane, y: Plane, z: Plane) -> Raster:
        """Return the values along bearings, where lenses overlap the mean by their shares."""
        front, rear, share = self._both(x, y, z)
        *_, face = self._nearer(front, rear, share)
        of_front, of_rear = (
            cv2.remap(image, *one[:2], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
            for one in (front, rear))
        values = cv2.blendLinear(of_front, of_rear, share, 1 - share)
        values[face == NOWHERE] = 0
        return values

    def grey_sphere(self, frame: Picture, width: int) -> Grey:
        """Return the picture of a Frame as a grey sphere, as if all was far: most of it is."""
        front, rear = (replace(lens, ahead=0.) for lens in self.lenses)
        return PixelMap.grey_sphere(replace(self, lenses=(front, rear)), frame, width)

    def _both(self, x: Plane, y: Plane, z: Plane) -> tuple[LensPixels, LensPixels, Plane]:
        """Return what each lens has of bearings, and the share (h, w) of the front lens."""
        xyz = cv2.merge((x, y, z))
        front, rear = (lens.pixels(xyz) for lens in self.lenses)
        # 1 far from the border and 0 beyond it.
        inside = (rear[2] - front[2]) / np.float32(2 * max(self.blend_rad, 1e-6))
        return front, rear, np.clip(inside + np.float32(0.5), 0, 1)

    def _nearer(self, front: LensPixels, rear: LensPixels, share: Plane
                ) -> tuple[Plane, Plane, Faces]:
        is_front = share > 0.5
        u, v, face = _shown(
            tuple(np.where(is_front, a, b) for a, b in zip(front, rear)), self.size_wh,
            self.max_angle_rad)
        return u, v, face | is_front


def _shown(pixels: LensPixels, size_wh: tuple[int, int], max_angle_rad: float
           ) -> tuple[Plane, Plane, Faces]:
    """Return u, v within a picture, and whether they are in it and not too far off the axis."""
    *uv, theta = pixels
    seen = theta <= max_angle_rad
    bounded = []
    for one, size in zip(uv, size_wh):
        seen &= (one >= -0.5) & (one <= size - 0.5)
        bounded.append(np.clip(one, 0, size - 1))
    return bounded[0], bounded[1], np.uint8(NOWHERE) * ~seen


def _looks(lens: Lens, uv: Pixels, max_angle_rad: float) -> tuple[Bearings, Mask]:
    """Return where pixels look through a lens, and which do, not too far off the axis."""
    xyz = lens.bearings(uv)
    u, v, theta = lens.pixels(xyz)
    # What no angle reaches comes back elsewhere.
    return xyz, (theta <= max_angle_rad) & (np.hypot(u - uv[..., 0], v - uv[..., 1]) < 0.01)


def fits(config: FisheyeConfig, size_wh: tuple[int, int]) -> bool:
    """Tell whether pictures (width, height) are those of a FisheyeConfig, scaled perhaps."""
    width, height = size_wh
    expected_width = height * config.width / config.height
    return (config.stretched and min(size_wh) > 0
            or abs(width - expected_width) < ASPECT_TOLERANCE * expected_width)


def lens_ahead(config: FisheyeConfig) -> float:
    """Return how far each lens is ahead of the middle, as a share of the seam's distance."""
    return config.baseline_m / 2 / config.seam_distance_m if config.seam_distance_m else 0.


@lru_cache(maxsize=8)
def dual_fisheye(config: FisheyeConfig, size_wh: tuple[int, int]) -> DualFisheye:
    """Return the DualFisheye of a FisheyeConfig for pictures (width, height) that it fits."""
    ahead = lens_ahead(config)
    # Both lenses see it.
    overlap_deg = min(config.blend_deg, config.fov_deg - 180 - 2 * np.rad2deg(np.arctan(ahead)))
    front, rear = (replace(lens_of(lens, config.model), ahead=ahead)
                   for lens in (config.front, config.rear))
    return DualFisheye(
        (config.width, config.height), (front, rear), np.deg2rad(config.fov_deg / 2),
        np.deg2rad(overlap_deg)).resized(size_wh)


@lru_cache(maxsize=8)
def single_fisheye(config: FisheyeConfig, size_wh: tuple[int, int]) -> Fisheye:
    """Return the Fisheye of a FisheyeConfig's front lens for pictures (width, height) it fits."""
    return Fisheye(
        (config.width, config.height), lens_of(config.front, config.model),
        np.deg2rad(config.fov_deg / 2)).resized(size_wh)
