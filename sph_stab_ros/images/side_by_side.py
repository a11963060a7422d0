# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The recorded and the stabilised sphere and views, side by side in one picture."""

from typing import Protocol

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from sph_stab_ros.geometry.arrays import Bgr, Image
from sph_stab_ros.geometry.warp import view_rotation
from sph_stab_ros.images.front_marker import value

MAX_ROW_HEIGHT_PX = 480
BACK = view_rotation(yaw_rad=np.pi)


class Stabilized(Protocol):
    """What is asked of a StabilizedFrame."""

    @property
    def R_camera_virtual(self) -> Rotation:
        """Return what turns the virtual camera's bearings into the camera's."""

    def seen_along(self, R_camera_target: Rotation, hfov_rad: float | None = None,
                   size_wh: tuple[int, int] | None = None) -> Image:
        """Return what a camera turned against this one sees: the sphere, or a perspective view."""


def side_by_side(stabilized: Stabilized, R_virtual_view: Rotation, hfov_rad: float) -> Bgr:
    """
    Return a picture (2 h, 4 h, 3) BGR of a StabilizedFrame: above as recorded, below stabilised.

    Each row shows the sphere and the perspective views to the front (``R_virtual_view``) and to
    the back; h is the height of the sphere, at most 480 pixels. In the upper row the views are
    fixed to the camera and in the lower row to the virtual camera.
    """
    rows = []
    for name, R_camera_row in (('recorded', Rotation.identity()),
                               ('stabilised', stabilized.R_camera_virtual)):
        sphere = stabilized.seen_along(R_camera_row)
        height_px = min(sphere.shape[0], MAX_ROW_HEIGHT_PX) // 2 * 2
        sphere = cv2.resize(sphere, (2 * height_px, height_px), interpolation=cv2.INTER_AREA)
        views = [stabilized.seen_along(R_camera_row * R_virtual_view * R_view, hfov_rad,
                                       (height_px, height_px))
                 for R_view in (Rotation.identity(), BACK)]
        rows.append(np.hstack([
            labelled(as_bgr(picture), label) for picture, label in
            zip((sphere, *views), (name, f'{name}, front', f'{name}, back'))]))
    return np.vstack(rows)


def as_bgr(image: Image) -> Bgr:
    """Return a BGR or grey image as BGR."""
    return cv2.cvtColor(image, cv2.COLOR_GRAY2BGR) if image.ndim == 2 else image


def labelled(picture: Bgr, text: str) -> Bgr:
    """Write ``text`` into the upper left corner of a picture, and return it."""
    scale = picture.shape[0] / 640
    origin = (round(14 * scale), round(34 * scale))
    for colour, thickness in (((0, 0, 0), 4), ((255, 255, 255), 1)):
        cv2.putText(picture, text, origin, cv2.FONT_HERSHEY_SIMPLEX, max(scale, 0.4),
                    value(picture, colour), max(1, round(thickness * max(scale, 0.5))),
                    cv2.LINE_AA)
    return picture
