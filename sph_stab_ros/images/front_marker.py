# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""
Draw where the robot's front is, which a picture that does not turn with the robot cannot show.

The marker looks like that of an aircraft's flight path: a ring with wings, which lie along the
camera's horizon. Where the front is outside of the picture, an arrow at the border points to it.
"""

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from sph_stab_ros.geometry.arrays import Bearings, Floats, Image, Pixels, Raster
from sph_stab_ros.geometry.equirect import pixels_from_bearings
from sph_stab_ros.geometry.warp import focal_length_px, view_rotation

COLOUR_BGR = (60, 220, 255)
OUTLINE_BGR = (30, 30, 30)
# Sizes as shares of the picture's smaller side.
RADIUS = 0.03
ARROW = 0.05
SHIFT = 4
# How far to the side the wings' direction is measured.
SIDE_RAD = np.deg2rad(1)


def mark_view(image: Image, R_view_camera: Rotation, front_yaw_rad: float,
              hfov_rad: float) -> None:
    """Draw the robot's front, ``front_yaw_rad`` left of the camera's, into a pinhole view."""
    height, width = image.shape[:2]
    front, side = R_view_camera.apply(_front_and_side(front_yaw_rad))
    centre = np.array(((width - 1) / 2, (height - 1) / 2))
    if front[2] > 0:
        focal_px = focal_length_px(hfov_rad, width)
        offset = focal_px * front[:2] / front[2]
        if (abs(offset) <= centre).all():
            along = focal_px * side[:2] / side[2] - offset
            _draw_front(image, centre + offset, along)
            return
    towards = front[:2]
    # Straight behind, one way is as short as the other.
    _draw_arrow(image, centre, towards if np.linalg.norm(towards) > 1e-6 else np.array((1., 0.)))


def mark_sphere(image: Image, R_virtual_camera: Rotation, front_yaw_rad: float) -> None:
    """Draw the robot's front, ``front_yaw_rad`` left of the camera's, into a stabilised sphere."""
    width = image.shape[1]
    tip, wing = pixels_from_bearings(
        R_virtual_camera.apply(_front_and_side(front_yaw_rad)), width)
    along = wing - tip
    along[0] = (along[0] + width / 2) % width - width / 2
    # At the seam it is seen on both sides.
    for turn_px in (-width, 0, width):
        _draw_front(image, tip + (turn_px, 0), along)


def _front_and_side(front_yaw_rad: float) -> Bearings:
    """Return the bearings (2, 3) of the front and a little to its right in the camera's frame."""
    return view_rotation(front_yaw_rad).apply(
        ((0, 0, 1), (np.sin(SIDE_RAD), 0, np.cos(SIDE_RAD))))


def _draw_front(image: Image, tip: Pixels, along: Floats) -> None:
    """Draw ring, wings and fin at a pixel; the right wing points along a vector."""
    radius = max(RADIUS * min(image.shape[:2]), 4)
    x = along / np.linalg.norm(along)
    up = np.array((x[1], -x[0]))
    angles = np.linspace(0, 2 * np.pi, 49)
    ring = tip + radius * (np.cos(angles)[:, None] * x + np.sin(angles)[:, None] * up)
    lines = [ring] + [tip + radius * np.stack((direction, length * direction))
                      for direction, length in ((x, 2.4), (-x, 2.4), (up, 1.8))]
    thickness = max(round(radius / 5), 1)
    for colour, width_px in ((OUTLINE_BGR, 3 * thickness), (COLOUR_BGR, thickness)):
        cv2.polylines(image, [_fixed_point(line) for line in lines], False,
                      value(image, colour), width_px, cv2.LINE_AA, SHIFT)


def _draw_arrow(image: Image, centre: Pixels, towards: Floats) -> None:
    """Draw an arrow head just within the border that lies along a vector from the centre."""
    size = max(ARROW * min(image.shape[:2]), 7)
    forward = towards / np.linalg.norm(towards)
    aside = np.array((-forward[1], forward[0]))
    tip = centre + forward * ((centre - size / 2) / np.maximum(abs(forward), 1e-9)).min()
    head = np.stack((tip, tip - 1.6 * size * forward + size * aside,
                     tip - 1.1 * size * forward, tip - 1.6 * size * forward - size * aside))
    outline = _fixed_point(head)
    cv2.polylines(image, [outline], True, value(image, OUTLINE_BGR),
                  max(round(size / 4), 2), cv2.LINE_AA, SHIFT)
    cv2.fillPoly(image, [outline], value(image, COLOUR_BGR), cv2.LINE_AA, SHIFT)


def _fixed_point(points: Pixels) -> NDArray[np.int32]:
    """Return points (N, 2) as OpenCV takes them with fractions of a pixel."""
    return np.rint(points * (1 << SHIFT)).astype(np.int32)


def value(image: Raster, colour_bgr: tuple[int, int, int]) -> tuple[int, ...] | int:
    """Return what a colour of eight bits is in an image, which may be grey or have more bits."""
    if image.ndim == 2:
        return int(np.dot((0.114, 0.587, 0.299), colour_bgr))
    return tuple(np.iinfo(image.dtype).max // 255 * one for one in colour_bgr)
