# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Corners of a picture, at which landmarks may be: strong ones, apart from each other."""

from dataclasses import dataclass

import cv2
import numpy as np

from sph_stab_ros.geometry.arrays import Bearings, Grey, Mask, Pixels
from sph_stab_ros.geometry.equirect import bearings_from_pixels, pixels_from_bearings


@dataclass(frozen=True)
class CornerOptions:
    """What is a corner; pixels are those of the tracker's picture."""

    # Standard deviation of the blur against noise, and the side of the square whose gradients
    # make a corner: half a patch.
    blur_px: float = 0.8
    side_px: int = 7
    # From any other landmark: patches overlap by half at most.
    min_distance_px: int = 7
    # The smaller eigenvalue of its gradients' matrix, by that of the strongest corner: a fifth of
    # OpenCV's customary 0.01, since among plain walls many weak corners hold better than few.
    min_quality: float = 2e-3


def find_corners(grey: Grey, free: Mask, taken: Bearings, wanted: int, max_latitude_rad: float,
                 options: CornerOptions) -> Bearings:
    """
    Return bearings (N, 3) of the ``wanted`` strongest corners of a sphere (H, W), or fewer.

    J. Shi and C. Tomasi, *Good features to track*, IEEE Conference on Computer Vision and Pattern
    Recognition, 1994. They are where the sphere is ``free`` (h, w) bool, in any resolution, away
    from the poles and from bearings ``taken`` (M, 3).
    """
    width = grey.shape[1]
    mask = cv2.resize(free.astype(np.uint8), grey.shape[::-1], interpolation=cv2.INTER_NEAREST)
    edge = round(width * (0.25 - max_latitude_rad / (2 * np.pi))) + options.min_distance_px
    mask[:edge] = mask[-edge:] = 0
    mask[near_pixels(pixels_from_bearings(taken, width), width, options.min_distance_px)] = 0
    # OpenCV takes none for as many as there are.
    uv = None if wanted <= 0 else cv2.goodFeaturesToTrack(
        cv2.GaussianBlur(grey, (0, 0), options.blur_px), wanted, options.min_quality,
        options.min_distance_px, mask=mask, blockSize=options.side_px)
    return np.empty((0, 3)) if uv is None else bearings_from_pixels(uv[:, 0].astype(float), width)


def near_pixels(uv: Pixels, width: int, distance_px: int) -> Mask:
    """Return the pixels (width / 2, width) bool about so near to pixels uv (N, 2), seam or not."""
    near = np.zeros((width // 2, width), np.uint8)
    u, v = np.rint(uv).astype(int).T
    near[np.clip(v, 0, width // 2 - 1), u % width] = 1
    near = cv2.copyMakeBorder(near, 0, 0, distance_px, distance_px, cv2.BORDER_WRAP)
    # Squares as large as circles, in a thirtieth of the time.
    side = 2 * round(distance_px * np.sqrt(np.pi) / 2) + 1
    return cv2.dilate(near, np.ones((side, side), np.uint8))[:, distance_px:-distance_px] > 0
