# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The stamp of a picture, what was made of it, and that in words."""

from enum import Enum
from typing import NamedTuple

from sph_stab_ros.geometry.conventions import NS_PER_S

S_PER_YEAR = 31_556_952
S_PER_DAY = 86_400


class TimeEvent(Enum):
    """Something about the time of a picture that its user should hear of."""

    MISSING = 'stamp_missing'
    UNSTAMPED = 'no_stamps'
    NOT_INCREASING = 'stamp_not_increasing'
    OUTLIER = 'stamp_outlier'
    STEP_FORWARD = 'time_went_forward'
    STEP_BACK = 'time_went_back'


class Stamp(NamedTuple):
    """The stamp of a picture, None without one, and when it was received if that is known."""

    stamp_ns: int | None
    received_ns: int | None = None


class PictureTime(NamedTuple):
    """
    The times of a picture.

    ``stamp_ns`` is the stamp, or what fills its place; ``time_ns`` is that on the timeline;
    ``clock_ns`` is what a right clock of the same epoch would have shown, which other sensors'
    stamps count by. ``event`` is what was found out with this picture, maybe about those shortly
    before, and ``by_ns`` by how much their stamps are off or step.
    """

    stamp_ns: int
    time_ns: int
    clock_ns: int
    event: TimeEvent | None = None
    by_ns: int = 0


def told(times: PictureTime) -> str:
    """Return in words what was found out about the time of a picture."""
    off = duration(times.by_ns)
    return {
        TimeEvent.MISSING: 'its stamp is zero or missing, and is replaced',
        TimeEvent.UNSTAMPED: 'the stamps are zero or missing, times of receipt are used',
        TimeEvent.NOT_INCREASING: 'its stamp is not later than the one before; it is shown '
                                  'between its neighbours',
        TimeEvent.OUTLIER: f'a single stamp is off by {off}; it is shown between its neighbours',
        TimeEvent.STEP_FORWARD: f'the stamps step by {off}; pictures go on at their pace',
        TimeEvent.STEP_BACK: f'the stamps step by {off}; pictures go on at their pace',
    }[times.event] if times.event else ''


def duration(ns: int) -> str:
    """Return a signed duration in seconds and, where it is long, in what people count in."""
    seconds = ns / NS_PER_S
    for unit_s, unit in (S_PER_YEAR, 'years'), (S_PER_DAY, 'days'):
        if abs(seconds) >= unit_s:
            return f'{seconds:+.3f} s ({abs(seconds) / unit_s:.1f} {unit})'
    return f'{seconds:+.3f} s'
