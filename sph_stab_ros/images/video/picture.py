# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""One decoded picture of a video: upright, with square pixels, grey or in colour as asked for."""

from collections.abc import Callable
from fractions import Fraction
from functools import cached_property
import re
from typing import Any, cast, TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

from sph_stab_ros.geometry.arrays import Grey, Image, Raster
from sph_stab_ros.geometry.projection import to_grey
from sph_stab_ros.images.colour import (
    Colour, colour_of, DEEP_BITS, grey_from_luma, resized, STANDARD, to_bgr)

if TYPE_CHECKING:
    import av

LIMITED, FULL = 1, 2
GREY_FORMAT = 'gray'
# Y', Cb and Cr, or grey, in planes of eight bits or of words with more.
PLANAR_FORMAT = re.compile(r'(?:yuvj?4\d\dp|gray)(?:(9|10|12|14|16)le)?')
# What others are made, without a change of matrix or range.
OTHER_YUV, OTHER = 'yuv444p', 'bgr24'


class VideoPicture:
    """
    A picture of a video, of which no more is converted than somebody asks for.

    For tracking its luma is enough, which is there already.

    Parameters
    ----------
    picture
        As decoded, which it must stay.
    colour
        What its values mean.
    pixel_aspect
        A pixel's width divided by its height, or 0 or None where unknown.
    display_matrix
        How it is turned and mirrored, as FFmpeg says it.

    """

    def __init__(self, picture: 'av.VideoFrame', colour: Colour,
                 pixel_aspect: Fraction | None = None, display_matrix: bytes | None = None
                 ) -> None:
        self.colour = colour
        self._picture = picture
        self._square_wh = square_pixel_size(picture.width, picture.height, pixel_aspect)
        self._upright, is_transposed = orientation(picture, display_matrix)
        self.size_wh = self._square_wh[::-1] if is_transposed else self._square_wh

    @cached_property
    def image(self) -> Image:
        """Return the whole picture, (H, W, 3) uint8 in BGR order, or (H, W) where it is grey."""
        if is_grey(self._picture):
            return self.grey()
        if is_yuv(self._picture):
            return self._in_colours(8)
        width, height = self._square_wh
        image: Any = self._picture.to_ndarray(format=OTHER, width=width, height=height)
        return self._upright(image)

    @cached_property
    def deep_image(self) -> Raster | None:
        """Return the picture in 16 bits, (H, W, 3); None where it has no more than eight."""
        if is_grey(self._picture) or not is_yuv(self._picture) or self._planar[1] == 8:
            return None
        return self._in_colours(DEEP_BITS)

    def _in_colours(self, bgr_bits: int) -> Raster:
        picture, bits = self._planar
        planes = [plane_of(picture, index, bits) for index in range(3)]
        return self._upright(to_bgr(planes, self._square_wh, self.colour, bits, bgr_bits))

    def grey(self, width: int = 0) -> Grey:
        """
        Return the picture in grey, the same whether anybody looks at its colours or not.

        A whole number of times smaller where that is still as wide as wanted.
        """
        if not is_yuv(self._picture):
            return to_grey(self.image)
        picture, bits = self._planar
        times = max(self.size_wh[0] // width, 1) if width else 1
        across, down = self._square_wh
        luma = resized(plane_of(picture, 0, bits), (-(-across // times), -(-down // times)))
        if bits > 8:
            most = (2 ** bits - 1) / 255 if self.colour.is_full_range else 2 ** (bits - 8)
            luma = cv2.convertScaleAbs(luma, alpha=1 / most)
        if not self.colour.is_full_range:
            luma = cv2.LUT(luma, grey_from_luma(False))
        return self._upright(luma)

    @cached_property
    def _planar(self) -> tuple['av.VideoFrame', int]:
        """Return the picture in planes, and how many bits they have."""
        match = PLANAR_FORMAT.fullmatch(self._picture.format.name)
        if match is None:
            other = GREY_FORMAT if is_grey(self._picture) else OTHER_YUV
            return self._picture.reformat(format=other), 8
        return self._picture, int(match[1] or 8)


def range_tag(colour: Colour) -> int:
    """Return FFmpeg's number of the range of a Colour."""
    return FULL if colour.is_full_range else LIMITED


def is_grey(picture: 'av.VideoFrame') -> bool:
    """Tell whether pictures have no colours."""
    return picture.format.name.startswith(GREY_FORMAT)


def is_yuv(picture: 'av.VideoFrame') -> bool:
    """Tell whether pictures are not made of red, green and blue."""
    kind = picture.format
    return not (kind.is_rgb or kind.has_palette or kind.is_bayer)


def plane_of(picture: 'av.VideoFrame', index: int, bits: int = 8) -> NDArray[np.uint8 | np.uint16]:
    """Return a plane (H, W) of so many bits; it is the picture's own memory."""
    plane = picture.planes[index]
    kind = np.dtype(np.uint8 if bits == 8 else np.uint16)
    rows = np.frombuffer(cast(Any, plane), kind).reshape(-1, plane.line_size // kind.itemsize)
    return rows[:plane.height, :plane.width]


def tagged_colour(picture: 'av.VideoFrame', codec: 'av.VideoCodecContext') -> Colour:
    """Return the Colour of a picture, and of those after it, that ``codec`` has decoded."""
    if not is_yuv(picture):
        return STANDARD
    is_full_range = {LIMITED: False, FULL: True}.get(int(picture.color_range))
    if is_full_range is None and picture.format.name.startswith(('yuvj', GREY_FORMAT)):
        # FFmpeg's formats of full range.
        is_full_range = True
    if is_grey(picture):
        return STANDARD._replace(is_full_range=bool(is_full_range))
    return colour_of((picture.width, picture.height), int(picture.colorspace), is_full_range,
                     int(codec.color_primaries), int(codec.color_trc))


def side_data_of(picture: 'av.VideoFrame') -> dict[str, bytes]:
    """Return what FFmpeg tells of a picture besides, by its names; nothing where PyAV cannot."""
    try:
        side_data: Any = picture.side_data
        return {one.type.name: bytes(one) for one in side_data}
    except ValueError:
        # One of them is newer than PyAV.
        return {}


def orientation(picture: 'av.VideoFrame', matrix: bytes | None
                ) -> tuple[Callable[[Image], Image], bool]:
    """Return how to turn and mirror a picture by its display matrix, and whether sides change."""
    if matrix is not None:
        # What lies at (x, y) is to be shown at (a x + c y, b x + d y).
        a, b, _, c, d = np.frombuffer(matrix, np.int32, 5).tolist()
    elif picture.rotation:
        turn_rad = np.deg2rad(picture.rotation)
        a, b, c, d = np.cos(turn_rad), -np.sin(turn_rad), np.sin(turn_rad), np.cos(turn_rad)
    else:
        return lambda image: image, False
    is_transposed = abs(b) + abs(c) > abs(a) + abs(d)
    x, y = (c, b) if is_transposed else (a, d)
    rows, columns = (slice(None, None, -1 if sign < 0 else 1) for sign in (y, x))

    def upright(image: Image) -> Image:
        turned = image.swapaxes(0, 1) if is_transposed else image
        return np.ascontiguousarray(turned[rows, columns])
    return upright, is_transposed


def square_pixel_size(width: int, height: int, pixel_aspect: Fraction | float | None
                      ) -> tuple[int, int]:
    """
    Return the largest (width, height) with square pixels that invents none.

    ``pixel_aspect`` is a pixel's width divided by its height, or 0 or None where unknown.
    """
    if not pixel_aspect or pixel_aspect == 1:
        return width, height
    if pixel_aspect > 1:
        return width, round(height / pixel_aspect)
    return round(width * pixel_aspect), height
