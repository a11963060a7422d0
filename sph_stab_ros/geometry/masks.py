# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Masks of pixels to use: the robot's own body, which turns with the camera, is left out."""

from pathlib import Path

import cv2
import numpy as np

from sph_stab_ros.geometry.arrays import Grey, Mask
from sph_stab_ros.geometry.equirect import is_equirect, row_solid_angles
from sph_stab_ros.geometry.projection_factory import ProjectionError

LATITUDE_PREFIX = 'lat:'


class MaskError(ValueError):
    """A mask that cannot be read; the message is one line for the user."""


def load_mask(spec: str, width: int) -> Mask | None:
    """
    Return the pixels to use (W/2, W) bool that ``spec`` describes, or None for all.

    ``spec`` is empty (all), the path of a 2:1 image whose white pixels are used, or
    ``lat:FROM,TO``, a band of latitudes in degrees that is *not* used.
    """
    if not spec:
        return None
    if spec.startswith(LATITUDE_PREFIX):
        used = _outside_latitudes(spec, width)
    else:
        image = _read_grey(spec)
        if image is None:
            raise MaskError(f"mask '{spec}' cannot be read as an image")
        if not is_equirect(image.shape):
            raise MaskError(f"mask '{spec}' is {image.shape[1]}x{image.shape[0]}, not 2:1")
        used = cv2.resize(image, (width, width // 2), interpolation=cv2.INTER_AREA) > 127
    if not used.any():
        raise MaskError(f"mask '{spec}' leaves no pixel to use")
    return used


def common(used: Mask | None, seen: Mask | None) -> Mask | None:
    """
    Return the pixels to use (H, W) of those that a picture shows; None are all.

    Raises ProjectionError where there are none.
    """
    if used is None or seen is None:
        return seen if used is None else used
    both = used & seen
    if not both.any():
        raise ProjectionError('nothing to use', 'the mask leaves no pixel of what the image shows')
    return both


def share_of_sphere(pixels: Mask) -> float:
    """Return the share of the whole solid angle that pixels (H, W) bool cover."""
    width = pixels.shape[1]
    return float(pixels.sum(axis=1) @ row_solid_angles(width) / (4 * np.pi))


def antipodal(used: Mask | None) -> Mask | None:
    """Return the pixels (H, W) of a mask whose antipodes belong to it too; None stays None."""
    if used is None:
        return None
    return used & np.roll(used[::-1], used.shape[1] // 2, axis=1)


def _read_grey(path: str) -> Grey | None:
    """Return a picture, or None where there is none that can be read."""
    try:
        # OpenCV says more than one line about a file that is not there.
        return cv2.imread(path, cv2.IMREAD_GRAYSCALE) if Path(path).is_file() else None
    except (OSError, cv2.error):
        # A name that no file can have, a folder that is closed, a picture too large for OpenCV.
        return None


def _outside_latitudes(spec: str, width: int) -> Mask:
    try:
        low_deg, high_deg = map(float, spec[len(LATITUDE_PREFIX):].split(','))
    except ValueError:
        raise MaskError(f"mask '{spec}' is not of the form lat:FROM,TO (degrees)") from None
    if not -90 <= low_deg < high_deg <= 90:
        raise MaskError(f"mask '{spec}' needs -90 <= FROM < TO <= 90")
    lat_deg = 90 - (np.arange(width // 2) + 0.5) * (360 / width)
    used_rows = (lat_deg < low_deg) | (lat_deg > high_deg)
    return np.repeat(used_rows[:, None], width, axis=1)
