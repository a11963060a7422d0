# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Pictures as H.264, each at once: files of images in, for every one of them a packet out."""

from collections.abc import Callable
from fractions import Fraction

from av.codec.codec import codecs_available
from av.codec.context import CodecContext
from av.error import FFmpegError
from av.packet import Packet
from av.video.codeccontext import VideoCodecContext
from av.video.frame import PictureType, VideoFrame
import numpy as np

from sph_stab_ros.config import LIVE_ENCODERS
from sph_stab_ros.images.codec import decoded, ImageError, JPEG, whole_file
from sph_stab_ros.images.video.encoders import EncoderError, input_format
from sph_stab_ros.images.video.picture import FULL, plane_of

SOFTWARE = 'libx264'
# More take too long, and a view of 100° of them has as many pixels as many a window.
MAX_COLUMNS = 2048
# The encoder is told so, and its bit rate such that it is right for the pictures that come.
RATE_HZ = 30
# How long a picture may take on its way, be it a key picture; of few a second each has more.
MAX_PICTURE_S = 0.08
MAX_SHARE = 1.5
# That is told at the beginning only: a new one is due when the bit rate leaves these multiples of
# the first.
LEAST_CHANGE, MOST_CHANGE = 0.4, 1.3
# Full range, as JPEG has it: its planes stay as they are.
PIXELS = 'yuvj420p'
SOFTWARE_OPTIONS = {
    # At 1920×960 it takes 15 ms to 8 of ultrafast, and is as good at 2 Mbit/s as that at 5.
    'preset': 'superfast', 'tune': 'zerolatency', 'threads': '1', 'x264-params': 'scenecut=0'}
# Key pictures come when somebody asks.
OPTIONS = {'g': '1000000', 'bf': '0'}


class H264Encoder:
    """
    Encodes the pictures of one stream, with no other pictures than those before.

    ``source_size`` is (width, height) of the last file.

    Parameters
    ----------
    divisor
        By how much pictures are made smaller.
    name
        FFmpeg's of the encoder. One in hardware that does not open, or does not give each picture
        at once, is given up for software's.
    warn
        Logs a text, before which comes the kind of event.

    """

    def __init__(self, divisor: int = 1, name: str = SOFTWARE,
                 warn: Callable[[str, str], object] = lambda kind, text: None) -> None:
        self._divisor, self._name, self._warn = divisor, name, warn
        self._jpeg = jpeg_decoder()
        self._encoder: VideoCodecContext | None = None
        self._first_told = 0.
        self.source_size = 0, 0

    def encode(self, file: bytes, bit_rate: float, period_s: float, wants_key: bool
               ) -> tuple[bytes, bool]:
        """
        Return a picture's packet (Annex B), and whether it is a key picture.

        That it is where one is wanted, and where sizes or bit rates become others. ``period_s``
        is how long after one picture the next usually comes. ImageError where the file is no
        picture.
        """
        frame = self._frame(file)
        told = bit_rate * period_s * RATE_HZ
        fits = self._encoder is not None and (
            LEAST_CHANGE <= told / self._first_told <= MOST_CHANGE) and (
            self._encoder.width, self._encoder.height) == (frame.width, frame.height)
        try:
            if self._name != SOFTWARE:
                frame = in_format(frame, input_format(self._name))
            if self._encoder is None or wants_key or not fits:
                self._first_told = told
                self._encoder = new_encoder(
                    self._name, frame, told * MOST_CHANGE,
                    bit_rate * max(MAX_PICTURE_S, MAX_SHARE * period_s))
            self._encoder.bit_rate = round(told)
            packet, = self._encoder.encode(frame)
        except (EncoderError, FFmpegError, ValueError) as error:
            self._encoder = None
            if self._name != SOFTWARE:
                self._warn('encoder', f'{self._name} cannot be used here: {error}; {SOFTWARE} '
                           'encodes')
                self._name = SOFTWARE
                return self.encode(file, bit_rate, period_s, wants_key)
            raise ImageError('cannot encode', f'{frame.width}×{frame.height}: {error}') from None
        return bytes(packet), packet.is_keyframe

    def _frame(self, file: bytes) -> VideoFrame:
        data, kind = whole_file(file)
        if kind == JPEG:
            try:
                frame, = self._jpeg.decode(Packet(data))
            except (FFmpegError, ValueError):
                self._jpeg = jpeg_decoder()
                raise ImageError(f'corrupt {kind}', f'{len(data)} bytes cannot be decoded') \
                    from None
        else:
            image = decoded(data, kind)
            frame = VideoFrame.from_ndarray(
                np.ascontiguousarray(image), 'gray' if image.ndim == 2 else 'bgr24')
        self.source_size = frame.width, frame.height
        width, height = size(frame.width, frame.height, self._divisor)
        if not (width and height):
            raise ImageError('small picture', f'{frame.width}×{frame.height}')
        frame = frame.reformat(width, height, PIXELS, dst_color_range='JPEG')
        frame.pts = None
        frame.pict_type = PictureType.NONE
        return frame


def in_format(frame: VideoFrame, pixel_format: str) -> VideoFrame:
    """Return a picture with the values of one of ``PIXELS`` in a format that says no range."""
    picture = VideoFrame(frame.width, frame.height, 'yuv420p')
    for index in range(3):
        plane_of(picture, index)[:] = plane_of(frame, index)
    return picture.reformat(format=pixel_format)


def can_encode() -> bool:
    """Tell whether this PyAV has the encoder."""
    return SOFTWARE in codecs_available


def size(width: int, height: int, divisor: int) -> tuple[int, int]:
    """Return the size of a picture on its way: even, and of a sphere's shape if it was."""
    divisor *= -(-width // MAX_COLUMNS)
    return width // divisor & ~3, height // divisor & ~1


def new_encoder(name: str, frame: VideoFrame, max_bit_rate: float, max_bits: float
                ) -> VideoCodecContext:
    """Return an encoder for pictures as this one, of which none has more than ``max_bits``."""
    encoder = CodecContext.create(name, 'w')
    assert isinstance(encoder, VideoCodecContext)
    encoder.width, encoder.height, encoder.pix_fmt = frame.width, frame.height, frame.format.name
    encoder.color_range = FULL
    encoder.time_base, encoder.framerate = Fraction(1, RATE_HZ), Fraction(RATE_HZ)
    # The rate is constant and begins with the highest: x264 changes no other, and only downwards.
    encoder.bit_rate = round(max_bit_rate)
    encoder.options = {
        **OPTIONS, **(SOFTWARE_OPTIONS if name == SOFTWARE else LIVE_ENCODERS[name]),
        'maxrate': str(encoder.bit_rate), 'bufsize': str(round(max_bits))}
    encoder.open()
    return encoder


def jpeg_decoder() -> VideoCodecContext:
    """Return a decoder that leaves planes as they are in the file."""
    decoder = CodecContext.create('mjpeg', 'r')
    assert isinstance(decoder, VideoCodecContext)
    decoder.thread_count = 1
    return decoder
