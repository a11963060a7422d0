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
from typing import Any, cast

import cv2
import numpy as np
from numpy.typing import NDArray

from sph_stab_ros.geometry.arrays import Grey, Image
from sph_stab_ros.images.colour import (
    BT2020, BT470BG, BT709, Colour, colour_of, SMPTE170M, STANDARD)
from sph_stab_ros.recording.pyav import av

LIMITED, FULL = 1, 2
# Of eight bits each, in planes, the first of which is luma.
LUMA_FORMATS = {f'{family}{sampling}p' for family in ('yuv', 'yuvj')
                for sampling in ('410', '411', '420', '422', '440', '444')} | {'nv12', 'nv21'}
GREY_FORMAT = 'gray'
# Luma of limited range, 16 for black and 235 for white, as grey.
FROM_LIMITED = np.clip(np.rint((np.arange(256.) - 16) * 255 / 219), 0, 255).astype(np.uint8)
# Of swscale's, not all of which PyAV 15 names. By default it truncates, which makes pictures darker.
BILINEAR, AREA, ROUNDED = 0x2, 0x20, 0x40000


class VideoPicture:
    """
    A picture of a video, of which no more is converted than somebody asks for.

    For tracking luma is enough, which is there already. Colours are made of three planes, which
    is twice as fast as swscale's own way to packed ones where that is exact.

    Parameters
    ----------
    picture
        As decoded, which it must stay.
    pixel_aspect
        A pixel's width divided by its height, or 0 or None where unknown.
    colour
        What its values mean.
    display_matrix
        How it is turned and mirrored, as FFmpeg says it.

    """

    def __init__(self, picture: av.VideoFrame, pixel_aspect: Fraction | None, colour: Colour,
                 display_matrix: bytes | None = None) -> None:
        self._picture = picture
        self._colour = colour
        self._square_wh = square_pixel_size(picture.width, picture.height, pixel_aspect)
        self._upright, is_transposed = orientation(picture, display_matrix)
        self.size_wh = self._square_wh[::-1] if is_transposed else self._square_wh

    @cached_property
    def image(self) -> Image:
        """Return the whole picture, (H, W, 3) uint8 in BGR order, or (H, W) where it is grey."""
        if self._picture.format.name == GREY_FORMAT:
            return self.at_least(0)
        if self._picture.format.is_rgb:
            return self._upright(self._converted('bgr24').to_ndarray())
        green, blue, red = (plane_of(self._converted('gbrp'), index) for index in range(3))
        return self._upright(cv2.merge((blue, green, red)))

    def at_least(self, width: int) -> Grey:
        """Return the picture in grey, the same whether anybody looks at its colours or not."""
        name = self._picture.format.name
        if name not in LUMA_FORMATS and name != GREY_FORMAT:
            return self._upright(plane_of(self._converted('gray'), 0))
        luma = plane_of(self._picture, 0)
        if not self._colour.is_full_range:
            luma = cv2.LUT(luma, FROM_LIMITED)
        if luma.shape != self._square_wh[::-1]:
            luma = cv2.resize(luma, self._square_wh, interpolation=cv2.INTER_AREA)
        return self._upright(luma)

    def _converted(self, name: str) -> av.VideoFrame:
        """Return the picture in another format of full range."""
        width, height = self._square_wh
        return converted(self._picture, name, self._colour, True, width=width, height=height)


def converted(picture: av.VideoFrame, name: str, colour: Colour, from_yuv: bool, **size: int
              ) -> av.VideoFrame:
    """Return a picture in another format: from or to Y'CbCr of a Colour, to or from R'G'B'."""
    # swscale knows the two of BT.601 by one number, and the others by those of H.273.
    matrix = BT470BG if colour.matrix == SMPTE170M else colour.matrix
    # R'G'B' has none, but PyAV before 17 heeds these only where they differ.
    other = BT709 if matrix == BT2020 else BT2020
    yuv, rgb = (matrix, range_tag(colour)), (other, FULL)
    (source, source_range), (target, target_range) = (yuv, rgb) if from_yuv else (rgb, yuv)
    return picture.reformat(
        format=name, src_colorspace=source, src_color_range=source_range,
        dst_colorspace=target, dst_color_range=target_range,
        interpolation=ROUNDED | (BILINEAR if from_yuv else AREA), **size)


def range_tag(colour: Colour) -> int:
    """Return FFmpeg's number of the range of a Colour."""
    return FULL if colour.is_full_range else LIMITED


def plane_of(picture: av.VideoFrame, index: int) -> NDArray[np.uint8]:
    """Return a plane (H, W) of eight bits; it is the picture's own memory."""
    plane = picture.planes[index]
    rows = np.frombuffer(cast(Any, plane), np.uint8).reshape(-1, plane.line_size)
    return rows[:plane.height, :plane.width]


def tagged_colour(picture: av.VideoFrame, codec: av.VideoCodecContext) -> Colour:
    """Return the Colour of a picture, and of those after it, that ``codec`` has decoded."""
    if picture.format.is_rgb:
        return STANDARD
    is_full_range = {LIMITED: False, FULL: True}.get(int(picture.color_range))
    if is_full_range is None and picture.format.name.startswith('yuvj'):
        is_full_range = True
    return colour_of((picture.width, picture.height), int(picture.colorspace), is_full_range,
                     int(codec.color_primaries), int(codec.color_trc))


def side_data_of(picture: av.VideoFrame) -> dict[str, bytes]:
    """Return what FFmpeg tells of a picture besides, by its names; nothing where PyAV cannot."""
    try:
        return {one.type.name: bytes(cast(Any, one)) for one in picture.side_data}
    except ValueError:
        # One of them is newer than PyAV.
        return {}


def orientation(picture: av.VideoFrame, matrix: bytes | None
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
