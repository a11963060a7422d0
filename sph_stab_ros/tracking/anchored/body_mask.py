# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The robot's own body: pixels that stand still in the camera's frame while the world turns."""

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from sph_stab_ros.geometry.arrays import Bearings, Choice, Grey, Mask, Plane
from sph_stab_ros.geometry.equirect import pad_sphere
from sph_stab_ros.geometry.projection import Equirect
from sph_stab_ros.tracking.anchored.thumbnail import change_by_rotation

WIDTH = 160
MARGIN_PX = 4
BLUR_PX = 0.7
# Pixels that follow less than this share of the world's rotation do not belong to the world.
MIN_SHARE = 0.35
# Squared grey values of expected change before that is judged, and what one frame can add.
MIN_EVIDENCE = 30.0
MAX_EVIDENCE = 3.0
# Of the evidence per frame in which anything moves.
MEMORY = 0.98
# After a smaller step nothing is to be seen, after a larger one, of two pixels, not this.
MIN_STEP_RAD, MAX_STEP_RAD = np.deg2rad((0.1, 4.5))
# What has never been brighter, over so many pixels in either direction, shows nothing; nor is what
# is nearer to it than half a patch a landmark, because it would keep to the edge.
BLACK_GREY = 10
MIN_BLACK_PX, PATCH_PX = 9, 7


class BodyMask:
    """
    Learns from frame to frame which pixels of a camera never move.

    A pixel of the world changes by ``ΔI ≈ −ω · (x × ∇I)`` as the camera turns the world by ω. The
    share of that which really happens, fitted over time, is 1 for the world and 0 for the body.
    """

    def __init__(self) -> None:
        self._small: Plane | None = None
        self._happened = np.zeros((WIDTH // 2, WIDTH), np.float32)
        self._evidence = np.zeros_like(self._happened)
        self.mask = np.zeros(self._happened.shape, bool)

    def update(self, grey: Grey, R_current_previous: Rotation | None) -> None:
        """Take in the next grey sphere (H, W); without a rotation it is the first one."""
        small = cv2.resize(grey, (WIDTH, WIDTH // 2), interpolation=cv2.INTER_AREA)
        small = cv2.GaussianBlur(pad_sphere(small.astype(np.float32), MARGIN_PX), (0, 0), BLUR_PX)
        previous, self._small = self._small, small
        if previous is None or R_current_previous is None:
            return
        omega = R_current_previous.as_rotvec().astype(np.float32)
        if not MIN_STEP_RAD < np.linalg.norm(omega) < MAX_STEP_RAD:
            return
        inside = slice(MARGIN_PX, -MARGIN_PX)
        expected = change_by_rotation((small + previous) / 2, MARGIN_PX, -omega)
        change = (small - previous)[inside, inside]
        happened, evidence = (cv2.blur(expected * seen, (3, 3)) for seen in (change, expected))
        share = np.minimum(1, MAX_EVIDENCE / np.maximum(evidence, 1e-6))
        self._happened = MEMORY * self._happened + share * happened
        self._evidence = MEMORY * self._evidence + share * evidence
        still = (self._happened < MIN_SHARE * self._evidence) & (self._evidence > MIN_EVIDENCE)
        self.mask = cv2.dilate(still.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0


class VisibleWorld:
    """
    Where a camera sees the world.

    ``used`` (H, W) bool, or everywhere, but for BodyMask and where the picture has always been
    black: what no lens shows.
    """

    def __init__(self, used: Mask | None = None) -> None:
        self.still = BodyMask()
        self._used = used
        self._brightest = np.zeros(self.still.mask.shape, np.uint8)
        self._hidden = np.zeros_like(self.still.mask)

    def update(self, grey: Grey, R_current_previous: Rotation | None) -> None:
        """Take in the next grey sphere (H, W); without a rotation it is the first one."""
        self.still.update(grey, R_current_previous)
        small = cv2.resize(grey, self.still.mask.shape[::-1], interpolation=cv2.INTER_AREA)
        self._brightest = np.maximum(self._brightest, small)
        black = pad_sphere((self._brightest <= BLACK_GREY).astype(np.uint8), MIN_BLACK_PX)
        black = cv2.morphologyEx(black, cv2.MORPH_OPEN, np.ones((MIN_BLACK_PX,) * 2, np.uint8))
        black = cv2.dilate(black, np.ones((PATCH_PX,) * 2, np.uint8))
        inside = slice(MIN_BLACK_PX, -MIN_BLACK_PX)
        self._hidden = self.still.mask | (black[inside, inside] > 0)

    def shows(self, bearings: Bearings) -> Choice:
        """Tell along which bearings (N, 3) of the camera the world is to be seen."""
        shown = ~_read(self._hidden, bearings)
        if self._used is not None:
            shown &= _read(self._used, bearings)
        return shown

    def pixels(self) -> Mask:
        """Return which pixels of a sphere show the world, (H, W) bool of whatever size."""
        if self._used is None:
            return ~self._hidden
        rows, columns = (np.arange(size) * of // size
                         for size, of in zip(self._used.shape, self._hidden.shape))
        return self._used & ~self._hidden[np.ix_(rows, columns)]


def _read(mask: Mask, bearings: Bearings) -> Choice:
    """Return the values (N,) of a mask (H, W) along bearings (N, 3)."""
    height, width = mask.shape
    columns, rows = np.rint(Equirect(width).pixels(*bearings.T.astype(np.float32))).astype(int)
    return mask[np.clip(rows, 0, height - 1), columns % width]
