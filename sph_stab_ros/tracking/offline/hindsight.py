# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""
Tracking with hindsight: each frame is located once more when the map has gone on.

The live tracker locates a frame among landmarks of which the newest have no depth yet, and at the
start none has. A second later they have, there are keyframes behind the frame as there are before
it, and all of them were adjusted: a fixed-lag smoother.
"""

from bisect import bisect_left
from collections import deque
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from sph_stab_ros.geometry.arrays import Covariance, Grey, Indices, Vector
from sph_stab_ros.geometry.rotations import rotate_covariance, rotation_from_matrix
from sph_stab_ros.tracking.anchored.keyframe import Keyframe
from sph_stab_ros.tracking.anchored.landmark_map import LandmarkMap
from sph_stab_ros.tracking.anchored.localization import localize
from sph_stab_ros.tracking.anchored.patches import Pyramid
from sph_stab_ros.tracking.anchored.tracker import AnchoredTracker
from sph_stab_ros.tracking.base import status_of, TrackedOrientation


@dataclass(frozen=True)
class HindsightOptions:
    """When a frame is located once more, and among what."""

    # That come in between, a second's: with 100 or 300 errors are the same.
    lag_frames: int = 30
    # Landmarks seen in so many keyframes before and as many behind the last one.
    keyframes: int = 2
    # Standard deviation of the position known before, in the unit of the map.
    position_sigma: float = 0.05


@dataclass(frozen=True)
class Located:
    """A frame, where it was located in which map, against its last keyframe."""

    grey: Grey
    landmark_map: LandmarkMap
    keyframe: Keyframe
    R_key_camera: Rotation
    position_in_key: Vector
    covariance: Covariance
    scale: float


class HindsightTracker:
    """An AnchoredTracker whose orientations come later, and are better."""

    def __init__(self, tracker: AnchoredTracker,
                 options: HindsightOptions = HindsightOptions()) -> None:
        self._tracker, self._options = tracker, options
        self._waiting: deque[Located | TrackedOrientation] = deque()
        self._map: LandmarkMap | None = None
        # Of the frames decided so far.
        self.orientations: list[TrackedOrientation] = []

    @property
    def lag_frames(self) -> int:
        """Return how many frames one waits for."""
        return self._options.lag_frames

    def track(self, grey: Grey, stamp_ns: int) -> TrackedOrientation:
        """Return what the live tracker says of the next grey sphere (H, W) uint8."""
        tracked = self._tracker.track(grey, stamp_ns)
        self._waiting.append(self._located(grey) or tracked)
        self._tracker.settle()
        if len(self._waiting) > self._options.lag_frames:
            self._decide()
        return tracked

    def finish(self) -> list[TrackedOrientation]:
        """Return the TrackedOrientation of every frame, by all that is known now."""
        while self._waiting:
            self._decide()
        return self.orientations

    def _located(self, grey: Grey) -> Located | None:
        """Return where the last frame was located, None where it was not."""
        landmark_map, localization = self._tracker.landmark_map, self._tracker.localization
        is_first, self._map = landmark_map is not self._map, landmark_map
        if not landmark_map.keyframes or (localization is None and not is_first):
            return None
        keyframe = landmark_map.keyframes[-1]
        if localization is None:
            return Located(grey, landmark_map, keyframe, Rotation.identity(), np.zeros(3),
                           np.zeros((3, 3)), 1.)
        R_key_world, pose = rotation_from_matrix(keyframe.R).inv(), localization.pose
        return Located(grey, landmark_map, keyframe, R_key_world * localization.R_world_camera,
                       R_key_world.apply(pose.position - keyframe.position),
                       pose.covariance[:3, :3], pose.scale)

    def _decide(self) -> None:
        """Locate the frame that has waited longest once more."""
        waited = self._waiting.popleft()
        self.orientations.append(
            self._located_again(waited) if isinstance(waited, Located) else waited)

    def _located_again(self, one: Located) -> TrackedOrientation:
        """Return the orientation in the map as it is now; by its keyframe where that is all."""
        landmark_map, options, tracker = one.landmark_map, self._options, self._tracker
        R_world_key = rotation_from_matrix(one.keyframe.R)
        R_world_camera, covariance = R_world_key * one.R_key_camera, one.covariance
        # As long as there is but one nothing has been learnt.
        if len(landmark_map.keyframes) > 1:
            found = localize(
                landmark_map, self._rows(one), Pyramid(one.grey, landmark_map.options.patches),
                R_world_camera, one.keyframe.position + R_world_key.apply(one.position_in_key),
                options.position_sigma, one.scale, tracker.visible.shows, True,
                tracker.options.localization)
            if found is not None:
                R_world_camera, covariance = found.R_world_camera, found.pose.covariance[:3, :3]
        covariance = (one.keyframe.covariance + rotate_covariance(covariance, R_world_camera)
                      + landmark_map.lens_covariance(R_world_camera))
        return TrackedOrientation(R_world_camera, status_of(covariance), covariance)

    def _rows(self, one: Located) -> Indices:
        """Return the rows of landmarks that belong to keyframes around a frame, or seen there."""
        keyframes, count = one.landmark_map.keyframes, self._options.keyframes
        place = bisect_left(keyframes, one.keyframe.number, key=lambda other: other.number)
        near = keyframes[max(place - count, 0):place + count + 1]
        landmarks = one.landmark_map.landmarks
        return np.flatnonzero(
            np.isin(landmarks.host, [other.number for other in near])
            | np.isin(landmarks.number,
                      np.concatenate([other.observations.number for other in near])))
