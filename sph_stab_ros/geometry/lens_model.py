# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Fisheye lenses: equidistant, equisolid, with the distortion of OpenCV and Kannala–Brandt."""

from dataclasses import dataclass, replace
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from sph_stab_ros.config import EQUISOLID, LensConfig
from sph_stab_ros.geometry.arrays import Bearings, Floats, Plane
from sph_stab_ros.geometry.warp import view_rotation

Angle = TypeVar('Angle', float, Floats)


@dataclass(frozen=True)
class Lens:
    """
    A lens with up to four terms of distortion, as in OpenCV's fisheye model.

    A bearing at θ from the axis lies ``f t (1 + k1 t² + k2 t⁴ + k3 t⁶ + k4 t⁸)`` from the centre:
    t is θ, or 2 sin(θ / 2) of an equisolid lens, and f such that θ = 90° lies at ``radius_px``,
    down and up ``aspect`` times as far. The lens' frame is that of a camera: x to the right in the
    picture, y down, z along the axis. Its centre lies ``ahead`` along the axis of the middle that
    bearings are from, as a share of the distance of everything: 0 where that is infinitely far.
    """

    center_px: tuple[float, float]
    radius_px: float
    k: tuple[float, float, float, float]
    R_camera_lens: Rotation
    aspect: float = 1.
    is_equisolid: bool = False
    ahead: float = 0.

    def pixels(self, xyz: Bearings) -> tuple[Plane, Plane, Plane]:
        """
        Return u, v and the angle in radians off the axis, each (h, w), of bearings (h, w, 3).

        Bearings are float32 or float64, of any length, in the camera's frame.
        """
        x, y, z = cv2.split(cv2.transform(
            xyz, self.R_camera_lens.inv().as_matrix().astype(xyz.dtype)))
        rho = np.hypot(x, y)
        if self.ahead:
            z = z - xyz.dtype.type(self.ahead) * np.hypot(rho, z)
        theta = np.arctan2(rho, z)
        scale = self.radius_px * self._bent(self._t(theta)) / self._at_90
        # On the axis x and y are zero.
        scale /= np.maximum(rho, 1e-9)
        return (x * scale + self.center_px[0], y * scale * self.aspect + self.center_px[1], theta)

    def bearings(self, uv: ArrayLike) -> Bearings:
        """Return where pixels (..., 2) look: unit vectors (..., 3) in the camera's frame."""
        offsets = (np.asarray(uv) - self.center_px) / (1, self.aspect)
        radius = np.linalg.norm(offsets, axis=-1)
        target = radius / self.radius_px * self._at_90
        t = target.copy()
        for _ in range(10):
            t = np.clip(t - (self._bent(t) - target) / self._slope(t), 0, self._t(np.pi))
        theta = 2 * np.arcsin(np.minimum(t / 2, 1)) if self.is_equisolid else t
        xy = offsets * (np.sin(theta) / np.maximum(radius, 1e-9))[..., None]
        rays = np.concatenate((xy, np.cos(theta)[..., None]), axis=-1)
        if self.ahead:
            # On to the unit sphere around the middle.
            along = self.ahead * rays[..., 2:]
            rays = rays * (np.sqrt(along ** 2 + 1 - self.ahead ** 2) - along)
            rays[..., 2] += self.ahead
        return rays @ self.R_camera_lens.as_matrix().T

    def scaled(self, scale_u: float, scale_v: float | None = None) -> 'Lens':
        """Return the Lens in the picture scaled by a factor, or by one across and one down."""
        scale_v = scale_v or scale_u
        u, v = self.center_px
        return replace(
            self, center_px=((u + 0.5) * scale_u - 0.5, (v + 0.5) * scale_v - 0.5),
            radius_px=self.radius_px * scale_u, aspect=self.aspect * scale_v / scale_u)

    def tells_apart(self, theta_rad: float) -> bool:
        """Tell whether all up to an angle off the axis lies the further out the larger it is."""
        return bool((self._slope(self._t(np.linspace(0, theta_rad, 100))) > 0).all())

    @property
    def _at_90(self) -> float:
        return float(self._bent(self._t(np.pi / 2)))

    def _t(self, theta: Angle) -> Angle:
        return 2 * np.sin(theta / 2) if self.is_equisolid else theta

    def _bent(self, t: Angle) -> Angle:
        k1, k2, k3, k4 = self.k
        square = t * t
        return t * (1 + square * (k1 + square * (k2 + square * (k3 + k4 * square))))

    def _slope(self, t: Angle) -> Angle:
        k1, k2, k3, k4 = self.k
        square = t * t
        return 1 + square * (3 * k1 + square * (5 * k2 + square * (7 * k3 + 9 * k4 * square)))


def lens_of(config: LensConfig, model: str = '') -> Lens:
    """Return the Lens of a LensConfig and of a model, equidistant unless it is named."""
    return Lens(
        (config.center_u_px, config.center_v_px), config.radius_px,
        (config.k1, config.k2, config.k3, config.k4),
        view_rotation(*np.deg2rad((config.yaw_deg, config.pitch_deg, config.roll_deg))),
        config.aspect, model == EQUISOLID)
