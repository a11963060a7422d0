# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""One browser: what it is to be sent, how fast it draws, how much it may say."""

from asyncio import Event
from collections import deque
from collections.abc import AsyncIterator, Callable
from time import monotonic
from typing import Protocol

from sph_stab_ros.operator.flow_control import Flow, StillFlow, VideoFlow
from sph_stab_ros.operator.listening import Allowance
from sph_stab_ros.operator.protocol import Link, picture_message

# A page sends one look and one acknowledgement per picture of its display, at 120 Hz or less.
MESSAGES_PER_S = 300.
BURST = 600.
# Rate and latency are those of so much time.
WINDOW_S = 2.0


class PictureWay(Protocol):
    """Another way for pictures than the WebSocket's."""

    def send(self, sequence: int, message: bytes, is_key: bool) -> None:
        """Send a picture of a video."""

    def close(self) -> None:
        """End."""


class Client:
    """
    What one browser is to get next: a picture of its ``flow``, and the newest text of each kind.

    ``video`` is the flow where that is one of video, else None.
    """

    def __init__(self, name: str | None, page: str = '', wants_video: bool = False,
                 clock: Callable[[], float] = monotonic) -> None:
        self.name = name
        # What tells a page that comes back from others; '' where it does not say.
        self.page = page
        # What it says of its link.
        self.link: Link | None = None
        # Whether something that it asked for is still being done.
        self.busy = False
        self.datagrams: PictureWay | None = None
        self._clock = clock
        self._wake = Event()
        self.video = VideoFlow(self._wake.set, clock) if wants_video else None
        self.flow: Flow = self.video or StillFlow(self._wake.set)
        self._texts: dict[str, str] = {}
        # When each was drawn, and how long after it was received.
        self._drawn: deque[tuple[float, float]] = deque()
        self._allowance = Allowance(MESSAGES_PER_S, BURST, clock)

    def offer_text(self, kind: str, text: str) -> None:
        """Replace the text of this kind that waits to be sent."""
        self._texts[kind] = text
        self._wake.set()

    async def messages(self) -> AsyncIterator[str | bytes]:
        """Yield texts and binary messages, each when it is wanted and there is something new."""
        while True:
            await self._wake.wait()
            self._wake.clear()
            while self._texts:
                yield self._texts.pop(next(iter(self._texts)))
            if numbered := self.flow.next_picture():
                sequence, picture = numbered
                message = picture_message(sequence, picture)
                if self.datagrams:
                    self.datagrams.send(sequence, message, picture.chunk == 'key')
                else:
                    yield message
                # A text may have come meanwhile.
                self._wake.set()

    def take_way(self, datagrams: PictureWay | None) -> None:
        """Send pictures another way, or by messages again; what is on its way is lost."""
        self.datagrams = datagrams
        if self.video:
            self.video.change_way()

    def arrived(self, sequence: int, newest: int) -> None:
        """Note that pictures have come by datagrams."""
        if self.video:
            self.video.arrived(sequence, newest)

    def drawn(self, sequence: int) -> None:
        """Note that a picture is drawn, and those before it are drawn or skipped."""
        now_s = self._clock()
        if picture := self.flow.acknowledge(sequence):
            self._drawn.append((now_s, now_s - picture.received_s))

    def skipped(self, sequence: int) -> None:
        """Note that a picture, or one before it, will not be drawn any more."""
        self.flow.acknowledge(sequence)

    def rate_and_latency(self) -> tuple[float, float | None]:
        """
        Return pictures drawn per second, and seconds from camera to screen, or None.

        Latency is the median time from the receipt of the camera's picture to the news that it is
        drawn: it includes the way back.
        """
        now_s = self._clock()
        while self._drawn and self._drawn[0][0] < now_s - WINDOW_S:
            self._drawn.popleft()
        if not self._drawn:
            return 0., None
        latencies_s = sorted(latency_s for _, latency_s in self._drawn)
        return len(latencies_s) / WINDOW_S, latencies_s[len(latencies_s) // 2]

    def may_speak(self) -> bool:
        """Tell whether one more message is within the rate that a page needs."""
        return self._allowance.take()
