# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Which stage of the work takes how much of the CPU."""

from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from threading import Lock
from time import monotonic, process_time


class CpuMeter:
    """
    Adds up the process's CPU time by stages; its methods may be called from any thread.

    It is the process's and not the thread's since OpenCV works in threads of its own. What else
    runs meanwhile, such as the receipt of the next image, counts too.
    """

    def __init__(self) -> None:
        self._lock = Lock()
        self._stages_s: defaultdict[str, float] = defaultdict(float)
        self._start()

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Count the CPU time of the block to a stage."""
        start_s = process_time()
        try:
            yield
        finally:
            with self._lock:
                self._stages_s[name] += process_time() - start_s

    def percentages(self) -> dict[str, float]:
        """Return the CPU by stage and in 'total' since the last call, in percent of one core."""
        with self._lock:
            percent_per_s = 100 / (monotonic() - self._start_s)
            used_s = {**self._stages_s, 'total': process_time() - self._start_cpu_s}
            self._start()
        return {name: percent_per_s * seconds for name, seconds in used_s.items()}

    def _start(self) -> None:
        self._start_s, self._start_cpu_s = monotonic(), process_time()
        # A stage that was seen once is told of even when it rests.
        self._stages_s = defaultdict(float, dict.fromkeys(self._stages_s, 0.))
