# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""
A camera or stream read in a thread of its own: pictures as they come, and again after a break.

What goes wrong is a line and a state, never an exception and never the end of the thread: a camera
is unplugged and plugged in again, a sender is killed and started.
"""

from collections.abc import Callable, Mapping
from threading import Event, Thread
from time import monotonic, monotonic_ns, time_ns
from typing import Any, NamedTuple, Protocol, TYPE_CHECKING

from sph_stab_ros.config import NOT_JOINED
from sph_stab_ros.images.image_error import ImageError
from sph_stab_ros.images.joined import JoinedPicture, Pairing, tracks_of
from sph_stab_ros.live.address import Address, Kind, SourceError
from sph_stab_ros.live.capture_clock import CaptureClock
from sph_stab_ros.live.connection import (
    Backlog, has_times, is_recording, opened, Pace, reason_of, require_pyav, tells_keys)
from sph_stab_ros.live.packets import LiveImage, PacketDecoder, pts_ns_of, sender_time

if TYPE_CHECKING:
    import av

# From one attempt to the next.
FIRST_BREAK_S, LONGEST_BREAK_S = 0.5, 8.
# A pipe that has been read from cannot be opened again; a file stays as it is.
ONCE = Kind.PIPE, Kind.FILE
# A read cannot be interrupted before its time is over.
ENDING_S = 1.
CONNECTING, CONNECTED, RECONNECTING, ENDED = 'connecting', 'connected', 'reconnecting', 'ended'


class Log(Protocol):
    """Where users read."""

    def info(self, text: str) -> Any:
        """Say how it is."""

    def warning(self, text: str) -> Any:
        """Say what is wrong."""


class LivePicture(NamedTuple):
    """
    A picture, its stamp in ns since 1970, and when it came in by the steady clock.

    ``side_data`` is what FFmpeg tells of the pictures besides, by its names.
    """

    source: LiveImage | JoinedPicture
    stamp_ns: int
    received_s: float
    side_data: Mapping[str, bytes] = {}


class SourceState(NamedTuple):
    """
    What a LiveSource is about.

    ``why`` says why it is not connected, '' where it is; so many ``pictures`` have come in all,
    and packets were ``left_out`` since decoding did not keep up.
    """

    status: str = CONNECTING
    why: str = ''
    codec: str = ''
    size_wh: tuple[int, int] | None = None
    clock: str = ''
    connections: int = 0
    pictures: int = 0
    left_out: int = 0


class LiveSource:
    """
    Reads a source in a thread of its own; ``state`` is its present SourceState.

    A file is played in its own time, once; so is a recording at an address, and again.

    Parameters
    ----------
    address
        What to read.
    take
        Takes each LivePicture, and at once: meanwhile nothing is read.
    log
        Told in one line of what users should hear of: a ``logging.Logger`` or one of rclpy's.
    refuse
        Told of each picture that cannot be used.
    join
        How to put the pictures of two tracks together, ``left_right``, ``top_bottom`` or not.

    """

    def __init__(self, address: Address, take: Callable[[LivePicture], Any],
                 log: Log, refuse: Callable[[ImageError], Any], join: str = NOT_JOINED) -> None:
        require_pyav(address)
        self.state, self.name = SourceState(), address.name
        self._address, self._join = address, join
        self._pairing: Pairing[LiveImage] = Pairing()
        self._take, self._log, self._refuse = take, log, refuse
        self._clock = CaptureClock()
        self._closing = Event()
        self._thread = Thread(target=self._run, name='source', daemon=True)

    def why_silent(self) -> str:
        """Return why nothing comes, '' where something does."""
        state = self.state
        return '' if state.status == CONNECTED else f'{self.name}: {state.why or state.status}'

    def start(self) -> None:
        """Start to read."""
        self._thread.start()

    def close(self) -> None:
        """Stop reading, as soon as that is possible."""
        self._closing.set()
        if self._thread.is_alive():
            self._thread.join(ENDING_S)

    def has_ended(self, wait_s: float = 0.) -> bool:
        """Tell whether nothing more will come, by the end of so many seconds at most."""
        self._thread.join(wait_s)
        return not self._thread.is_alive()

    def _run(self) -> None:
        break_s = FIRST_BREAK_S
        while not self._closing.is_set():
            before = self.state.pictures
            try:
                self._read()
                why, is_over = 'it has ended', self._address.kind in ONCE
            except Exception as error:
                why, is_over = reason_of(error, self._address)
                is_over |= self._address.kind in ONCE
            if self._closing.is_set():
                return
            self._lose(why, is_over)
            if is_over:
                return
            if self.state.pictures > before:
                break_s = FIRST_BREAK_S
            self._closing.wait(break_s)
            break_s = min(2 * break_s, LONGEST_BREAK_S)

    def _read(self) -> None:
        """Read until nothing more comes."""
        with opened(self._address) as container:
            tracks = tracks_of(container, self._join)
            if not tracks:
                raise SourceError('there is no video in what comes')
            if self._join != NOT_JOINED and len(tracks) < 2:
                raise SourceError('there is no second video track of the same size to join')
            decoders = [PacketDecoder(track, self._log.warning, tells_keys(container))
                        for track in tracks]
            self._pairing = Pairing()
            pace = Pace(self._closing) if is_recording(self._address, container) else None
            backlog, is_timed = Backlog(), has_times(container)
            self._clock.restart()
            backlog.begin(monotonic(), 0.)
            for packet in container.demux(tracks):
                track = tracks.index(packet.stream)
                decoder = decoders[track]
                if pace:
                    pace.wait(packet)
                if self._closing.is_set():
                    return
                if not packet.size:
                    continue
                pts_ns, arrival_ns = pts_ns_of(packet) if is_timed else None, time_ns()
                self._hear_clock(packet, pts_ns, arrival_ns)
                received_s = monotonic()
                is_too_long = backlog.is_too_long(received_s, self._clock.late_ns)
                if is_too_long and decoder.finds_gaps:
                    self.state = self.state._replace(left_out=self.state.left_out + 1)
                else:
                    for shown_ns, outcome in decoder.decode(packet, pts_ns, arrival_ns):
                        self._give(track, shown_ns, outcome, arrival_ns, decoder)
                backlog.begin(monotonic(), monotonic() - received_s)
            for track, decoder in enumerate(decoders):
                for shown_ns, outcome in decoder.flush():
                    self._give(track, shown_ns, outcome, time_ns(), decoder)

    def _hear_clock(self, packet: 'av.Packet[Any]', pts_ns: int | None, arrival_ns: int) -> None:
        if pts_ns is None:
            return
        self._clock.arrive(pts_ns, arrival_ns)
        if self._address.kind is Kind.DEVICE:
            self._clock.hear_device(pts_ns, arrival_ns, monotonic_ns())
        elif (told := sender_time(packet)) is not None:
            self._clock.hear_sender(told, pts_ns)

    def _give(self, track: int, pts_ns: int | None, outcome: LiveImage | ImageError,
              arrival_ns: int, decoder: PacketDecoder) -> None:
        """Pass on a track's picture, with the other track's if they are joined, or why not."""
        if isinstance(outcome, ImageError):
            self._refuse(outcome)
            return
        picture: LiveImage | JoinedPicture = outcome
        if self._join != NOT_JOINED:
            pair = self._pairing.add(track, arrival_ns if pts_ns is None else pts_ns, outcome)
            if pair is None:
                return
            picture = JoinedPicture(*pair, self._join)
        stamp_ns = self._clock.stamp_ns(pts_ns, arrival_ns)
        width, height = size_wh = picture.size_wh
        old = self.state
        self.state = SourceState(
            CONNECTED, '', decoder.codec, size_wh, self._clock.name,
            old.connections + (old.status != CONNECTED), old.pictures + 1, old.left_out)
        if old.status != CONNECTED:
            self._log.info(f'{self.name}: {decoder.codec}, {width}x{height}')
        elif old.size_wh != size_wh:
            self._log.warning(f'{self.name}: the pictures are {width}x{height} now')
        self._take(LivePicture(picture, stamp_ns, monotonic(), decoder.side_data))

    def _lose(self, why: str, is_over: bool) -> None:
        """Take note of why nothing comes, and say it once."""
        if is_over and self.state.pictures:
            self._log.info(f'{self.name}: {why}')
        elif why != self.state.why:
            self._log.warning(
                f'{self.name}: {why}' + ('' if is_over else '; trying again'))
        self.state = self.state._replace(status=ENDED if is_over else RECONNECTING, why=why)
