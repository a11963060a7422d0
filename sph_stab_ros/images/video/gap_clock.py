# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""
Gaps in a stream that its own numbers do not show.

These begin again after a while, and with each key picture: where as many pictures are missing as
there are from one key picture to the next, what follows looks like what is expected.
"""

from collections import deque
from statistics import median

from sph_stab_ros.images.picture_time import Stamp

# By so many pictures it is known how often they come.
MEASURED = 4
KEY_PERIODS_KEPT = 5
# Of the pictures after which numbers begin again: pictures come neither in the order of
# presentation nor at quite regular times.
SHARE = 0.5
LEAST_MISSING = 2


class GapClock:
    """Tells by the times of pictures, in the order of decoding, whether many may be missing."""

    def __init__(self) -> None:
        self._key_periods: deque[int] = deque(maxlen=KEY_PERIODS_KEPT)
        self.restart()

    def restart(self) -> None:
        """Go on behind a gap, with a key picture."""
        self._first = self._last = Stamp(None)
        self._count = self._since_key = 0

    def add(self, stamp: Stamp, is_key: bool) -> None:
        """Note the times of a picture."""
        if is_key and self._since_key:
            self._key_periods.append(self._since_key)
        self._since_key = 1 if is_key else self._since_key + 1
        if not self._count:
            self._first = self._last = stamp
        self._count += 1
        # Not all are in the order of presentation.
        self._last = Stamp(*(new if old is None or new is not None and new > old else old
                             for old, new in zip(self._last, stamp)))

    def is_gap(self, stamp: Stamp, wrap: int) -> bool:
        """
        Tell whether so many may be missing that the numbers of pictures, of ``wrap``, began again.

        Where there are stamps and times of receipt, both must say so: clocks are set, and
        messages held up.
        """
        if self._count < MEASURED:
            return False
        missing = max(SHARE * min(wrap, median(self._key_periods or [wrap])), LEAST_MISSING)
        said = [new - last > missing * (last - first) / (self._count - 1) > 0
                for first, last, new in zip(self._first, self._last, stamp)
                if first is not None and last is not None and new is not None]
        return bool(said) and all(said)
