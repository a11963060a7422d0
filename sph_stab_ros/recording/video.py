# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Pictures out of video files, through PyAV."""

from collections import Counter, deque
from collections.abc import Generator, Iterator
from fractions import Fraction
import logging
from pathlib import Path
from typing import Any

import numpy as np

from sph_stab_ros.geometry.conventions import NS_PER_S
from sph_stab_ros.images.frame import Frame
from sph_stab_ros.images.picture_time import PictureTime, Stamp
from sph_stab_ros.images.times import PictureClock
from sph_stab_ros.recording.base import RecordingError, SkipLog
from sph_stab_ros.recording.picture_times import with_times
from sph_stab_ros.recording.tilt import tilt_removed_in_camera

try:
    # The writer takes it from here.
    import av as av
except ImportError:
    raise RecordingError("video files need PyAV: pip install 'sph_stab_ros[video]'") from None

logger = logging.getLogger(__name__)

# Containers round their durations, and sound may end after the pictures.
MISSING_END_S = 0.5
# AVFMT_NOTIMESTAMPS of FFmpeg's: what such containers show as times is made up.
NO_TIMES = 0x80
# Of streams that say none.
ASSUMED_RATE = Fraction(30)


class VideoRecording:
    """
    A video file.

    Pictures come with square pixels and upright, as the container's pixel aspect and rotation
    say, and with the container's times, which need not be regular. A stream without any times has
    those of its rate, in the order of presentation.
    """

    def __init__(self, path: Path) -> None:
        self.topics: dict[str, str] = {}
        self.image_topic: str | None = None
        self.path = path
        self.name = path.name
        self._skip_log = SkipLog(self.name)
        with self._open() as container:
            stream = container.streams.video[0]
            self.duration_s = _duration_s(container, stream)
            self.frame_count: int | None = stream.frames or None
            if self.duration_s and stream.average_rate:
                # Some containers count fields, or frames that an edit list hides.
                self.frame_count = round(self.duration_s * stream.average_rate)
        if tilt_removed_in_camera(path):
            logger.warning(
                '%s: its metadata say that the camera removed the tilt already (zenith '
                'correction): what is found is the rotation that is left in the pictures, not '
                "the camera's", self.name)

    @property
    def skipped(self) -> Counter[str]:
        """Count the pictures left out so far, by reason."""
        return self._skip_log.counts

    def messages(self, topic: str) -> Iterator[tuple[int, Any]]:
        """Raise RecordingError: a video has no topics."""
        raise RecordingError(f'{self.path} is not a bag and has no topic {topic}')

    def frames(self) -> Generator[Frame, None, None]:
        """Yield the Frames as they are decoded."""
        self._skip_log = SkipLog(self.name)
        with self._open() as container:
            stream = container.streams.video[0]
            stream.thread_type = 'AUTO'
            rate = _rate(stream)
            clock = PictureClock(round(NS_PER_S / rate))
            stamped = self._stamped(container, stream, rate)
            for times, picture in with_times(self.name, stamped, clock):
                yield _frame(picture, times, stream.sample_aspect_ratio)

    def _stamped(self, container: 'av.container.InputContainer', stream: 'av.VideoStream',
                 rate: Fraction) -> Iterator[tuple[Stamp, 'av.VideoFrame']]:
        """Yield the whole pictures in the order of presentation with their Stamps."""
        name = container.format.name
        # Files of one JPEG picture after the other.
        has_times = not container.format.flags & NO_TIMES and not name.endswith('_pipe')
        if not has_times:
            logger.warning('%s has no times: %g pictures a second are assumed',
                           self.name, float(rate))
        # AVI knows the order of decoding alone; the decoder puts pictures into that of showing.
        in_order: deque[int] | None = None
        if name == 'avi':
            in_order = deque()
            logger.warning('%s has no times of presentation: the pictures are taken in order, at '
                           '%g a second', self.name, float(rate))
        count, end_s, cut = 0, 0., False
        try:
            for packet in container.demux(stream):
                if packet.is_corrupt:
                    cut = True
                    continue
                if in_order is not None and packet.size and packet.dts is not None:
                    in_order.append(packet.dts)
                for picture in self._decoded(packet):
                    if in_order is not None:
                        picture.pts = in_order.popleft() if in_order else None
                    if not has_times:
                        stamp = Stamp(round(count * NS_PER_S / rate))
                    elif picture.pts is None or picture.time_base is None:
                        stamp = Stamp(None)
                    else:
                        stamp = Stamp(round(picture.pts * picture.time_base * NS_PER_S))
                    end_s = end_s if stamp.stamp_ns is None else stamp.stamp_ns / NS_PER_S
                    yield stamp, picture
                    count += 1
        except av.FFmpegError as error:
            logger.debug('%s: %r', self.name, error)
            cut = True
        if cut or (self.duration_s or 0.) - end_s > MISSING_END_S:
            logger.warning('%s is truncated or damaged: %d pictures were read, up to %.3f s%s',
                           self.name, count, end_s,
                           f' of {self.duration_s:.3f} s' if self.duration_s else '')

    def _decoded(self, packet: 'av.Packet[av.VideoStream]') -> list['av.VideoFrame']:
        """Return the whole pictures that a packet completes."""
        try:
            pictures = packet.decode()
        except av.FFmpegError as error:
            self._skip_log.add('undecodable', f'undecodable: {error}')
            return []
        broken = [p for p in pictures if p.is_corrupt]
        for picture in broken:
            self._skip_log.add('undecodable', f'undecodable picture at {picture.time} s')
        return [p for p in pictures if p not in broken]

    def _open(self) -> 'av.container.InputContainer':
        try:
            container = av.open(str(self.path), metadata_errors='replace')
        except OSError as error:
            raise RecordingError(f'{self.path} cannot be read: {error.strerror}') from None
        except av.FFmpegError as error:
            raise RecordingError(
                f'{self.path} is not a readable video: {error.strerror}') from None
        if not container.streams.video:
            container.close()
            raise RecordingError(f'{self.path} has no video stream')
        return container


def _frame(picture: 'av.VideoFrame', times: PictureTime, pixel_aspect: Fraction | None) -> Frame:
    """Return the Frame of a decoded picture."""
    width, height = square_pixel_size(picture.width, picture.height, pixel_aspect)
    image: Any = picture.to_ndarray(format='bgr24', width=width, height=height)
    if picture.rotation:
        image = np.ascontiguousarray(np.rot90(image, round(picture.rotation / 90)))
    return Frame(image, times.stamp_ns, times=times)


def _rate(stream: 'av.VideoStream') -> Fraction:
    """Return the pictures a second that a stream says, or what is assumed."""
    rate = stream.codec_context.framerate or stream.guessed_rate or stream.average_rate
    return Fraction(rate) if rate and 1 <= rate <= 1000 else ASSUMED_RATE


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


def _duration_s(container: 'av.container.InputContainer',
                stream: 'av.VideoStream') -> float | None:
    """Return how long the container says the pictures last, or None."""
    if stream.duration and stream.time_base:
        return float(stream.duration * stream.time_base)
    return container.duration / av.time_base if container.duration else None
