# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The times of recorded pictures and messages, decided with a look ahead."""

from collections import deque
from collections.abc import Iterable, Iterator
from itertools import chain, islice
import logging
import math
from typing import TypeVar

from sph_stab_ros.geometry.conventions import NS_PER_S
from sph_stab_ros.images.picture_clock import (
    MAX_DELAY_NS, MAX_JITTER_NS, MAX_PAUSE_NS, PictureClock)
from sph_stab_ros.images.picture_time import PictureTime, Stamp, TimeEvent, told
from sph_stab_ros.recording.base import EmptyStretch, Stretch

logger = logging.getLogger(__name__)

# One to see whether a stamp is false or begins something, one to see the same of the first.
LOOKAHEAD = 2
# After a step of the clock playing goes on.
STEP_PLAYED_NS = NS_PER_S

Item = TypeVar('Item')


def with_times(name: str, stamped: Iterable[tuple[Stamp, Item]], clock: PictureClock
               ) -> Iterator[tuple[PictureTime, Item]]:
    """
    Yield pictures, or what there is of them, with their times.

    What is remarkable about the times of the recording ``name`` is logged, the first of a kind.
    """
    said: set[TimeEvent] = set()
    iterator = iter(stamped)
    waiting = deque(islice(iterator, 1))
    number = 0
    while waiting:
        waiting.extend(islice(iterator, LOOKAHEAD + 1 - len(waiting)))
        stamp, item = waiting.popleft()
        times = clock.decide(stamp, [upcoming for upcoming, _ in waiting])
        number += 1
        if times.event is not None and times.event not in said:
            said.add(times.event)
            logger.warning('%s: picture %d: %s (more of these are not told)',
                           name, number, told(times))
        yield times, item


def within(name: str, timed: Iterable[tuple[PictureTime, Item]], stretch: Stretch,
           first_ns: int | None = None) -> Iterator[tuple[PictureTime, Item]]:
    """
    Yield those of a recording's pictures, with their times, that are in a Stretch.

    ``first_ns`` is the time of the recording's first picture where these begin later.
    EmptyStretch where the recording ends before.
    """
    if stretch == Stretch():
        yield from timed
        return
    elapsed_ns, found = 0, False
    for times, item in timed:
        first_ns = times.time_ns if first_ns is None else first_ns
        elapsed_ns = times.time_ns - first_ns
        if elapsed_ns >= stretch.end_ns:
            break
        if elapsed_ns >= stretch.start_ns:
            found = True
            yield times, item
    if not found and first_ns is not None:
        raise EmptyStretch(f'{name} has no picture from {stretch.start_s:g} s '
                           + (f'to {stretch.end_s:g} s' if stretch.end_s < math.inf else 'on')
                           + f', the last one read is at {elapsed_ns / NS_PER_S:.3f} s')


def first_stamp(stamps: Iterable[Stamp]) -> Stamp | None:
    """Return the first stamp that is not missing."""
    return next((stamp for stamp in stamps if stamp.stamp_ns is not None), None)


def peeked(items: Iterable[Item]) -> tuple[Item | None, Iterator[Item]]:
    """Return the first of some items, and an iterator over all of them."""
    iterator = iter(items)
    first = list(islice(iterator, 1))
    return (first[0] if first else None), chain(first, iterator)


class PlayingTime:
    """
    When to play messages whose times are those of a clock that may have been set.

    Where it was, playing goes on after a second. Messages a little out of order, as of several
    topics, are played at once.
    """

    def __init__(self) -> None:
        self._offset_ns: int | None = None
        self.elapsed_ns = 0

    def advance(self, time_ns: int) -> int | None:
        """Set ``elapsed_ns``, counted from the first message, for the next one; return a step."""
        if self._offset_ns is None:
            self._offset_ns = time_ns
        ahead_ns = time_ns - self._offset_ns - self.elapsed_ns
        if -MAX_JITTER_NS <= ahead_ns <= MAX_PAUSE_NS:
            self.elapsed_ns += max(ahead_ns, 0)
            return None
        self.elapsed_ns += STEP_PLAYED_NS
        self._offset_ns = time_ns - self.elapsed_ns
        return ahead_ns


class HeaderClock:
    """Counts a topic's stamps from the start of playing, whatever clock they are of."""

    def __init__(self) -> None:
        self._clock = PictureClock()
        self._ahead_ns: int | None = None

    def elapsed_ns(self, stamp_ns: int, received_ns: int, played_ns: int) -> int:
        """Return the time of the next message, whose stamp may be zero, played after so long."""
        time_ns = self._clock.decide(Stamp(stamp_ns or None, received_ns)).time_ns
        if self._ahead_ns is None:
            # Stamps and receipts are of one clock, or else of no known relation.
            delay_ns = received_ns - (stamp_ns or received_ns)
            self._ahead_ns = time_ns - played_ns + (
                delay_ns if abs(delay_ns) <= MAX_DELAY_NS else 0)
        return time_ns - self._ahead_ns
