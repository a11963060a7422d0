# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The whole of offline tracking: which passes there are, and what comes out."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from typing import Any, TypeAlias

from scipy.spatial.transform import Rotation

from sph_stab_ros.config import TrackerConfig
from sph_stab_ros.geometry.arrays import Grey, Mask, Plane
from sph_stab_ros.tracking.anchored.tracker import AnchoredTracker
from sph_stab_ros.tracking.base import GyroRotation, TrackedOrientation, Tracker
from sph_stab_ros.tracking.factory import make_tracker
from sph_stab_ros.tracking.offline.fusion import fuse
from sph_stab_ros.tracking.offline.grey_spool import GreySpool
from sph_stab_ros.tracking.offline.hindsight import HindsightTracker

# Passes on grey spheres, of which there are so many, and may tell of it.
Progress: TypeAlias = Callable[[Iterator[Grey], int], Iterable[Grey]]


class TwoPasses:
    """
    Orientations of a recording's frames by all of them, those that come later too.

    Its methods stand in for ``make_tracker``: ``first_tracker`` for a first reading, which tracks
    forwards and keeps grey spheres on disk. ``finish`` then tracks these backwards, and fuses.
    After that ``known_tracker``, for as many readings of the same frames as are wanted, tells.
    """

    def __init__(self) -> None:
        self._reading: FirstReading | None = None
        # For each size that the frames have had.
        self._orientations: list[list[TrackedOrientation]] = []
        self._told = 0

    def first_tracker(self, config: TrackerConfig, width: int, gyro_rotation: GyroRotation,
                      seen: Mask | None = None, readout_shares: Plane | None = None) -> Tracker:
        """Return a Tracker that takes in frames, by the anchored tracker that a config means."""
        def make(gyro_rotation: GyroRotation, backwards: bool) -> HindsightTracker:
            # Then the row that was read last is the first.
            readout_s = -config.rolling_shutter_s if backwards else config.rolling_shutter_s
            tracker = make_tracker(replace(config, rolling_shutter_s=readout_s), width,
                                   gyro_rotation, seen, readout_shares)
            assert isinstance(tracker, AnchoredTracker), 'the others have no landmarks'
            return HindsightTracker(tracker)
        self.finish()
        self._reading = FirstReading(make, gyro_rotation)
        return self._reading

    def finish(self, progress: Progress = lambda greys, count: greys) -> None:
        """Track backwards what was taken in."""
        if self._reading is not None:
            self._orientations.append(self._reading.finish(progress))
            self._reading = None

    def known_tracker(self, *_: Any, **__: Any) -> Tracker:
        """Return the Tracker that tells the orientations of frames that are read once more."""
        orientations = self._orientations[self._told % len(self._orientations)]
        self._told += 1
        return KnownOrientations(orientations)


class FirstReading:
    """A forward pass, as a Tracker, and the backward one after it."""

    def __init__(self, make: Callable[[GyroRotation, bool], HindsightTracker],
                 gyro_rotation: GyroRotation) -> None:
        self._make, self._gyro_rotation = make, gyro_rotation
        self.reset()

    def reset(self) -> None:
        """Forget everything."""
        self._forward = self._make(self._gyro_rotation, False)
        self._spool = GreySpool()
        self._stamps_ns: list[int] = []
        # What a gyro saw is soon forgotten: R_first_camera by the turns that it told, and how many
        # it did not tell.
        self._gyro: list[tuple[Rotation, int]] = []

    def settle(self) -> None:
        """Do nothing that was put off: nothing is."""

    def track(self, grey: Grey, stamp_ns: int) -> TrackedOrientation:
        """Return what the live tracker says of the next grey sphere."""
        R_first_camera, untold = self._gyro[-1] if self._gyro else (Rotation.identity(), 0)
        turn = self._gyro_rotation(self._stamps_ns[-1], stamp_ns) if self._gyro else None
        self._gyro.append((R_first_camera, untold + 1) if turn is None else
                          (R_first_camera * turn, untold))
        self._stamps_ns.append(stamp_ns)
        self._spool.add(grey)
        return self._forward.track(grey, stamp_ns)

    def finish(self, progress: Progress) -> list[TrackedOrientation]:
        """Return the orientations of all frames, by both passes."""
        forward = self._forward.finish()
        # Its map is as large as the next one's.
        del self._forward
        backward = self._make(self._gyro_rotation_backwards(), True)
        greys = progress(self._spool.backwards(), len(self._spool))
        # Time runs backwards, and forwards for the tracker.
        for grey, stamp_ns in zip(greys, reversed(self._stamps_ns)):
            backward.track(grey, -stamp_ns)
        return fuse(forward, backward.finish()[::-1], backward.lag_frames)

    def _gyro_rotation_backwards(self) -> GyroRotation:
        """Return what tells turns between stamps of the backward pass, as the gyro saw them."""
        told = dict(zip((-stamp_ns for stamp_ns in self._stamps_ns), self._gyro))

        def gyro_rotation(from_ns: int, to_ns: int) -> Rotation | None:
            (R_first_from, before), (R_first_to, after) = told[from_ns], told[to_ns]
            return None if before != after else R_first_from.inv() * R_first_to
        return gyro_rotation


class KnownOrientations:
    """A Tracker of frames whose orientations are known."""

    def __init__(self, orientations: list[TrackedOrientation]) -> None:
        self._orientations = orientations
        self.reset()

    def reset(self) -> None:
        """Begin with the first frame."""
        self._left = iter(self._orientations)

    def settle(self) -> None:
        """Do nothing that was put off: nothing is."""

    def track(self, grey: Grey, stamp_ns: int) -> TrackedOrientation:
        """Return the TrackedOrientation of the next frame."""
        return next(self._left)
