# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""
What the times of pictures mean, decided in one place.

A picture has a *stamp*: the reading of a clock when it was taken, which may be missing, repeated,
false once, or of a clock that is set to another time between two pictures. A ``PictureClock``
makes of stamps a *timeline* that always goes forward and keeps the pace of the pictures::

    stamps      5.00  5.03  5.07  1.7e9  1.7e9 + .03        the clock is set: a step
    timeline    5.00  5.03  5.07  5.10   5.13
    stamps      5.00  5.03  99    5.10   5.13               one stamp is false: an outlier
    timeline    5.00  5.03  5.07  5.10   5.13

Stamps that increase, without pauses beyond an hour, are left as they are. A pause is told from a
step forward by the times of receipt, where they are known. Pictures between two steps are an
*epoch*, in which the timeline is behind the clock by a constant.
"""

from collections import deque
from collections.abc import Sequence
from typing import NamedTuple

from sph_stab_ros.geometry.conventions import NS_PER_S
from sph_stab_ros.images.picture_time import PictureTime, Stamp, TimeEvent

# Without a picture for longer, the clock was set.
MAX_PAUSE_NS = 3600 * NS_PER_S
# Receipt is delayed by up to this, and by as much more or less for the next picture.
MAX_DELAY_NS = NS_PER_S
# Stamps that go back by no more are those of pictures out of order, no clock's that was set back.
MAX_JITTER_NS = NS_PER_S // 10
# As long as the period is not known from the pictures.
NOMINAL_PERIOD_NS = NS_PER_S // 30
PERIODS_KEPT = 5
# So many pictures in a row, of a time apart, make an epoch for who cannot look ahead.
CONFIRMED = 3


class _Picture(NamedTuple):
    stamp_ns: int
    received_ns: int | None
    time_ns: int


class PictureClock:
    """
    Decides the times of a sequence of pictures, one after the other.

    Parameters
    ----------
    period_ns
        The period to assume before the pictures tell it.
    first
        The first Stamp that is not missing, where it is known; the pictures before it are then of
        its clock. Else, before there is one, missing stamps are replaced by times of receipt.

    """

    def __init__(self, period_ns: int = NOMINAL_PERIOD_NS, first: Stamp | None = None) -> None:
        self._nominal_period_ns = period_ns
        self._first = first
        self._is_stamped = first is not None
        # What to subtract from the clock for the timeline, and the epoch's last good picture.
        self._offset_ns = 0
        self._good: _Picture | None = None
        # The last pictures that are not of the epoch but follow each other.
        self._suspects: list[_Picture] = []
        self._last: _Picture | None = None
        self._periods_ns: deque[int] = deque(maxlen=PERIODS_KEPT)
        self._receipts_tell = True

    def decide(self, stamp: Stamp, upcoming: Sequence[Stamp] = ()) -> PictureTime:
        """Return the time of the next picture; Stamps of those after it, if known, help."""
        filled = TimeEvent.MISSING if stamp.stamp_ns is None else None
        if filled and not self._is_stamped and not any(u.stamp_ns is not None for u in upcoming):
            # There is no other clock. Without receipts the period is.
            filled = TimeEvent.UNSTAMPED
            received_ns = stamp.received_ns
            if received_ns is None:
                received_ns = 0 if self._last is None else self._last.time_ns + self.period_ns
            stamp = Stamp(received_ns)
        elif not filled:
            self._is_stamped = True
        decided = self._decided(stamp, upcoming)
        self._last = _Picture(decided.stamp_ns, stamp.received_ns, decided.time_ns)
        return decided._replace(event=decided.event or filled)

    @property
    def period_ns(self) -> int:
        """Return the usual time from one picture to the next."""
        if not self._periods_ns:
            return self._nominal_period_ns
        return sorted(self._periods_ns)[len(self._periods_ns) // 2]

    def _decided(self, stamp: Stamp, upcoming: Sequence[Stamp]) -> PictureTime:
        if stamp.stamp_ns is None:
            time_ns = self._neighbours_time(stamp, upcoming)
            return PictureTime(self._filled_stamp_ns(time_ns), time_ns, time_ns + self._offset_ns)
        picture = _Picture(stamp.stamp_ns, stamp.received_ns, stamp.stamp_ns - self._offset_ns)
        good = self._good
        if good is None:
            return self._begun(picture, upcoming)
        following = next((u for u in upcoming if u.stamp_ns is not None), None)
        if following is not None and self._receipts_deny(good, stamp) and (
                self._receipts_deny(stamp, following)):
            # Twice in a row: they are those of some other process than taking pictures.
            self._receipts_tell = False
        if self._follows(good, stamp):
            if following is not None and self._is_ahead(picture, following, good):
                return self._apart(picture, upcoming)
            if self._last is not None and picture.time_ns > self._last.time_ns or not (
                    self._suspects and self._follows(self._suspects[-1], stamp)):
                return self._accepted(picture)
        elif following is not None:
            if self._follows(good, following):
                return self._apart(picture, upcoming)
            if self._follows(picture, following):
                return self._stepped(picture._replace(time_ns=self._next_time_ns(picture)))
        return self._suspected(picture)

    def _begun(self, picture: _Picture, upcoming: Sequence[Stamp]) -> PictureTime:
        """Return the time of the first picture that has a stamp."""
        following, after, *_ = *(u for u in upcoming if u.stamp_ns is not None), None, None
        if (following is not None and after is not None and self._follows(following, after)
                and not (self._follows(picture, following) or self._follows(picture, after))):
            return self._apart(picture, upcoming)
        if self._last is not None and picture.time_ns - self._last.time_ns > MAX_PAUSE_NS:
            # What was filled in before was of another clock.
            return self._stepped(picture._replace(time_ns=self._next_time_ns(picture)))
        return self._accepted(picture)

    def _accepted(self, picture: _Picture) -> PictureTime:
        """Return the time of a picture of the epoch."""
        event, by_ns = None, 0
        if self._suspects:
            event, first = TimeEvent.OUTLIER, self._suspects[0]
            by_ns = first.stamp_ns - self._offset_ns - first.time_ns
            self._suspects = []
        if self._last is not None and picture.time_ns <= self._last.time_ns:
            picture = picture._replace(time_ns=self._last.time_ns + self._least_step_ns)
        if self._good is not None:
            self._periods_ns.append(picture.stamp_ns - self._good.stamp_ns)
        self._good = picture
        return self._in_epoch(picture, event, by_ns)

    def _apart(self, picture: _Picture, upcoming: Sequence[Stamp] = ()) -> PictureTime:
        """Return the time of a picture whose stamp tells nothing."""
        time_ns = self._neighbours_time(Stamp(None, picture.received_ns), upcoming)
        is_jitter = self._good is not None and _is_jitter(self._good, picture)
        return self._in_epoch(
            picture._replace(time_ns=time_ns),
            TimeEvent.NOT_INCREASING if is_jitter else TimeEvent.OUTLIER,
            picture.stamp_ns - self._offset_ns - time_ns)

    def _suspected(self, picture: _Picture) -> PictureTime:
        """Return the time of a picture that is not of the epoch, without knowing what follows."""
        assert self._good is not None
        if _is_jitter(self._good, picture):
            return self._apart(picture)
        if self._suspects:
            before = self._suspects[-1]
            if self._follows(before, picture):
                picture = picture._replace(
                    time_ns=before.time_ns + picture.stamp_ns - before.stamp_ns)
                if self._last is not None and picture.time_ns > self._last.time_ns:
                    self._suspects.append(picture)
                    return (self._stepped if len(self._suspects) == CONFIRMED
                            else self._in_epoch)(picture)
            elif self._receipts_deny(self._good, before) and self._receipts_deny(before, picture):
                self._receipts_tell, self._suspects = False, []
                return self._accepted(picture)
        picture = picture._replace(time_ns=self._next_time_ns(picture))
        self._suspects = [picture]
        return self._in_epoch(picture)

    def _in_epoch(self, picture: _Picture, event: TimeEvent | None = None, by_ns: int = 0
                  ) -> PictureTime:
        return PictureTime(picture.stamp_ns, picture.time_ns, picture.time_ns + self._offset_ns,
                           event, by_ns)

    def _stepped(self, picture: _Picture) -> PictureTime:
        """Return the time of a picture with which an epoch begins, or is found to have begun."""
        offset_ns = picture.stamp_ns - picture.time_ns
        by_ns, self._offset_ns = offset_ns - self._offset_ns, offset_ns
        self._good, self._suspects = picture, []
        event = TimeEvent.STEP_BACK if by_ns < 0 else TimeEvent.STEP_FORWARD
        if not self._periods_ns:
            # All that there was before is the first picture.
            event, by_ns = TimeEvent.OUTLIER, -by_ns
        return self._in_epoch(picture, event, by_ns)

    @property
    def _least_step_ns(self) -> int:
        """Return by how much times go forward that would rather not."""
        return max(self.period_ns // (4 if self._periods_ns else 32), 1)

    def _next_time_ns(self, stamp: Stamp | _Picture) -> int:
        """Return the time of a picture from that of the one before alone."""
        last = self._last
        if last is None:
            return 0 if stamp.stamp_ns is None else stamp.stamp_ns
        elapsed_ns = self._receipts_apart_ns(last, stamp)
        if elapsed_ns is not None and elapsed_ns > MAX_DELAY_NS:
            return last.time_ns + elapsed_ns
        return last.time_ns + max(self.period_ns, 1)

    def _neighbours_time(self, stamp: Stamp, upcoming: Sequence[Stamp]) -> int:
        """Return the time of a picture from those of its neighbours."""
        last, good = self._last, self._good
        steps, following = next(
            ((n, u) for n, u in enumerate(upcoming, 1) if u.stamp_ns is not None), (1, None))
        if good is None:
            time_ns = self._time_before_first(stamp, following or self._first, steps)
            if last is None:
                return time_ns
            return (self._next_time_ns(stamp) if time_ns - last.time_ns > MAX_PAUSE_NS
                    else max(time_ns, last.time_ns + self._least_step_ns))
        assert last is not None
        if following is not None and self._follows(good, following):
            between_ns = _reading(following) - self._offset_ns - last.time_ns
            if between_ns > steps:
                return last.time_ns + between_ns // (steps + 1)
        elapsed_ns = self._receipts_apart_ns(good, stamp)
        if elapsed_ns is not None:
            return max(good.time_ns + elapsed_ns, last.time_ns + self._least_step_ns)
        # A few find room before the epoch's next one, if that comes in time.
        room_ns = good.time_ns + self.period_ns - last.time_ns
        return last.time_ns + max(
            room_ns // 2 if room_ns > self.period_ns // 8 else self.period_ns, 1)

    def _time_before_first(self, stamp: Stamp, following: Stamp | None, steps: int) -> int:
        """Return the time of a picture that comes before the first one with a stamp."""
        if following is None:
            return self._next_time_ns(stamp)
        elapsed_ns = self._receipts_apart_ns(stamp, following)
        return _reading(following) - (elapsed_ns or steps * self.period_ns)

    def _filled_stamp_ns(self, time_ns: int) -> int:
        """Return a stamp in place of a missing one; clocks that count from zero show no less."""
        stamp_ns = time_ns + self._offset_ns
        first_ns = self._first.stamp_ns if self._first and self._first.stamp_ns else 0
        return stamp_ns if first_ns < 0 else max(stamp_ns, 0)

    def _is_ahead(self, picture: _Picture, following: Stamp, good: _Picture) -> bool:
        """Tell whether, of two stamps out of order, it is the first that is false."""
        following_ns, expected_ns = _reading(following), good.stamp_ns + self.period_ns
        return following_ns <= picture.stamp_ns and self._follows(good, following) and (
            abs(following_ns - expected_ns) < abs(picture.stamp_ns - expected_ns))

    def _follows(self, before: Stamp | _Picture, after: Stamp | _Picture) -> bool:
        """Tell whether two stamps can be of one epoch."""
        return 0 < _reading(after) - _reading(before) <= MAX_PAUSE_NS and not (
            self._receipts_deny(before, after))

    def _receipts_deny(self, before: Stamp | _Picture, after: Stamp | _Picture) -> bool:
        """Tell whether times of receipt are all that speaks against two stamps of one epoch."""
        elapsed_ns = _reading(after) - _reading(before)
        received_ns = self._receipts_apart_ns(before, after)
        return 0 < elapsed_ns <= MAX_PAUSE_NS and (
            received_ns is not None and elapsed_ns - received_ns > MAX_DELAY_NS)

    def _receipts_apart_ns(self, before: Stamp | _Picture, after: Stamp | _Picture) -> int | None:
        """Return the time between the receipts, None where they do not tell."""
        if not self._receipts_tell or before.received_ns is None or after.received_ns is None:
            return None
        elapsed_ns = after.received_ns - before.received_ns
        return elapsed_ns if 0 <= elapsed_ns <= MAX_PAUSE_NS else None


def _is_jitter(before: _Picture, after: _Picture) -> bool:
    return -MAX_JITTER_NS <= after.stamp_ns - before.stamp_ns <= 0


def _reading(stamp: Stamp | _Picture) -> int:
    assert stamp.stamp_ns is not None, 'asked of stamps that there are only'
    return stamp.stamp_ns
