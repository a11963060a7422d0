# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""
The anchored tracker: landmarks of which each keeps the look it had when it was first seen.

What is compared with its first look instead of with the last frame does not drift. Each frame is
located among the landmarks; now and then one becomes a keyframe, and the last keyframes' poses and
the landmarks' depths are adjusted together. Inactive ones are looked for again when near.
"""

import cv2
import numpy as np

from sph_stab_ros.geometry.arrays import Covariance, Grey, Mask, Vector
from sph_stab_ros.geometry.rotations import rotate_covariance, rotation_from_matrix
from sph_stab_ros.images.texture import has_texture
from sph_stab_ros.tracking.anchored.body_mask import VisibleWorld
from sph_stab_ros.tracking.anchored.correction import SmoothCorrection
from sph_stab_ros.tracking.anchored.landmark_map import LandmarkMap, MAX_LANDMARKS
from sph_stab_ros.tracking.anchored.landmarks import Observations
from sph_stab_ros.tracking.anchored.localization import (
    DOUBTFUL, Localization, localize, MIN_MATURE, MIN_POINTS, returning)
from sph_stab_ros.tracking.anchored.map_initialization import MapInitializer
from sph_stab_ros.tracking.anchored.prepared_frame import PreparedFrame
from sph_stab_ros.tracking.anchored.relocalization import Relocalizer, SIGMA_RAD
from sph_stab_ros.tracking.anchored.thumbnail import align_thumbnails, likely_turns, Thumbnail
from sph_stab_ros.tracking.anchored.wide_baseline import locate_widely
from sph_stab_ros.tracking.base import (
    GyroRotation, no_gyro, status_of, TrackedOrientation, TrackingStatus)
from sph_stab_ros.tracking.motion_model import MotionModel

# A new keyframe is made where fewer of the landmarks than these are seen, or where they have moved
# further since the last one, in the median.
MIN_SURVIVORS = 0.4
MAX_PARALLAX_RAD = 0.04
# How far the camera moves against a prediction, in the unit of the map, per second.
POSITION_SIGMA_PER_S, MIN_POSITION_SIGMA = 0.6, 0.02
# After a longer time patches are searched coarsely first.
MAX_FINE_S = 0.05
# After a loss so many of the last keyframes are tried, from the likeliest headings.
MAX_CANDIDATES, MAX_ATTEMPTS = 6, 3
# How a camera that was lost is turned nobody knows.
LOST_RAD = 1.
SCALE_RATE = 0.1  # at which the usual scale of residuals follows that of each frame


class AnchoredTracker:
    """
    Orientation among landmarks, of which those at places seen before are used again.

    Parameters
    ----------
    width : int
        Of the grey spheres.
    used : (H, W) bool, optional
        Pixels to use.
    max_prediction_s : float
        For how long the last angular velocity is trusted.
    gyro_rotation : callable
        Returns the turn ``R_from_to`` between two stamps, or None.

    """

    def __init__(self, width: int, used: Mask | None = None, max_prediction_s: float = 0.5,
                 gyro_rotation: GyroRotation = no_gyro) -> None:
        self._used = used
        self._max_prediction_s, self._turn_between = max_prediction_s, gyro_rotation
        self.reset()

    def reset(self) -> None:
        """Forget everything: the next frame's orientation is the new world."""
        self._map = LandmarkMap()
        self._visible = VisibleWorld(self._used)
        self._thumbnail: Thumbnail | None = None
        self._motion = MotionModel(self._max_prediction_s, self._turn_between)
        self._covariance: Covariance = np.zeros((3, 3))
        self._correction = SmoothCorrection()
        self._keyframe_to_add: tuple[PreparedFrame, Localization] | None = None
        self._relocalizer: Relocalizer | None = None

    @property
    def body_mask(self) -> Mask:
        """Pixels (80, 160) bool of the camera that stand still while the world turns."""
        return self._visible.still.mask

    @property
    def lens_misalignment(self) -> tuple[Vector, Covariance]:
        """Rotation vector (3,) between a stitched picture's halves, and its covariance (3, 3)."""
        return self._map.lenses.apart, self._map.lenses.apart_covariance

    @property
    def keyframes_kept(self) -> int:
        """Return the number of keyframes in the map."""
        return len(self._map.keyframes)

    @property
    def landmarks_kept(self) -> int:
        """Return the number of landmarks in the map."""
        return 0 if self._map.landmarks is None else len(self._map.landmarks)

    def track(self, grey: Grey, stamp_ns: int) -> TrackedOrientation:
        """Return the TrackedOrientation of the next grey sphere (H, W) uint8."""
        self.settle()
        frame = PreparedFrame(grey)
        if not has_texture(frame.small):
            return self._predicted(stamp_ns)
        if not self._map.keyframes:
            self._start_map(frame, stamp_ns)
        else:
            localization = None if self._map.landmarks is None else (
                self._locate(frame, stamp_ns) or self._relocalize_nearby(frame, stamp_ns)
                or self._locate_widely(frame))
            if localization is None:
                held = self._predicted(stamp_ns)
                if held.status is TrackingStatus.LOST:
                    self._motion.R_world_camera = held.R_world_camera
                    self._start_anew(frame)
                return held
            self._accept(frame, stamp_ns, localization)
            self._judge_landmarks(localization)
            if self._is_keyframe(localization):
                self._keyframe_to_add = frame, localization
        return TrackedOrientation(
            self._correction.R_out_world * self._motion.R_world_camera,
            status_of(self._covariance), self._covariance)

    def settle(self) -> None:
        """Do what the last orientation did not have to wait for: keyframes, and recognition."""
        # Taken off first: one that fails must not fail again with every frame to come.
        keyframe, self._keyframe_to_add = self._keyframe_to_add, None
        if keyframe:
            self._add_keyframe(*keyframe)
            if self._relocalizer and self._relocalizer.is_over:
                self._relocalizer = self._relocalizer.with_another(
                    keyframe[0].grey, self._motion.R_world_camera)
        if self._relocalizer and not self._relocalizer.is_over:
            self._relocalize_globally()

    def _start_anew(self, frame: PreparedFrame) -> None:
        """Start a map in a world of its own, until the old one is recognised."""
        # Lost again before that, it is still the old one that counts.
        keyframes = (self._relocalizer or self._map).keyframes
        self._relocalizer = Relocalizer(
            keyframes, frame.grey, self._motion.R_world_camera, self._used_pixels(frame))
        self._covariance = LOST_RAD ** 2 * np.eye(3)
        self._start_map(frame, None)

    def _used_pixels(self, frame: PreparedFrame) -> Mask:
        """Return which pixels of the grey sphere show the world, (H, W) bool."""
        return cv2.resize(self._visible.pixels().astype(np.uint8), frame.grey.shape[::-1],
                          interpolation=cv2.INTER_NEAREST) > 0

    def _relocalize_globally(self) -> None:
        """Go on looking for the old world, and turn the new one into it once it is found."""
        assert self._relocalizer is not None
        R_old_new = self._relocalizer.step()
        if R_old_new is not None:
            known_better = SIGMA_RAD ** 2 - LOST_RAD ** 2
            self._map.turn(R_old_new, known_better)
            self._motion.rotate_world(R_old_new)
            self._covariance = (rotate_covariance(self._covariance, R_old_new)
                                + known_better * np.eye(3))
            self._correction.reset()
            self._relocalizer = None

    def _start_map(self, frame: PreparedFrame, stamp_ns: int | None) -> None:
        """Start anew from here, in the orientation reached."""
        self._map = LandmarkMap()
        self._motion.reset(stamp_ns)
        self._correction.reset()
        self._visible.update(frame.small, None)
        self._thumbnail = frame.thumbnail
        self._map.add_keyframe(
            self._motion.R_world_camera, self._motion.position, self._covariance, frame.grey,
            frame.thumbnail, Observations(np.empty(0, int), np.empty((0, 3)), np.empty((0, 2, 3))))
        self._map.add_landmarks(frame.grey, frame.pyramid, self._visible.pixels())
        self._landmarks_at_keyframe, self._scale = MAX_LANDMARKS, 1.
        self._initializer = None if self._map.landmarks is None else MapInitializer(
            self._map, POSITION_SIGMA_PER_S, MIN_POSITION_SIGMA)

    def _locate(self, frame: PreparedFrame, stamp_ns: int) -> Localization | None:
        """Return the Localization near where the camera is expected, None without."""
        assert self._map.landmarks is not None and self._thumbnail is not None
        motion = self._motion
        R_camera_last = align_thumbnails(
            self._thumbnail, frame.thumbnail, motion.predicted_rotation(stamp_ns).inv())
        if self._initializer is not None:
            return self._initializer.localize(
                frame.pyramid, R_camera_last, stamp_ns, self._visible.shows)
        elapsed_s = motion.trusted_s(stamp_ns)
        return localize(
            self._map, np.flatnonzero(self._map.landmarks.active), frame.pyramid,
            motion.R_world_camera * R_camera_last.inv(), motion.position_at(stamp_ns),
            max(POSITION_SIGMA_PER_S * elapsed_s, MIN_POSITION_SIGMA), self._scale,
            self._visible.shows, coarsely=elapsed_s > MAX_FINE_S)

    def _locate_widely(self, frame: PreparedFrame) -> Localization | None:
        """Return the Localization somewhere near the last keyframe, None without."""
        return locate_widely(
            self._map, frame.grey, frame.pyramid, self._used_pixels(frame), POSITION_SIGMA_PER_S,
            self._visible.shows, DOUBTFUL * self._scale)

    def _relocalize_nearby(self, frame: PreparedFrame, stamp_ns: int) -> Localization | None:
        """Return the Localization near one of the last keyframes, whatever the camera has done."""
        landmarks = self._map.landmarks
        assert landmarks is not None
        for keyframe, R_camera_key in likely_turns(
                self._map.keyframes[-MAX_CANDIDATES:], frame.thumbnail)[:MAX_ATTEMPTS]:
            if self._initializer is not None:
                R_camera_last = (R_camera_key * rotation_from_matrix(keyframe.R).inv()
                                 * self._motion.R_world_camera)
                localization = self._initializer.localize(
                    frame.pyramid, R_camera_last, stamp_ns, self._visible.shows)
                if localization is not None:
                    return localization
                continue
            rows = np.flatnonzero((landmarks.host == keyframe.number)
                                  | np.isin(landmarks.number, keyframe.observations.number))
            localization = localize(
                self._map, rows, frame.pyramid,
                rotation_from_matrix(keyframe.R) * R_camera_key.inv(), keyframe.position,
                POSITION_SIGMA_PER_S, self._scale, self._visible.shows, coarsely=True)
            if localization is not None:
                landmarks.wake(localization.rows)
                self._correction.reset()
                return localization
        return None

    def _accept(self, frame: PreparedFrame, stamp_ns: int, localization: Localization) -> None:
        """Make this frame the last one that showed something."""
        pose, R_world_camera = localization.pose, localization.R_world_camera
        step = self._motion.update(stamp_ns, R_world_camera, pose.position)
        self._visible.update(frame.small, step.inv())
        self._thumbnail = frame.thumbnail
        self._scale += SCALE_RATE * (localization.pose.scale - self._scale)
        R_world_first = rotation_from_matrix(self._map.keyframes[0].R)
        self._covariance = (self._map.keyframes[-1].covariance
                            + rotate_covariance(pose.covariance[:3, :3], R_world_camera)
                            + self._map.lenses.covariance(R_world_first.inv() * R_world_camera))
        if self._initializer is not None and self._initializer.R_world_continued is not None:
            # When another pose counts than did before, the picture follows smoothly.
            self._correction.hide(self._initializer.R_world_continued, R_world_camera)
        self._correction.step()

    def _judge_landmarks(self, localization: Localization) -> None:
        """Note which landmarks agree; deactivate those that are not seen or do not."""
        landmarks = self._map.landmarks
        assert landmarks is not None
        # At the start nobody is judged for good.
        judge = landmarks.judge if self._initializer is None else landmarks.judge_for_now
        judge(localization.rows, localization.agreeing, localization.pose.inverse_depths)

    def _is_keyframe(self, localization: Localization) -> bool:
        assert self._map.landmarks is not None
        seen = localization.rows[localization.agreeing]
        last, some = self._map.keyframes[-1], seen[::4]
        parallax_rad = np.median(np.linalg.norm(
            self._map.directions(some, self._motion.position)
            - self._map.directions(some, last.position), axis=1))
        if parallax_rad > MAX_PARALLAX_RAD:
            return True
        if self._initializer is not None:
            return len(localization.rows) < MIN_SURVIVORS * len(self._map.landmarks)
        # In the beginning those that move by themselves must have time to tell.
        mature = self._map.landmarks.is_mature(seen).sum()
        return len(seen) < (MIN_SURVIVORS * self._landmarks_at_keyframe
                            if mature >= MIN_MATURE else 2 * MIN_POINTS)

    def _add_keyframe(self, frame: PreparedFrame, localization: Localization) -> None:
        """Make this frame a keyframe, adjust the last ones, look for new landmarks."""
        assert self._map.landmarks is not None
        self._initializer = None
        motion, before = self._motion, self._motion.R_world_camera
        observations = Observations.joined((
            localization.observations(self._map.landmarks, localization.agreeing),
            returning(self._map, frame.pyramid, before, motion.position, self._visible.shows)))
        self._map.add_keyframe(before, motion.position, self._covariance, frame.grey,
                               frame.thumbnail, observations[np.argsort(observations.number)])
        self._map.adjust()
        keyframe = self._map.keyframes[-1]
        motion.R_world_camera = rotation_from_matrix(keyframe.R)
        motion.position = keyframe.position
        self._correction.hide(before, motion.R_world_camera)
        self._map.add_landmarks(frame.grey, frame.pyramid, self._visible.pixels())
        self._map.shrink()
        self._landmarks_at_keyframe = self._map.landmarks.active.sum()

    def _predicted(self, stamp_ns: int) -> TrackedOrientation:
        """Turn the last orientation on, by the gyro or its angular velocity, as far as known."""
        motion = self._motion
        R_world_camera = motion.R_world_camera * motion.predicted_rotation(stamp_ns)
        return TrackedOrientation(
            self._correction.R_out_world * R_world_camera,
            TrackingStatus.PREDICTED if motion.is_predictable(stamp_ns) else TrackingStatus.LOST)
