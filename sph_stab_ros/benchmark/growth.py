# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What the anchored tracker takes as a recording becomes longer: time per frame and memory."""

from collections.abc import Callable, Iterable, Sequence
from itertools import chain, cycle, islice
import os
from time import perf_counter
from typing import Any

import numpy as np

from sph_stab_ros.command_line.processes import memory_mb
from sph_stab_ros.config import TrackerConfig
from sph_stab_ros.geometry.arrays import Grey
from sph_stab_ros.geometry.conventions import NS_PER_S
from sph_stab_ros.tracking import make_tracker, TrackingStatus

# As much of a recording as is kept in memory, to be played there and back.
MAX_PICTURES = 500
PERIOD_NS = NS_PER_S // 30


def growth(spheres: Sequence[Grey], frames: int,
           progress: Callable[[Iterable[int]], Iterable[int]] = iter) -> dict[str, Any]:
    """
    Return what the first and the last tenth of so many frames took, by name.

    Parameters
    ----------
    spheres
        Of one size, at least two; played there and back over and over.
    frames
        At least ten. Memory is taken after the first tenth, in which the tracker warms up.
    progress
        Passes on the iterator of frame numbers that it is given.

    """
    tracker = make_tracker(TrackerConfig(), spheres[0].shape[1])
    there_and_back = islice(cycle(chain(spheres, spheres[-2:0:-1])), frames)
    tenth = frames // 10
    times_ms, lost = np.empty(frames), 0
    for number, grey in zip(progress(range(frames)), there_and_back):
        start_s = perf_counter()
        tracked = tracker.track(grey, number * PERIOD_NS)
        times_ms[number] = 1000 * (perf_counter() - start_s)
        lost += tracked.status is not TrackingStatus.OK
        if number + 1 == tenth:
            early = _held_by(tracker)
    return {
        'frames': frames, 'width': spheres[0].shape[1], 'lost_frames': lost,
        'first_tenth': {'median_ms': float(np.median(times_ms[:tenth])), **early},
        'last_tenth': {'median_ms': float(np.median(times_ms[-tenth:])), **_held_by(tracker)}}


def _held_by(tracker: Any) -> dict[str, float]:
    return {'memory_mb': memory_mb(os.getpid())['rss'], 'keyframes': tracker.keyframes_kept,
            'landmarks': tracker.landmarks_kept}
