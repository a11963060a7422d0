# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Encoders in graphics cards and other chips: whether one can be used here, and how."""

from collections.abc import Mapping
from fractions import Fraction
from typing import Any

from av.codec.codec import Codec
from av.codec.context import CodecContext
from av.error import FFmpegError

# In which encoders take pictures, by preference: of eight bits and of ten.
FORMATS = {False: ('yuv420p', 'nv12'), True: ('yuv420p10le', 'p010le')}
RATE_HZ = 30


class EncoderError(Exception):
    """Why an encoder cannot be used here, in a few words."""


def input_format(name: str, is_deep: bool = False) -> str:
    """Return FFmpeg's pixel format for an encoder, by FFmpeg's name, or raise EncoderError."""
    try:
        known = {one.name for one in Codec(name, 'w').video_formats or ()}
    except ValueError:
        raise EncoderError('it is not in this PyAV') from None
    # Of V4L2's only the driver knows.
    for one in FORMATS[is_deep]:
        if one in known or not known:
            return one
    raise EncoderError(f'it takes no pictures of {10 if is_deep else 8} bits from memory')


def usable_format(name: str, size_wh: tuple[int, int], options: Mapping[str, str],
                  is_deep: bool = False) -> str:
    """
    Return what ``input_format`` does, having opened the encoder once.

    Whether there is a card for it, a driver, and room for one stream more, nothing else tells.
    """
    pixel_format = input_format(name, is_deep)
    context: Any = CodecContext.create(name, 'w')
    context.width, context.height = size_wh
    context.pix_fmt = pixel_format
    context.time_base, context.framerate = Fraction(1, RATE_HZ), Fraction(RATE_HZ)
    context.options = {**options}
    try:
        context.open()
    except (FFmpegError, ValueError) as error:
        raise EncoderError(getattr(error, 'strerror', None) or str(error)) from None
    return pixel_format
