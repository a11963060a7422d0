# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What the values of a video's pictures mean (ITU-T H.273), and from and to B'G'R' by that."""

from collections.abc import Sequence
from functools import cache
from typing import NamedTuple

import cv2
import numpy as np

from sph_stab_ros import kernels
from sph_stab_ros.geometry.arrays import Floats, Raster

# Code points of matrices, primaries and transfer characteristics.
UNSPECIFIED = 2
BT709, FCC, BT470BG, SMPTE170M, SMPTE240M, BT2020 = 1, 4, 5, 6, 7, 9
# By the code point of the matrix: what people call it, and the shares of R' and B' in Y'.
MATRICES = {BT709: ('BT.709', 0.2126, 0.0722), FCC: ('FCC', 0.30, 0.11),
            BT470BG: ('BT.601', 0.299, 0.114), SMPTE170M: ('BT.601', 0.299, 0.114),
            SMPTE240M: ('SMPTE 240M', 0.212, 0.087), BT2020: ('BT.2020', 0.2627, 0.0593)}
# From such a size on untagged pictures are taken to be of BT.709, as players do.
HD_WIDTH, HD_HEIGHT = 1280, 577
# Of eight bits.
BLACK, LUMA_STEPS, CHROMA_STEPS, CHROMA_ZERO = 16, 219, 224, 128
FULL_STEPS = 255
# Of pictures that have more than eight bits, in B'G'R'.
DEEP_BITS = 16
# What is written of those.
WRITTEN_BITS = 10
# Nothing is left out where linear interpolation makes a picture smaller by no more than this.
MIN_LINEAR = 0.75


class Colour(NamedTuple):
    """
    The matrix between R'G'B' and Y'CbCr, its range, and what R', G' and B' mean.

    ``assumed`` says in words what no tag does.
    """

    matrix: int
    is_full_range: bool = False
    primaries: int = UNSPECIFIED
    transfer: int = UNSPECIFIED
    assumed: str = ''


# Of pictures that are no video's: sRGB's primaries, as a video usually has them.
STANDARD = Colour(BT709, False, BT709, BT709)


def colour_of(size_wh: tuple[int, int], matrix: int, is_full_range: bool | None, primaries: int,
              transfer: int) -> Colour:
    """Return the Colour of pictures (width, height) with such tags; what is missing is assumed."""
    assumed = []
    if matrix not in MATRICES:
        unread = f' (not matrix {matrix} of H.273)' if matrix != UNSPECIFIED else ''
        matrix = likely_matrix(size_wh, primaries)
        assumed.append(MATRICES[matrix][0] + unread)
    if is_full_range is None:
        is_full_range = False
        assumed.append('limited range')
    return Colour(matrix, is_full_range, primaries, transfer, ', '.join(assumed))


def likely_matrix(size_wh: tuple[int, int], primaries: int) -> int:
    """Return the matrix that goes with the primaries, or that of most pictures of a size."""
    if primaries in MATRICES:
        return primaries
    width, height = size_wh
    return BT709 if width >= HD_WIDTH or height >= HD_HEIGHT else SMPTE170M


@cache
def yuv_from_bgr(matrix: int, is_full_range: bool, bits: int = 8, bgr_bits: int = 8) -> Floats:
    """Return (3, 4), what makes Y', Cb, Cr of so many bits out of B', G', R' of so many, and 1."""
    _, red, blue = MATRICES[matrix]
    luma = np.array((blue, 1 - red - blue, red))
    rows = np.array((luma, ((1, 0, 0) - luma) / (2 * (1 - blue)),
                     ((0, 0, 1) - luma) / (2 * (1 - red))))
    finer = 2 ** (bits - 8)
    if is_full_range:
        steps, zero = np.full(3, 2. ** bits - 1), np.array((0, CHROMA_ZERO, CHROMA_ZERO))
    else:
        steps = finer * np.array((LUMA_STEPS, CHROMA_STEPS, CHROMA_STEPS), float)
        zero = np.array((BLACK, CHROMA_ZERO, CHROMA_ZERO))
    return np.column_stack((rows * steps[:, None] / (2 ** bgr_bits - 1), finer * zero))


@cache
def bgr_from_yuv(matrix: int, is_full_range: bool, bits: int = 8, bgr_bits: int = 8) -> Floats:
    """Return (3, 4), what makes B', G', R' of so many bits out of Y', Cb, Cr of so many, and 1."""
    there = yuv_from_bgr(matrix, is_full_range, bits, bgr_bits)
    back = np.linalg.inv(there[:, :3])
    return np.column_stack((back, -back @ there[:, 3]))


def to_bgr(planes: Sequence[Raster], size_wh: tuple[int, int], colour: Colour, bits: int = 8,
           bgr_bits: int = 8) -> Raster:
    """
    Return a picture (height, width, 3) of planes Y', Cb, Cr of any size and so many bits.

    It has eight bits or, where the planes have more, ``DEEP_BITS`` if wanted.
    """
    yuv = cv2.merge([resized(plane, size_wh) for plane in planes])
    image = cv2.transform(yuv, bgr_from_yuv(colour.matrix, colour.is_full_range, bits, bgr_bits))
    # Which saturates; transform itself has the type of what it is given.
    return image if bits == 8 or bgr_bits > 8 else cv2.convertScaleAbs(image)


def from_bgr(image: Raster, colour: Colour) -> tuple[Raster, Raster, Raster]:
    """
    Return Y' (H, W), Cb and Cr (H / 2, W / 2) of a picture (H, W, 3) with even sides.

    They have eight bits or, of a picture of ``DEEP_BITS``, ten.
    """
    height, width = image.shape[:2]
    is_deep = image.dtype != np.uint8
    depths = (WRITTEN_BITS, DEEP_BITS) if is_deep else (8, 8)
    yuv = cv2.transform(image, yuv_from_bgr(colour.matrix, colour.is_full_range, *depths))
    if is_deep:
        # In full range the purest of colours have a chroma of one level more.
        np.minimum(yuv, 2 ** WRITTEN_BITS - 1, out=yuv)
    half = cv2.resize(yuv, (width // 2, height // 2), interpolation=cv2.INTER_AREA)
    return cv2.extractChannel(yuv, 0), cv2.extractChannel(half, 1), cv2.extractChannel(half, 2)


def resized(plane: Raster, size_wh: tuple[int, int]) -> Raster:
    """Return a plane at another size (width, height), or as it is."""
    height, width = plane.shape
    if (width, height) == size_wh:
        return plane
    is_half = size_wh == (2 * width, 2 * height)
    if is_half and plane.dtype == np.uint8 and kernels.library is not None:
        finer = np.empty(size_wh[::-1], np.uint8)
        kernels.library.doubled(height, width, plane, finer)
        return finer
    linear = size_wh[0] >= MIN_LINEAR * width and size_wh[1] >= MIN_LINEAR * height
    return cv2.resize(plane, size_wh, interpolation=cv2.INTER_LINEAR if linear else cv2.INTER_AREA)


@cache
def grey_from_luma(is_full_range: bool) -> Raster:
    """Return (256,) uint8, the grey value of each Y' of eight bits."""
    luma = np.arange(256.)
    grey = luma if is_full_range else (luma - BLACK) * FULL_STEPS / LUMA_STEPS
    return np.clip(np.rint(grey), 0, 255).astype(np.uint8)
