# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""How many bits a second a browser can take, by what it acknowledges."""

from collections import deque
from collections.abc import Callable
from math import inf
from time import monotonic

MIN_BIT_RATE, FIRST_BIT_RATE, MAX_BIT_RATE = 1e6, 4e6, 8e6
# A decision takes what came since the last one into account, and has to show an effect first.
PERIOD_S = 0.5
# How much longer than the quickest pictures others may take to come back. The slowest quarter
# does not count: those a lost packet has held up. If there are more, smaller pictures, of fewer
# packets, are held up less often.
SLOW_QUANTILE, FINE_S, LATE_S = 0.75, 0.03, 0.08
SLOWER, LEAST = 0.85, 0.8
# In between it is a little too much.
EASIER = 0.97
# From where there was too much before, the way up is slow for a while.
FASTER, CAREFUL, NEAR, CALM_PERIODS = 1.08, 1.01, 0.8, 20
# Who has not taken what there was to take has not shown that there could be more.
TAKEN = 0.7
# How long the quickest are remembered; the way may have become longer.
MEMORY_PERIODS = 40


class RateControl:
    """
    Follows a browser's link: slower where pictures queue up on their way, else faster.

    ``bit_rate`` is what it can take, ``base_s`` how long the quickest pictures take from here to
    the news that they are drawn, None before the first.
    """

    def __init__(self, clock: Callable[[], float] = monotonic) -> None:
        self._clock = clock
        self.bit_rate = FIRST_BIT_RATE
        # What was too much the last time, and how many periods ago there was anything too much.
        self._limit = MAX_BIT_RATE
        self._calm_periods = CALM_PERIODS
        self.base_s: float | None = None
        self._quickest_s: deque[float] = deque(maxlen=MEMORY_PERIODS)
        self._begin(clock())

    def _begin(self, now_s: float) -> None:
        """Begin a period."""
        self._begin_s = now_s
        self._delays_s: list[float] = []
        self._bits = 0
        self._stalls = 0

    def acknowledged(self, size: int, delay_s: float) -> None:
        """Take in that a picture of so many bytes is drawn, so long after it was sent."""
        self._delays_s.append(delay_s)
        self._bits += 8 * size
        self.base_s = min(delay_s, self.base_s or inf)
        self._decide()

    def stalled(self) -> None:
        """Take in that a picture could not be sent, so many are on their way."""
        # Before the first is drawn the page begins, which takes its time.
        if self.base_s is not None:
            self._stalls += 1
            self._decide()

    def _decide(self) -> None:
        now_s = self._clock()
        passed_s = now_s - self._begin_s
        if passed_s < PERIOD_S:
            return
        if self._delays_s:
            self._quickest_s.append(min(self._delays_s))
            self.base_s = min(self._quickest_s)
            delay_s = sorted(self._delays_s)[int(SLOW_QUANTILE * len(self._delays_s))]
        else:
            delay_s = inf
        delivered = self._bits / passed_s
        late_s = delay_s - (self.base_s or 0.)
        self._calm_periods = 0 if late_s > FINE_S else self._calm_periods + 1
        if self._stalls > len(self._delays_s) or late_s > LATE_S:
            self._limit = self.bit_rate
            self.bit_rate *= SLOWER * min(1., max(delivered / self.bit_rate, LEAST))
        elif late_s > FINE_S:
            self.bit_rate *= EASIER
        elif delivered > TAKEN * self.bit_rate:
            is_careful = (self._calm_periods <= CALM_PERIODS
                          and self.bit_rate > NEAR * self._limit)
            self.bit_rate *= CAREFUL if is_careful else FASTER
        self.bit_rate = min(MAX_BIT_RATE, max(MIN_BIT_RATE, self.bit_rate))
        self._begin(now_s)
