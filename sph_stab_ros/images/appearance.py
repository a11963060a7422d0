# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""
What a picture seems to be, told by its pixels, where it is not one whole sphere.

Nothing is known of the scene. What gives a picture away is what a sphere cannot show: next to a
pole all columns of a row see the same spot; its left and right halves, or its upper and lower one,
do not see the same things; no black corners surround ellipses. Nothing is said rather than
guessed: most pictures that are no sphere are found out, and no sphere is taken for something else.
"""

from enum import Enum
from typing import NamedTuple

import cv2
import numpy as np

from sph_stab_ros.geometry.arrays import Floats, Grey, Image, Mask

# What pictures are reduced to, on their longer side.
SIDE_PX = 256
# Black, with what JPEG and limited range make of it.
BLACK = 24
# Of a side, what makes no difference.
MARGIN = 0.04
ASPECT_TOLERANCE = 0.03
# Of a border, what noise may make brighter.
BLACK_SHARE = 0.02

# Of an ellipse and of its surroundings, what is not black.
MIN_SEEN_INSIDE, MAX_SEEN_OUTSIDE = 0.7, 0.1
# How much the rows at a pole vary, against those around them: up to 1.6 at both poles of real and
# simulated spheres, to 5 at one; where there are none 2.3 in blurred pictures, 3.9 in sharp ones.
MAX_POLE_VARIATION = 2.
# How much more columns differ from their neighbours where a picture ends than in the median, and
# than anywhere else.
MIN_JUMP, MIN_JUMP_AGAINST_OTHERS = 2.5, 1.5
# The correlation of halves, in small blocks: in the median 0.4 in spheres, 0.7 in a test card, 1
# in stereo, where all but what one eye alone sees is alike.
MIN_ALIKE, MIN_ALIKE_MOSTLY = 0.85, 0.6
# Of whole halves, most of which are done with after that.
MIN_ALIKE_AT_ALL = 0.2
BLOCK_PX, MAX_DISPARITY_PX, MIN_CONTRAST, MIN_BLOCKS = 16, 6, 4., 8


class Appearance(Enum):
    """What pictures may look like that are not one whole sphere each."""

    TWO_FISHEYES = 'those of two fisheye lenses'
    FISHEYE = 'those of one fisheye lens'
    TOP_BOTTOM = 'two spheres above each other, for two eyes'
    LEFT_RIGHT = 'two spheres side by side, for two eyes'
    VR180 = 'two halves of spheres, for two eyes'
    HALF_SPHERE = 'half a sphere'
    SQUEEZED = 'spheres that are not twice as wide as high'
    BORDERS = 'spheres within black borders'


class Ellipse(NamedTuple):
    """An ellipse upright in a picture, in its pixels."""

    center_u: float
    center_v: float
    radius_u: float
    radius_v: float


class Seen(NamedTuple):
    """What a picture looks like, and how wide circles or a sphere are for their height."""

    appearance: Appearance
    squeezed: float = 1.


def reduced(picture: Image) -> Grey:
    """Return a picture, BGR or grey, as a grey one of SIDE_PX on its longer side."""
    height, width = picture.shape[:2]
    scale = SIDE_PX / max(width, height)
    small = cv2.resize(picture, (max(round(scale * width), 1), max(round(scale * height), 1)),
                       interpolation=cv2.INTER_AREA)
    return cv2.cvtColor(small, cv2.COLOR_BGR2GRAY) if small.ndim == 3 else small


def seen_in(grey: Grey) -> Seen | None:
    """Return what a ``reduced`` picture shows where that is not one whole sphere of 2:1."""
    height, width = grey.shape
    if min(grey.shape) < SIDE_PX // 8:
        return None
    halves = in_halves(grey), in_halves(grey.T)
    circles = [circle_pair(pair) for pair in halves]
    found = next(filter(None, circles), None)
    if found is not None:
        # The lower picture of two is found on its side.
        squeezed = found.radius_u / found.radius_v
        return Seen(Appearance.TWO_FISHEYES, squeezed if circles[0] else 1 / squeezed)
    circle = ellipse_in(grey > BLACK)
    if circle is not None and fills(circle, grey):
        return Seen(Appearance.FISHEYE, circle.radius_u / circle.radius_v)
    if alike(*halves[0]):
        is_whole = is_about(width / height, 4) or has_seam(halves[0][0])
        return Seen(Appearance.LEFT_RIGHT if is_whole else Appearance.VR180)
    if alike(grey[:height // 2], grey[-(height // 2):]):
        return Seen(Appearance.TOP_BOTTOM)
    if is_about(width / height, 2) and are_two_pictures(grey) or (
            is_about(height / width, 2) and are_two_pictures(grey.T)):
        return Seen(Appearance.TWO_FISHEYES)
    return _seen_in_borders(grey)


def _seen_in_borders(grey: Grey) -> Seen | None:
    """Return what is left where nothing but the borders of the picture is wrong."""
    is_sphere = is_about(grey.shape[1] / grey.shape[0], 2)
    # In a sphere there may be darkness.
    top, bottom, left, right = borders(grey, (2 if is_sphere else 1) * BLACK)
    inner = grey[top:bottom, left:right]
    if min(inner.shape) < SIDE_PX // 8:
        return None
    aspect = inner.shape[1] / inner.shape[0]
    whole = has_poles(inner) and has_seam(inner)
    if is_sphere:
        # Rows without a pole, or the back of a camera, may well be black in a sphere.
        enclosed = left > 0 and right < grey.shape[1]
        usual = is_about(aspect, 2) or is_about(aspect, 16 / 9)
        return Seen(Appearance.BORDERS) if enclosed and usual and whole else None
    if inner.shape != grey.shape and is_about(aspect, 2):
        return Seen(Appearance.BORDERS)
    if whole:
        return Seen(Appearance.SQUEEZED, aspect / 2)
    if is_about(aspect, 1) and has_poles(inner):
        return Seen(Appearance.HALF_SPHERE)
    return None


def is_about(value: float, wanted: float) -> bool:
    """Tell whether two ratios are the same, but for rounding."""
    return abs(value / wanted - 1) < ASPECT_TOLERANCE


def in_halves(grey: Grey) -> tuple[Grey, Grey]:
    """Return the left and the right half."""
    half = grey.shape[1] // 2
    return grey[:, :half], grey[:, -half:]


def ellipse_in(seen: Mask) -> Ellipse | None:
    """Return the ellipse that is filled by what is seen (H, W), with nothing seen around it."""
    rows, columns = (np.flatnonzero(seen.mean(axis) > MARGIN) for axis in (1, 0))
    if len(rows) < SIDE_PX // 8 or len(columns) < SIDE_PX // 8:
        return None
    (top, bottom), (left, right) = rows[[0, -1]], columns[[0, -1]]
    box = seen[top:bottom + 1, left:right + 1]
    # No ellipse comes nearer to the corners of its box. Most pictures are done with here.
    height, width = box.shape[0] // 8, box.shape[1] // 8
    if max(box[:height, :width].mean(), box[-height:, -width:].mean()) > MAX_SEEN_OUTSIDE:
        return None
    ellipse = Ellipse((left + right) / 2, (top + bottom) / 2,
                      (right - left + 1) / 2, (bottom - top + 1) / 2)
    v, u = np.mgrid[top:bottom + 1, left:right + 1]
    distance = np.hypot((u - ellipse.center_u) / ellipse.radius_u,
                        (v - ellipse.center_v) / ellipse.radius_v)
    if (box[distance < 0.95].mean() > MIN_SEEN_INSIDE
            and box[distance > 1.05].mean() < MAX_SEEN_OUTSIDE):
        return ellipse
    return None


def fills(ellipse: Ellipse, picture: Grey) -> bool:
    """Tell whether an ellipse is about as large as it can be in a picture."""
    return max(ellipse.radius_u, ellipse.radius_v) > 0.42 * min(picture.shape)


def circle_pair(pair: tuple[Grey, Grey]) -> Ellipse | None:
    """Return the left one of two ellipses of one size side by side."""
    one, other = (ellipse_in(half > BLACK) for half in pair)
    if one is None or other is None or not (fills(one, pair[0]) and fills(other, pair[1])):
        return None
    alike = np.isclose(one[2:], other[2:], rtol=0.1).all()
    return one if alike else None


def alike(one: Grey, other: Grey) -> bool:
    """Tell whether two pictures show the same, each detail perhaps a little to the side."""
    fine, others = map(without_coarse, (one, other))
    if correlation(fine, others) < MIN_ALIKE_AT_ALL:
        return False
    # The edges of black areas are no details.
    areas = cv2.morphologyEx(np.uint8(one <= BLACK), cv2.MORPH_OPEN, np.ones((9, 9)))
    clear = cv2.dilate(areas, np.ones((BLOCK_PX + 1, BLOCK_PX + 1))) == 0
    height, width = fine.shape
    correlations = []
    for v in range(0, height - BLOCK_PX + 1, BLOCK_PX):
        for u in range(MAX_DISPARITY_PX, width - BLOCK_PX - MAX_DISPARITY_PX + 1, BLOCK_PX):
            block = fine[v:v + BLOCK_PX, u:u + BLOCK_PX]
            if (clear[v:v + BLOCK_PX, u:u + BLOCK_PX].mean() > 0.5
                    and block.std() > MIN_CONTRAST):
                near = slice(u - MAX_DISPARITY_PX, u + BLOCK_PX + MAX_DISPARITY_PX)
                correlations.append(correlation(fine[v:v + BLOCK_PX, near],
                                                others[v:v + BLOCK_PX, near]))
    if len(correlations) < MIN_BLOCKS:
        return False
    few, half = np.percentile(correlations, (20, 50))
    return bool(half > MIN_ALIKE and few > MIN_ALIKE_MOSTLY)


def correlation(fine: Floats, others: Floats) -> float:
    """Return the correlation of two pictures where they are most alike, shifted to the side."""
    inner = fine[:, MAX_DISPARITY_PX:-MAX_DISPARITY_PX]
    return float(cv2.matchTemplate(others, inner, cv2.TM_CCOEFF_NORMED).max())


def without_coarse(grey: Grey) -> Floats:
    """Return the details of a picture."""
    values = grey.astype(np.float32)
    return values - cv2.GaussianBlur(values, (0, 0), BLOCK_PX / 4)


def pole_variation(grey: Grey) -> float:
    """Return how much the first rows vary along themselves, against from row to row."""
    first = grey[:2].mean(axis=0)
    low, high = np.percentile(first, (5, 95))
    below = np.abs(first - grey[max(grey.shape[0] // 20, 2)]).mean()
    # Noise varies everywhere.
    return float((high - low) / (below + 3))


def has_poles(grey: Grey) -> bool:
    """Tell whether the first and the last rows may be those next to the poles of a sphere."""
    return max(pole_variation(grey), pole_variation(grey[::-1])) < MAX_POLE_VARIATION


def jumps(grey: Grey) -> Floats:
    """Return how much each column (W,) differs from the one before, the first from the last."""
    values = grey.astype(np.float32)
    differences = np.abs(values - np.roll(values, 1, axis=1)).mean(axis=0)
    return differences / (np.median(differences) + 1e-3)


def has_seam(grey: Grey) -> bool:
    """Tell whether a picture goes on from its right side to its left one."""
    across = jumps(grey)
    return bool(across[0] < max(2 * MIN_JUMP, np.percentile(across, 98)))


def are_two_pictures(grey: Grey) -> bool:
    """Tell whether there are two pictures side by side, neither of which has poles."""
    if min(pole_variation(grey), pole_variation(grey[::-1])) < MAX_POLE_VARIATION:
        return False
    across = jumps(grey)
    # Half of an odd width is either column; the first one is where the sides meet.
    first, last = grey.shape[1] // 2, (grey.shape[1] + 1) // 2
    middle = across[first:last + 1].max()
    others = np.delete(across, [0, *range(first - 1, last + 2)]).max()
    return bool(middle > max(MIN_JUMP, MIN_JUMP_AGAINST_OTHERS * others) and across[0] > others)


def borders(grey: Grey, bright: float) -> tuple[int, int, int, int]:
    """Return first and last row, first and last column, behind, of what black borders enclose."""
    return *_between_black(grey, bright), *_between_black(grey.T, bright)


def _between_black(grey: Grey, bright: float) -> tuple[int, int]:
    """Return the first row, and the last one, behind, of what is within black rows and bright."""
    rows = np.flatnonzero((grey > BLACK).mean(axis=1) > BLACK_SHARE)
    if not len(rows):
        return 0, len(grey)
    first, last = int(rows[0]), int(rows[-1])
    brightness = grey.mean(axis=1)
    # The row between is of both.
    if brightness[min(first + 1, last)] < bright:
        first = 0
    if brightness[max(last - 1, first)] < bright:
        last = len(grey) - 1
    return first, last + 1
