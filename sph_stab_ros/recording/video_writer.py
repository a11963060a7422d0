# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Pictures, and the sound of others, into an MP4 or MOV file, through PyAV."""

from fractions import Fraction
import logging
import math
import os
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from sph_stab_ros.config import EncoderConfig
from sph_stab_ros.geometry.arrays import Raster
from sph_stab_ros.geometry.conventions import NS_PER_S
from sph_stab_ros.images.colour import Colour, from_bgr, STANDARD
from sph_stab_ros.images.picture_clock import PictureClock
from sph_stab_ros.images.picture_time import Stamp
from sph_stab_ros.images.side_by_side import as_bgr
from sph_stab_ros.images.video.encoders import EncoderError, FORMATS, usable_format
from sph_stab_ros.images.video.picture import plane_of, range_tag
from sph_stab_ros.recording.base import RecordingError
from sph_stab_ros.recording.pyav import av, url_of
from sph_stab_ros.recording.sound import Sound
from sph_stab_ros.recording.spherical_boxes import write_spherical

logger = logging.getLogger(__name__)

TIME_BASE = Fraction(1, 90000)
# Fewer pictures are decoded in the order in which they are shown.
MIN_REORDERED = 3
# Only a hint for the encoder; each picture has its own time.
NOMINAL_RATE = 30
# FFmpeg's encoders, what they are told besides, and the tag by which players know a stream.
ENCODERS = {'h264': ('libx264', {}, ''),
            'h265': ('libx265', {'x265-params': 'log-level=error'}, 'hvc1'),
            'av1': ('libsvtav1', {}, '')}


class VideoWriter:
    """
    An MP4 or MOV file, written picture by picture; a context manager.

    The times of the pictures are what a PictureClock makes of those given, counted from the first:
    they increase whatever is given, and good ones stay. All pictures are of the first one's size;
    an odd row or column is doubled, as H.264 needs even sizes.

    Parameters
    ----------
    path
        Ends in ``.mp4`` or ``.mov``.
    spheres
        Whether all pictures are whole spheres, which the file then says.
    sound
        A video whose sound to copy; the times of the pictures are then its own.
    is_all
        Whether the sound is copied to its end, not only as long as pictures are shown.
    encoder
        The codec, and how the pictures are encoded.

    """

    def __init__(self, path: Path, spheres: bool = False, sound: Path | None = None,
                 is_all: bool = True, encoder: EncoderConfig = EncoderConfig()) -> None:
        self.path = path
        self._spheres = spheres
        self._sound_source = sound
        self._is_all = is_all
        self._encoder = encoder

    def __enter__(self) -> 'VideoWriter':
        self._container = av.open(url_of(self.path), 'w')
        # Begun with the first picture, whose size and colours it has.
        self._stream: Any = None
        self._sound: Sound | None = None
        self._last_pts, self._pictures = -1, 0
        self._clock = PictureClock()
        return self

    def __exit__(self, error: type[BaseException] | None, *_: object) -> None:
        # Also after an error, so that what there is can be read: somebody may have stopped it.
        try:
            if self._stream is not None:
                self._encode(None)
            if self._sound is not None:
                self._sound.copy_until(math.inf if self._is_all and error is None
                                       else self._time_ns + self._clock.period_ns)
                self._sound.close()
        finally:
            self._container.close()
        if self._spheres and self._stream is not None and error in (None, KeyboardInterrupt):
            write_spherical(self.path)

    def write(self, image: Raster, stamp_ns: int, colour: Colour | None = None) -> None:
        """
        Write an image, BGR or grey, taken at a time; all are written as the first's colour.

        One of sixteen bits is written with ten, as all after it should be.
        """
        time_ns = self._time_ns = self._clock.decide(Stamp(stamp_ns)).time_ns
        height, width = image.shape[:2]
        image = cv2.copyMakeBorder(image, 0, height % 2, 0, width % 2, cv2.BORDER_REPLICATE)
        if self._stream is None:
            self._start(image, time_ns, colour or STANDARD)
        elif image.shape[:2] != (self._stream.height, self._stream.width):
            image = cv2.resize(image, (self._stream.width, self._stream.height))
        if self._sound is not None:
            self._sound.copy_until(time_ns)
        picture = av.VideoFrame(
            self._stream.width, self._stream.height, FORMATS[image.dtype != np.uint8][0])
        for index, values in enumerate(from_bgr(as_bgr(image), self._colour)):
            plane_of(picture, index, 8 * values.itemsize)[:] = values
        if picture.format.name != self._stream.pix_fmt:
            # The same values, in another order.
            picture = picture.reformat(format=self._stream.pix_fmt)
        picture.pts = self._last_pts = max(
            self._last_pts + 1,
            round(Fraction(time_ns - self._first_ns, NS_PER_S) / TIME_BASE))
        picture.time_base = TIME_BASE
        self._encode(picture)

    def _encode(self, picture: 'av.VideoFrame | None') -> None:
        """Write what a picture makes the encoder give, or what it has left."""
        self._pictures += picture is not None
        for packet in self._stream.encode(picture):
            if self._pictures < MIN_REORDERED:
                # Which x265 leaves open, as it does not come to change their order.
                packet.dts = packet.pts
            self._container.mux(packet)

    def _start(self, image: Raster, time_ns: int, colour: Colour) -> None:
        name, options, pixel_format, tag = self._encoder_for(image)
        # SVT-AV1 tells of all that it does.
        os.environ.setdefault('SVT_LOG', '1')
        try:
            self._stream = self._container.add_stream(
                name, rate=NOMINAL_RATE, options=options)
        except ValueError as error:
            raise RecordingError(f'{self.path} needs PyAV with {name}: {error}') from None
        if tag:
            self._stream.codec_context.codec_tag = tag
        self._stream.height, self._stream.width = image.shape[:2]
        self._stream.pix_fmt = pixel_format
        self._stream.time_base = self._stream.codec_context.time_base = TIME_BASE
        self._colour, codec = colour, self._stream.codec_context
        codec.colorspace, codec.color_range = colour.matrix, range_tag(colour)
        codec.color_primaries, codec.color_trc = colour.primaries, colour.transfer
        self._first_ns = time_ns
        if self._sound_source is not None:
            self._sound = Sound(self._sound_source, self._container, time_ns)

    def _encoder_for(self, image: Raster) -> tuple[str, dict[str, str], str, str]:
        """Return the encoder's name, its options, the pixel format and the tag for such images."""
        is_deep = image.dtype != np.uint8
        codec, wanted = self._encoder.codec_for(is_deep), self._encoder.encoder
        name, more, tag = ENCODERS[codec]
        if wanted:
            options = self._encoder.hardware_options
            try:
                return wanted, options, usable_format(
                    wanted, image.shape[1::-1], options, is_deep), tag
            except EncoderError as error:
                logger.warning('%s cannot be used here: %s; %s encodes', wanted, error, name)
        return name, {**self._encoder.options(codec), **more}, FORMATS[is_deep][0], tag
