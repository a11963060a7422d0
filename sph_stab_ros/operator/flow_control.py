# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""
What waits for one browser, and what is on its way to it: files of images, or a video.

Nothing queues up: a slow browser gets fewer pictures, so that it delays neither others nor itself.
"""

from collections.abc import Callable
from math import inf
from time import monotonic
from typing import Protocol

from sph_stab_ros.operator.pairing import Picture
from sph_stab_ros.operator.rate_control import RateControl

# One picture is decoded and drawn while the next one is on its way.
MAX_UNDRAWN = 2
# Of a video more are: longer than the quickest take, by so much, and not more than so many.
MAX_QUEUE_S = 0.25
MAX_VIDEO_UNDRAWN = 60
# Before the first is acknowledged.
UNKNOWN_DELAY_S = 0.5
# Key pictures take from what all browsers of an encoder see.
KEY_PERIOD_S = 1.0

Numbered = tuple[int, Picture]


class Flow(Protocol):
    """The pictures of one browser, each with its sequence number."""

    def offer(self, sequence: int, picture: Picture) -> None:
        """Take in a picture."""

    def next_picture(self) -> Numbered | None:
        """Return what is to be sent now."""

    def acknowledge(self, sequence: int) -> Picture | None:
        """Note that a picture, and those before it, are drawn or will not be; return it."""


class StillFlow:
    """Files of images: the newest is sent as soon as MAX_UNDRAWN are no longer on their way."""

    def __init__(self, wake: Callable[[], object]) -> None:
        self._wake = wake
        self._waiting: Numbered | None = None
        self._undrawn: dict[int, Picture] = {}

    def offer(self, sequence: int, picture: Picture) -> None:
        """Replace the picture that waits to be sent."""
        self._waiting = sequence, picture
        self._wake()

    def next_picture(self) -> Numbered | None:
        """Return what is to be sent now."""
        if self._waiting is None or len(self._undrawn) >= MAX_UNDRAWN:
            return None
        numbered, self._waiting = self._waiting, None
        self._undrawn.update([numbered])
        return numbered

    def acknowledge(self, sequence: int) -> Picture | None:
        """Note that a picture, and those before it, are drawn or will not be; return it."""
        picture = self._undrawn.get(sequence)
        self._undrawn = {later: one for later, one in self._undrawn.items() if later > sequence}
        self._wake()
        return picture


class VideoFlow:
    """
    A video: of its pictures each needs those before it, back to a key picture.

    Who misses one, or says so, gets a key picture next. ``rate`` is what the browser can take.

    Parameters
    ----------
    wake
        Called when there is something to send.

    """

    def __init__(self, wake: Callable[[], object],
                 clock: Callable[[], float] = monotonic) -> None:
        self._wake, self._clock = wake, clock
        self.rate = RateControl(clock)
        # Whether it is known not to fail at the camera's own video.
        self.takes_camera = True
        # Whether it has all that the next picture needs.
        self._in_step = False
        # The last key picture, and when it was encoded.
        self._key, self._key_s = 0, -inf
        self._waiting: Numbered | None = None
        # When each was sent.
        self._undrawn: dict[int, tuple[float, Picture]] = {}

    @property
    def is_ready(self) -> bool:
        """Tell whether it can take one more: few enough are on their way."""
        if self._waiting:
            return False
        if not self._undrawn:
            return True
        oldest_s = self._clock() - next(iter(self._undrawn.values()))[0]
        return oldest_s < self._patience_s and len(self._undrawn) < MAX_VIDEO_UNDRAWN

    @property
    def _patience_s(self) -> float:
        """Return how long a picture may take until the news that it is drawn."""
        return UNKNOWN_DELAY_S if self.rate.base_s is None else self.rate.base_s + MAX_QUEUE_S

    @property
    def is_in_step(self) -> bool:
        """Tell whether it has all that the next picture needs."""
        return self._in_step

    @property
    def needs_key(self) -> bool:
        """Tell whether the next picture has to be a key picture."""
        return (not self._in_step and self.is_ready
                and self._clock() >= self._key_s + KEY_PERIOD_S)

    def lose_step(self) -> None:
        """Note that a picture is missing."""
        self._in_step = False

    def offer(self, sequence: int, picture: Picture) -> None:
        """Take in an encoded picture, or miss it."""
        if not self.is_ready:
            self._in_step = False
            self.rate.stalled()
        elif picture.chunk == 'key':
            self._in_step, self._key = True, sequence
            # The camera's cost no other browser anything.
            self._key_s = self._key_s if picture.codec else self._clock()
        if self._in_step:
            self._waiting = sequence, picture
            self._wake()

    def next_picture(self) -> Numbered | None:
        """Return what is to be sent now."""
        numbered, self._waiting = self._waiting, None
        if numbered:
            sequence, picture = numbered
            self._undrawn[sequence] = self._clock(), picture
        return numbered

    def arrived(self, sequence: int, newest: int) -> None:
        """
        Note what has come of pictures that may get lost: all up to one, and the newest that has.

        Where these differ one between is lost, and no key picture was sent behind the newest. Of
        those behind it nobody knows, but that they had time enough.
        """
        sent_by_s = self._clock() - self._patience_s
        lost = [later for later, (sent_s, _) in self._undrawn.items()
                if later > sequence and (later <= newest or sent_s < sent_by_s)]
        for later in lost:
            del self._undrawn[later]
        if lost and max(lost) >= self._key:
            self._in_step = False

    def change_way(self) -> None:
        """Note that pictures take another way from now on; what is on its way does not count."""
        self._undrawn.clear()
        self._in_step, self._key_s = False, -inf

    def acknowledge(self, sequence: int) -> Picture | None:
        """Note that a picture, and those before it, are drawn or will not be; return it."""
        _, picture = self._undrawn.get(sequence, (0., None))
        now_s = self._clock()
        while self._undrawn and (first := next(iter(self._undrawn))) <= sequence:
            sent_s, sent = self._undrawn.pop(first)
            self.rate.acknowledged(len(sent.data), now_s - sent_s)
        return picture


class FlowGroup:
    """Browsers, by their flows, that get the same pictures, a key picture first."""

    def __init__(self) -> None:
        self._flows: list[VideoFlow] = []

    def __contains__(self, flow: VideoFlow) -> bool:
        """Tell whether a browser is in it."""
        return flow in self._flows

    def add(self, flow: VideoFlow) -> None:
        """Take in a browser."""
        flow.lose_step()
        self._flows.append(flow)

    def remove(self, flow: VideoFlow) -> None:
        """Let a browser go."""
        self._flows.remove(flow)
