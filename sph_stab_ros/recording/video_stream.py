# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The decoded pictures of a video file with their stamps, from the beginning or from a time on."""

from collections import deque
from collections.abc import Iterator
from fractions import Fraction
import logging
import math
from typing import TypeAlias

from sph_stab_ros.geometry.conventions import NS_PER_S
from sph_stab_ros.images.picture_time import Stamp
from sph_stab_ros.recording.base import SkipLog
from sph_stab_ros.recording.picture_times import peeked
from sph_stab_ros.recording.pyav import av

logger = logging.getLogger(__name__)

Pictures: TypeAlias = Iterator[tuple[Stamp, 'av.VideoFrame']]
# The time of the first picture of all, where it has one, and those that were asked for.
Stamped: TypeAlias = tuple[int | None, Pictures]

# Containers round their durations, and sound may end after the pictures.
MISSING_END_S = 0.5
# AVFMT_NOTIMESTAMPS of FFmpeg's: what such containers show as times is made up.
NO_TIMES = 0x80
# Of streams that say none.
ASSUMED_RATE = Fraction(30)
# How much earlier to look for a key picture where the one found is shown too late.
STEP_BACK_NS = NS_PER_S


class PictureStream:
    """
    The whole pictures of an open video, in the order of presentation.

    Parameters
    ----------
    container
        Just opened.
    stream
        Which of its tracks to read.
    name
        Of the recording, for the log.
    skip_log
        Counts what cannot be decoded of what was asked for.

    """

    def __init__(self, container: 'av.container.InputContainer', stream: 'av.VideoStream',
                 name: str, skip_log: SkipLog) -> None:
        self._container = container
        self._name = name
        self._skip_log = skip_log
        self.stream = stream
        self.stream.thread_type = 'AUTO'
        self.rate = rate_of(self.stream)
        self.duration_s = duration_s(container, self.stream)
        # Files of one JPEG picture after the other have none either.
        self.has_times = not (container.format.flags & NO_TIMES
                              or container.format.name.endswith('_pipe'))
        # AVI knows the order of decoding alone; the decoder puts pictures into that of showing.
        self.has_presentation_times = self.has_times and container.format.name != 'avi'
        self._counted_from_ns = -math.inf

    def stamped(self, start_ns: int = 0) -> Stamped | None:
        """
        Return the time of the first picture of all, and pictures from ``start_ns`` after it on.

        Some before that may come too. None where the video must be opened anew to be read from
        the beginning, because there is no key picture between.
        """
        if start_ns > 0:
            # Nothing counts yet.
            self._counted_from_ns = math.inf
        first, from_beginning = peeked(self._decoded())
        first_ns = None if first is None else first[0].stamp_ns
        if first_ns is None or not self.has_presentation_times:
            self._counted_from_ns = -math.inf
            return first_ns, from_beginning
        if self.stream.start_time is not None and self.stream.time_base:
            # The first picture may be damaged, or be made of others that are not there.
            begin_ns = round(self.stream.start_time * self.stream.time_base * NS_PER_S)
            if first_ns - begin_ns > NS_PER_S / self.rate and not self._skip_log.counts:
                logger.warning('%s begins without a key picture: its first %.3f s cannot be '
                               'decoded', self._name, (first_ns - begin_ns) / NS_PER_S)
            first_ns = min(first_ns, begin_ns)
        if start_ns <= 0:
            return first_ns, from_beginning
        self._counted_from_ns = first_ns + start_ns
        pictures = self._from_key_picture(first_ns, first_ns + start_ns)
        return None if pictures is None else (first_ns, pictures)

    def _from_key_picture(self, first_ns: int, wanted_ns: int) -> Pictures | None:
        """Return pictures from the last key picture on that is shown by the time wanted."""
        back_ns = 0
        while wanted_ns - back_ns > first_ns and self.stream.time_base:
            time = Fraction(wanted_ns - back_ns, NS_PER_S) / self.stream.time_base
            try:
                self._container.seek(math.floor(time), stream=self.stream)
            except av.FFmpegError as error:
                logger.debug('%s: no seeking: %r', self._name, error)
                return None
            found, pictures = peeked(self._decoded())
            if found and found[0].stamp_ns is not None and found[0].stamp_ns <= wanted_ns:
                return pictures
            # Containers seek by the order of decoding.
            back_ns = max(2 * back_ns, STEP_BACK_NS)
        return None

    def _decoded(self) -> Pictures:
        in_order: deque[int] = deque()
        is_avi = self.has_times and not self.has_presentation_times
        count, end_s, cut = 0, 0., False
        try:
            for packet in self._container.demux(self.stream):
                if packet.is_corrupt:
                    cut = True
                    continue
                if is_avi and packet.size and packet.dts is not None:
                    in_order.append(packet.dts)
                for picture in self._whole_pictures(packet):
                    if is_avi:
                        picture.pts = in_order.popleft() if in_order else None
                    stamp = (Stamp(time_ns(picture)) if self.has_times
                             else Stamp(round(count * NS_PER_S / self.rate)))
                    end_s = end_s if stamp.stamp_ns is None else stamp.stamp_ns / NS_PER_S
                    yield stamp, picture
                    count += 1
        except av.FFmpegError as error:
            logger.debug('%s: %r', self._name, error)
            cut = True
        if not count and self._counted_from_ns > -math.inf:
            # That is where a key picture was looked for in vain.
            return
        if cut or (self.duration_s or 0.) - end_s > MISSING_END_S:
            logger.warning('%s is truncated or damaged: %d pictures were read, up to %.3f s%s',
                           self._name, count, end_s,
                           f' of {self.duration_s:.3f} s' if self.duration_s else '')

    def _whole_pictures(self, packet: 'av.Packet[av.VideoStream]') -> list['av.VideoFrame']:
        """Return the whole pictures that a packet completes."""
        try:
            pictures = packet.decode()
        except av.FFmpegError as error:
            self._count(time_ns(packet), f'undecodable: {error}')
            return []
        broken = [p for p in pictures if p.is_corrupt]
        for picture in broken:
            self._count(time_ns(picture), f'undecodable picture at {picture.time} s')
        return [p for p in pictures if p not in broken]

    def _count(self, at_ns: int | None, detail: str) -> None:
        """Count what is left out, unless it comes before what was asked for."""
        if at_ns is None or at_ns >= self._counted_from_ns:
            self._skip_log.add('undecodable', detail)


def time_ns(item: 'av.Packet[av.VideoStream] | av.VideoFrame') -> int | None:
    """Return the time of presentation, None without."""
    if item.pts is None or not item.time_base:
        return None
    return round(item.pts * item.time_base * NS_PER_S)


def rate_of(stream: 'av.VideoStream') -> Fraction:
    """Return the pictures a second that a stream says, or what is assumed."""
    rate = stream.codec_context.framerate or stream.guessed_rate or stream.average_rate
    return Fraction(rate) if rate and 1 <= rate <= 1000 else ASSUMED_RATE


def duration_s(container: 'av.container.InputContainer',
               stream: 'av.VideoStream') -> float | None:
    """Return how long the container says the pictures last, or None."""
    if stream.duration and stream.time_base:
        return float(stream.duration * stream.time_base)
    return container.duration / av.time_base if container.duration else None
