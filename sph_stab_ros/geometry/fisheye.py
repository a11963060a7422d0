# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Two fisheye circles in one picture, as cameras with two lenses stream them."""

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from sph_stab_ros.config import FisheyeConfig, LensConfig
from sph_stab_ros.geometry.arrays import Bearings, Floats, Grey, Mask, Plane, Raster
from sph_stab_ros.geometry.projection import bend, bent_cells, Picture
from sph_stab_ros.geometry.warp import equirect_warp, view_rotation

# Relative difference of width to height up to which a picture is taken for a scaled one.
ASPECT_TOLERANCE = 0.005
# Pictures are reduced for a grey sphere so much smaller.
MIN_REDUCTION = 0.75

Angle = TypeVar('Angle', float, Floats)


@dataclass(frozen=True)
class Lens:
    """
    An equidistant lens with two terms of distortion, as in OpenCV's fisheye model.

    A bearing at θ from the axis lies ``f θ (1 + k1 θ² + k2 θ⁴)`` from the centre, where f is such
    that θ = 90° lies at ``radius_px``. The lens' frame is that of a camera: x to the right in the
    picture, y down, z along the axis.
    """

    center_px: tuple[float, float]
    radius_px: float
    k1: float
    k2: float
    R_camera_lens: Rotation

    def pixels(self, xyz: Bearings) -> tuple[Plane, Plane, Plane]:
        """
        Return u, v and the angle in radians off the axis, each (h, w), of bearings (h, w, 3).

        Bearings are float32 or float64, of any length, in the camera's frame.
        """
        x, y, z = cv2.split(cv2.transform(
            xyz, self.R_camera_lens.inv().as_matrix().astype(xyz.dtype)))
        rho = np.hypot(x, y)
        theta = np.arctan2(rho, z)
        scale = self.radius_px * self._bent(theta) / self._bent(np.pi / 2)
        # On the axis x and y are zero.
        scale /= np.maximum(rho, 1e-9)
        return x * scale + self.center_px[0], y * scale + self.center_px[1], theta

    def bearings(self, uv: ArrayLike) -> Bearings:
        """Return where pixels (..., 2) look: unit vectors (..., 3) in the camera's frame."""
        offsets = np.asarray(uv) - self.center_px
        radius = np.linalg.norm(offsets, axis=-1)
        target = radius / self.radius_px * self._bent(np.pi / 2)
        theta = target.copy()
        for _ in range(10):
            slope = 1 + 3 * self.k1 * theta ** 2 + 5 * self.k2 * theta ** 4
            theta = np.clip(theta - (self._bent(theta) - target) / slope, 0, np.pi)
        xy = offsets * (np.sin(theta) / np.maximum(radius, 1e-9))[..., None]
        rays = np.concatenate((xy, np.cos(theta)[..., None]), axis=-1)
        return rays @ self.R_camera_lens.as_matrix().T

    def scaled(self, scale: float) -> 'Lens':
        """Return the Lens in the picture scaled by a factor."""
        u, v = ((one + 0.5) * scale - 0.5 for one in self.center_px)
        return replace(self, center_px=(u, v), radius_px=self.radius_px * scale)

    def _bent(self, theta: Angle) -> Angle:
        square = theta * theta
        return theta * (1 + square * (self.k1 + self.k2 * square))


class DualFisheye:
    """
    The Projection of a picture with a circle for each half of the sphere and a little more.

    Parameters
    ----------
    front, rear : Lens
        Each bearing is read from the lens whose axis it is nearer to.
    blend_rad : float
        Width of the band along the border between the two within which one fades into the other.

    """

    border = cv2.BORDER_REPLICATE

    def __init__(self, front: Lens, rear: Lens, blend_rad: float) -> None:
        self.lenses = front, rear
        self.blend_rad = blend_rad

    @property
    def sphere_width(self) -> int:
        """Width of an equirectangular image with as many pixels from zenith to horizon."""
        return 4 * round(sum(lens.radius_px for lens in self.lenses) / 2)

    def nodes(self, x: Plane, y: Plane, z: Plane) -> tuple[Plane, Plane, Mask]:
        """Return u, v and which cells do not interpolate: those where the lenses overlap."""
        xyz = cv2.merge((x, y, z))
        front, rear = (lens.pixels(xyz) for lens in self.lenses)
        share = self._share(front, rear)
        u, v = (np.where(share > 0.5, a, b) for a, b in zip(front[:2], rear[:2]))
        blended = np.uint8((share > 0) & (share < 1))
        uneven = cv2.dilate(blended, np.ones((2, 2)), anchor=(0, 0))[:-1, :-1] > 0
        return u, v, uneven | bent_cells(np.maximum(bend(u), bend(v)))

    def read(self, image: Raster, x: Plane, y: Plane, z: Plane) -> Raster:
        """Return the values along bearings, where lenses overlap the mean by their shares."""
        xyz = cv2.merge((x, y, z))
        front, rear = (lens.pixels(xyz) for lens in self.lenses)
        share = self._share(front, rear)
        values = (cv2.remap(image, *one[:2], cv2.INTER_LINEAR, borderMode=self.border)
                  for one in (front, rear))
        return cv2.blendLinear(*values, share, 1 - share)

    def grey_sphere(self, frame: Picture, width: int) -> Grey:
        """Return the picture of a Frame as a grey sphere (width / 2, width)."""
        grey = frame.grey()
        scale = width / self.sphere_width
        if scale > MIN_REDUCTION:
            return equirect_warp(width)(grey, Rotation.identity(), self)
        # What is left out of a picture much finer would flicker.
        grey = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        return equirect_warp(width)(grey, Rotation.identity(), self.scaled(scale))

    def scaled(self, scale: float) -> 'DualFisheye':
        """Return the DualFisheye of the picture scaled by a factor."""
        front, rear = (lens.scaled(scale) for lens in self.lenses)
        return DualFisheye(front, rear, self.blend_rad)

    def _share(self, front: tuple[Plane, ...], rear: tuple[Plane, ...]) -> Plane:
        """Return the share (h, w) of the front lens, 1 far from the border and 0 beyond it."""
        inside = (rear[2] - front[2]) / np.float32(2 * max(self.blend_rad, 1e-6))
        return np.clip(inside + np.float32(0.5), 0, 1)


def fits(config: FisheyeConfig, size_wh: tuple[int, int]) -> bool:
    """Tell whether pictures (width, height) are those of a FisheyeConfig, scaled perhaps."""
    width, height = size_wh
    expected_width = height * config.width / config.height
    return abs(width - expected_width) < ASPECT_TOLERANCE * expected_width


@lru_cache(maxsize=8)
def dual_fisheye(config: FisheyeConfig, size_wh: tuple[int, int]) -> DualFisheye:
    """Return the DualFisheye of a FisheyeConfig for pictures (width, height) that it fits."""
    # Both lenses see it.
    overlap_deg = min(config.blend_deg, config.fov_deg - 180)
    return DualFisheye(
        lens_of(config.front), lens_of(config.rear), np.deg2rad(overlap_deg)).scaled(
            size_wh[0] / config.width)


def lens_of(config: LensConfig) -> Lens:
    """Return the Lens of a LensConfig."""
    return Lens(
        (config.center_u_px, config.center_v_px), config.radius_px, config.k1, config.k2,
        view_rotation(*np.deg2rad((config.yaw_deg, config.pitch_deg, config.roll_deg))))
