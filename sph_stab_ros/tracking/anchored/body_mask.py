# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The robot's own body: pixels that stand still in the camera's frame while the world turns."""

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from sph_stab_ros.geometry.arrays import Bearings, Choice, Grey, Mask, Plane
from sph_stab_ros.geometry.equirect import pad_sphere
from sph_stab_ros.geometry.projection import Equirect
from sph_stab_ros.tracking.anchored.thumbnail import change_by_rotation

# Pictures go on so far beyond their edges: what a blur and a gradient read.
MARGIN_PX = 4


@dataclass(frozen=True)
class BodyMaskOptions:
    """What is taken for the robot's body, and what for black."""

    # Of the mask, in pixels, of 2.25° each.
    width: int = 160
    # Standard deviation of the blur in these, so that gradients hold over a step.
    blur_px: float = 0.7
    # Pixels that follow less than this share of the world's rotation do not belong to the world:
    # 1 would be the world, 0 the body; a pixel that shows both is the world's.
    min_share: float = 0.35
    # Squared grey values of expected change before that is judged, and what one frame can add: ten
    # frames at least.
    min_evidence: float = 30.0
    max_evidence: float = 3.0
    # What is left of the evidence with each frame in which anything moves: of fifty frames.
    memory: float = 0.98
    # After a smaller step nothing is to be seen, after a larger one, of two pixels, not this.
    min_step_rad: float = np.deg2rad(0.1)
    max_step_rad: float = np.deg2rad(4.5)
    # What has never been brighter in grey values, over so many pixels in either direction, shows
    # nothing: compression leaves some grey in black. Nor is what is nearer to it than half a patch
    # a landmark, because it would keep to the edge.
    black_grey: int = 10
    min_black_px: int = 9
    patch_px: int = 7


class BodyMask:
    """
    Learns from frame to frame which pixels of a camera never move.

    A pixel of the world changes by ``ΔI ≈ −ω · (x × ∇I)`` as the camera turns the world by ω. The
    share of that which really happens, fitted over time, is 1 for the world and 0 for the body.
    """

    def __init__(self, options: BodyMaskOptions) -> None:
        self._options = options
        self._blurred: Plane | None = None
        self._happened = np.zeros((options.width // 2, options.width), np.float32)
        self._evidence = np.zeros_like(self._happened)
        self.mask = np.zeros(self._happened.shape, bool)

    def update(self, small: Grey, R_current_previous: Rotation | None) -> None:
        """Take in the next grey sphere, of the mask's size; without a rotation it is the first."""
        options = self._options
        blurred = cv2.GaussianBlur(
            pad_sphere(small.astype(np.float32), MARGIN_PX), (0, 0), options.blur_px)
        previous, self._blurred = self._blurred, blurred
        if previous is None or R_current_previous is None:
            return
        omega = R_current_previous.as_rotvec().astype(np.float32)
        if not options.min_step_rad < np.linalg.norm(omega) < options.max_step_rad:
            return
        inside = slice(MARGIN_PX, -MARGIN_PX)
        expected = change_by_rotation((blurred + previous) / 2, MARGIN_PX, -omega)
        change = (blurred - previous)[inside, inside]
        happened, evidence = (cv2.blur(expected * seen, (3, 3)) for seen in (change, expected))
        share = np.minimum(1, options.max_evidence / np.maximum(evidence, 1e-6))
        self._happened = options.memory * self._happened + share * happened
        self._evidence = options.memory * self._evidence + share * evidence
        still = ((self._happened < options.min_share * self._evidence)
                 & (self._evidence > options.min_evidence))
        self.mask = cv2.dilate(still.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0


class VisibleWorld:
    """
    Where a camera sees the world.

    ``used`` (H, W) bool, or everywhere, but for BodyMask and where the picture has always been
    black: what no lens shows.
    """

    def __init__(self, used: Mask | None, options: BodyMaskOptions) -> None:
        self._options = options
        self.body = BodyMask(options)
        self._used = used
        # What has never been bright so far, and where that shows nothing.
        self._dark = self._black = np.ones_like(self.body.mask)
        self._hidden = np.zeros_like(self.body.mask)

    def update(self, grey: Grey, R_current_previous: Rotation | None) -> None:
        """Take in the next grey sphere (H, W); without a rotation it is the first one."""
        small = cv2.resize(grey, self.body.mask.shape[::-1], interpolation=cv2.INTER_AREA)
        self.body.update(small, R_current_previous)
        dark = self._dark & (small <= self._options.black_grey)
        if (dark != self._dark).any():
            self._dark, self._black = dark, self._around_black(dark)
        self._hidden = self.body.mask | self._black

    def _around_black(self, dark: Mask) -> Mask:
        """Return where a sphere is dark (H, W) all around, and what is near to that, (H, W)."""
        side_px, patch_px = self._options.min_black_px, self._options.patch_px
        black = pad_sphere(dark.astype(np.uint8), side_px)
        black = cv2.morphologyEx(black, cv2.MORPH_OPEN, np.ones((side_px, side_px), np.uint8))
        black = cv2.dilate(black, np.ones((patch_px, patch_px), np.uint8))
        inside = slice(side_px, -side_px)
        return black[inside, inside] > 0

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

    def pixels_of(self, grey: Grey) -> Mask:
        """Return which pixels of a grey sphere show the world, (H, W) bool, of its own size."""
        return cv2.resize(self.pixels().astype(np.uint8), grey.shape[::-1],
                          interpolation=cv2.INTER_NEAREST) > 0


def _read(mask: Mask, bearings: Bearings) -> Choice:
    """Return the values (N,) of a mask (H, W) along bearings (N, 3)."""
    height, width = mask.shape
    columns, rows = np.rint(Equirect(width).pixels(*bearings.T.astype(np.float32))).astype(int)
    return mask[np.clip(rows, 0, height - 1), columns % width]
