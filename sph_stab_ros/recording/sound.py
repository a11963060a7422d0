# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The sound of a video, copied without encoding it anew, beside pictures that are."""

from collections.abc import Iterator
from contextlib import ExitStack
from fractions import Fraction
import io
import logging
import math
from pathlib import Path
from typing import Any

from sph_stab_ros.geometry.conventions import NS_PER_S
from sph_stab_ros.recording.pyav import av, url_of

logger = logging.getLogger(__name__)

# Packets of sound that begin earlier than that before the pictures cannot be a part of theirs.
LONGEST_PACKET_NS = NS_PER_S


class Sound:
    """
    Copies the sound of a video into another one, as far as its pictures go.

    Of each stream the first packet copied is the one before what is heard with the first picture,
    which decoders need to begin with; times below zero make it unheard.

    Parameters
    ----------
    source
        The video whose sound it is.
    target
        An output to which streams can still be added; what it cannot hold is left out and named.
    first_ns
        The time of the first picture in the source, which is zero in the target.

    """

    def __init__(self, source: Path, target: 'av.container.OutputContainer', first_ns: int
                 ) -> None:
        self._name = source.name
        self._target = target
        self._first_ns = first_ns
        self._is_damaged = False
        self._stack = ExitStack()
        container = self._stack.enter_context(av.open(url_of(source), metadata_errors='replace'))
        self._streams: dict[int, Any] = {}
        for stream in container.streams.audio:
            if not can_hold(target.format.name, source, stream.index):
                # What FFmpeg does not know has no context.
                codec = getattr(stream.codec_context, 'name', 'of an unknown codec')
                logger.warning('%s: its sound is %s, which %s files cannot hold, and is left out',
                               self._name, codec, target.format.name)
                continue
            copied = target.add_stream_from_template(stream)
            copied.metadata.update(stream.metadata)
            self._streams[stream.index] = copied
        self._packets = self._to_copy(container)
        self._waiting: Any = None

    def copy_until(self, time_ns: float) -> None:
        """Copy what begins before a time of the source."""
        packet = self._waiting or next(self._packets, None)
        while packet is not None and start_ns(packet) < time_ns:
            self._put(packet)
            packet = next(self._packets, None)
        self._waiting = packet

    def close(self) -> None:
        """Close the source."""
        self._stack.close()

    def _to_copy(self, container: 'av.container.InputContainer') -> Iterator[Any]:
        """Yield the packets from the first picture on, as they come, with one before of each."""
        streams = [one for one in container.streams.audio if one.index in self._streams]
        if not streams:
            return
        before: dict[int, Any] = {}
        last_dts = dict.fromkeys(self._streams, -math.inf)
        try:
            self._seek(container, streams[0])
            for packet in container.demux(streams):
                if packet.pts is None or packet.dts is None or (
                        packet.dts <= last_dts[packet.stream_index]):
                    continue
                last_dts[packet.stream_index] = packet.dts
                if end_ns(packet) <= self._first_ns:
                    before[packet.stream_index] = packet
                    continue
                if packet.stream_index in before:
                    yield before.pop(packet.stream_index)
                yield packet
        except av.FFmpegError as error:
            self._say_damaged(error)

    def _say_damaged(self, error: Exception) -> None:
        logger.debug('%s: %r', self._name, error)
        if not self._is_damaged:
            logger.warning('%s: its sound is damaged, what can be is copied', self._name)
        self._is_damaged = True

    def _seek(self, container: 'av.container.InputContainer', stream: Any) -> None:
        """Go to a little before the first picture, where that is worth it."""
        from_ns = self._first_ns - LONGEST_PACKET_NS
        if from_ns <= LONGEST_PACKET_NS:
            return
        try:
            container.seek(math.floor(Fraction(from_ns, NS_PER_S) / stream.time_base),
                           stream=stream)
        except av.FFmpegError as error:
            logger.debug('%s: no seeking: %r', self._name, error)

    def _put(self, packet: Any) -> None:
        first = round(Fraction(self._first_ns, NS_PER_S) / packet.time_base)
        packet.pts -= first
        packet.dts -= first
        packet.stream = self._streams[packet.stream_index]
        try:
            self._target.mux(packet)
        except (ValueError, av.FFmpegError) as error:
            self._say_damaged(error)


def can_hold(format_name: str, source: Path, index: int) -> bool:
    """Tell whether a stream can be copied into a format: some muxers learn it from packets."""
    try:
        with (av.open(io.BytesIO(), 'w', format_name) as trial,
              av.open(url_of(source)) as container):
            stream = container.streams[index]
            if stream.codec_context is None:
                return False
            copied = trial.add_stream_from_template(stream)
            packet = next(packet for packet in container.demux(stream) if packet.size)
            packet.stream = copied
            trial.mux(packet)
    except (ValueError, StopIteration, av.FFmpegError) as error:
        logger.debug('%s: %r', source, error)
        return False
    return True


def start_ns(packet: Any) -> int:
    """Return the time at which a packet begins to be heard."""
    return round(packet.pts * packet.time_base * NS_PER_S)


def end_ns(packet: Any) -> int:
    """Return the time from which on a packet is not heard."""
    return round((packet.pts + (packet.duration or 0)) * packet.time_base * NS_PER_S)
