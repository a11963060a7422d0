# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The ring where two fisheye lenses overlap: its picture by either, and corners in both."""

from collections.abc import Sequence

import cv2
import numpy as np

from sph_stab_ros.config import FisheyeConfig
from sph_stab_ros.geometry.arrays import Bearings, Choice, Grey, Pixels
from sph_stab_ros.geometry.fisheye import dual_fisheye, DualFisheye
from sph_stab_ros.geometry.lens_model import Lens

# In pictures of the ring, which are this much finer than the circles.
FINENESS = 2.
WINDOW_PX = 15
MARGIN_PX = 64
CORNERS_PER_PICTURE = 200
MIN_CORNER_DISTANCE_PX = 10
MAX_RETURN_PX = 0.5
# Contrast is made alike, but noise is not made texture.
CONTRAST_WINDOW_PX = 31
MIN_CONTRAST = 6.
# A corner that comes back may still be another one: of a real recording most were, where lenses
# were degrees off.
ALIKE_WINDOW_PX = 21
MIN_CORRELATION = 0.7


class Ring:
    """The border between the lenses as a picture: azimuth about the axis by angle towards it."""

    def __init__(self, fisheye: DualFisheye, overlap_rad: float) -> None:
        self._px_per_rad = FINENESS * fisheye.sphere_width / (2 * np.pi)
        self.width = round(2 * np.pi * self._px_per_rad)
        self.height = round(overlap_rad * self._px_per_rad)
        uv = np.meshgrid(np.arange(-MARGIN_PX, self.width + MARGIN_PX), np.arange(self.height))
        self._bearings = self.bearings(
            np.stack(uv, axis=-1).astype(float) + (MARGIN_PX, 0)).astype(np.float32)

    def bearings(self, uv: Pixels) -> Bearings:
        """Return where pixels (..., 2) look, unit vectors (..., 3)."""
        azimuth = (uv[..., 0] - MARGIN_PX) * (2 * np.pi / self.width)
        towards = ((self.height - 1) / 2 - uv[..., 1]) / self._px_per_rad
        return np.stack((np.cos(towards) * np.cos(azimuth), np.cos(towards) * np.sin(azimuth),
                         np.sin(towards)), axis=-1)

    def seen_by(self, lens: Lens, grey: Grey) -> Grey:
        """Return what a lens of the grey picture sees of the ring, its contrast made even."""
        u, v, _ = lens.pixels(self._bearings)
        seen = cv2.remap(grey, u, v, cv2.INTER_LINEAR).astype(np.float32)
        window = (CONTRAST_WINDOW_PX, CONTRAST_WINDOW_PX)
        mean = cv2.blur(seen, window)
        contrast = np.sqrt(np.maximum(cv2.blur(seen * seen, window) - mean * mean, 0))
        return np.clip(128 + 40 * (seen - mean) / np.maximum(contrast, MIN_CONTRAST),
                       0, 255).astype(np.uint8)

    def contains(self, uv: Pixels) -> Choice:
        """Tell which pixels (N, 2) lie a window within the ring, and once around."""
        reach = WINDOW_PX / 2
        return ((uv[:, 1] >= reach) & (uv[:, 1] < self.height - reach)
                & (uv[:, 0] >= MARGIN_PX) & (uv[:, 0] < MARGIN_PX + self.width))


def corners_in_both(
        greys: Sequence[Grey], config: FisheyeConfig) -> tuple[Pixels, Pixels]:
    """Return the pixels (N, 2) of corners in the front circles and in the rear ones."""
    fisheye = dual_fisheye(config, (config.width, config.height))
    ring = Ring(fisheye, np.deg2rad(config.fov_deg - 180))
    found = [np.empty((0, 2, 2))]
    for grey in greys:
        front, rear = (ring.seen_by(lens, grey) for lens in fisheye.lenses)
        corners = cv2.goodFeaturesToTrack(
            front, CORNERS_PER_PICTURE, 0.02, MIN_CORNER_DISTANCE_PX, blockSize=7)
        if corners is None:
            continue
        there = followed(front, rear, corners)
        back = followed(rear, front, there)
        uv = np.stack((corners, there), axis=1)[:, :, 0]
        returned = np.linalg.norm(back - corners, axis=-1)[:, 0] < MAX_RETURN_PX
        uv = uv[returned & ring.contains(uv[:, 0]) & ring.contains(uv[:, 1])]
        found.append(uv[alike(front, rear, uv)])
    x = ring.bearings(np.concatenate(found).astype(float))
    front_uv, rear_uv = (
        np.stack(lens.pixels(x[None, :, i])[:2], axis=-1)[0] if len(x) else np.empty((0, 2))
        for i, lens in enumerate(fisheye.lenses))
    return front_uv, rear_uv


def alike(front: Grey, rear: Grey, uv: Pixels) -> Choice:
    """Tell at which pairs of pixels (N, 2, 2) two pictures show the same, by correlation."""
    size = ALIKE_WINDOW_PX, ALIKE_WINDOW_PX
    same = []
    for pair in uv.astype(np.float32):
        a, b = (cv2.getRectSubPix(grey, size, at, patchType=cv2.CV_32F)
                for grey, at in zip((front, rear), pair))
        same.append(cv2.matchTemplate(a, b, cv2.TM_CCOEFF_NORMED)[0, 0] > MIN_CORRELATION)
    return np.array(same, bool)


def followed(before: Grey, now: Grey, corners: Pixels) -> Pixels:
    """Return where corners (N, 1, 2) of one picture are in another."""
    return cv2.calcOpticalFlowPyrLK(
        before, now, corners, None, winSize=(WINDOW_PX, WINDOW_PX), maxLevel=2)[0]
