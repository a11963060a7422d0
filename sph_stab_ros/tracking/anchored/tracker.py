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
from sph_stab_ros.tracking.anchored.landmark_map import LandmarkMap
from sph_stab_ros.tracking.anchored.landmarks import Observations
from sph_stab_ros.tracking.anchored.localization import (
    Localization, localize, returning)
from sph_stab_ros.tracking.anchored.map_initialization import MapInitializer
from sph_stab_ros.tracking.anchored.options import AnchoredOptions
from sph_stab_ros.tracking.anchored.prepared_frame import PreparedFrame
from sph_stab_ros.tracking.anchored.relocalization import Relocalizer
from sph_stab_ros.tracking.anchored.thumbnail import align_thumbnails, likely_turns, Thumbnail
from sph_stab_ros.tracking.anchored.wide_baseline import locate_widely
from sph_stab_ros.tracking.base import GyroRotation, no_gyro, TrackedOrientation, TrackingStatus
from sph_stab_ros.tracking.motion_model import MotionModel


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
    options : AnchoredOptions

    """

    def __init__(self, width: int, used: Mask | None = None, max_prediction_s: float = 0.5,
                 gyro_rotation: GyroRotation = no_gyro,
                 options: AnchoredOptions = AnchoredOptions()) -> None:
        self._options, self._used = options, used
        self._max_prediction_s, self._turn_between = max_prediction_s, gyro_rotation
        self.reset()

    def reset(self) -> None:
        """Forget everything: the next frame's orientation is the new world."""
        options = self._options
        self._map = LandmarkMap(options.landmark_map)
        self._visible = VisibleWorld(self._used, options.body_mask)
        self._thumbnail: Thumbnail | None = None
        self._motion = MotionModel(self._max_prediction_s, self._turn_between, options.motion)
        self._covariance: Covariance = np.zeros((3, 3))
        self._correction = SmoothCorrection(options.correction)
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
        return len(self._map.landmarks)

    def track(self, grey: Grey, stamp_ns: int) -> TrackedOrientation:
        """Return the TrackedOrientation of the next grey sphere (H, W) uint8."""
        self.settle()
        frame = PreparedFrame(grey, self._options.landmark_map.patches, self._options.thumbnails)
        if not has_texture(frame.small):
            return self._predicted(stamp_ns)
        if not self._map.keyframes:
            self._start_map(frame, stamp_ns)
        else:
            localization = None if not len(self._map.landmarks) else (
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
            self._correction.R_out_world * self._motion.R_world_camera, TrackingStatus.OK,
            self._covariance)

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
            keyframes, frame.grey, self._motion.R_world_camera, self._used_pixels(frame),
            self._options.relocalization)
        self._covariance = self._options.relocalization.lost_rad ** 2 * np.eye(3)
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
            options = self._options.relocalization
            known_better = options.sigma_rad ** 2 - options.lost_rad ** 2
            self._map.turn(R_old_new, known_better)
            self._motion.rotate_world(R_old_new)
            self._covariance = (rotate_covariance(self._covariance, R_old_new)
                                + known_better * np.eye(3))
            self._correction.reset()
            self._relocalizer = None

    def _start_map(self, frame: PreparedFrame, stamp_ns: int | None) -> None:
        """Start anew from here, in the orientation reached."""
        options = self._options
        self._map = LandmarkMap(options.landmark_map)
        self._motion.reset(stamp_ns)
        self._correction.reset()
        self._visible.update(frame.small, None)
        self._thumbnail = frame.thumbnail
        self._map.add_keyframe(
            self._motion.R_world_camera, self._motion.position, self._covariance, frame.grey,
            frame.thumbnail, Observations.none())
        self._map.add_landmarks(frame.grey, frame.pyramid, self._visible.pixels())
        self._landmarks_at_keyframe, self._scale = options.landmark_map.max_landmarks, 1.
        self._initializer: MapInitializer | None = MapInitializer(
            self._map, options.initialization, options.localization, options.motion)

    def _locate(self, frame: PreparedFrame, stamp_ns: int) -> Localization | None:
        """Return the Localization near where the camera is expected, None without."""
        assert self._thumbnail is not None
        motion, options = self._motion, self._options
        R_camera_last = align_thumbnails(
            self._thumbnail, frame.thumbnail, motion.predicted_rotation(stamp_ns).inv())
        if self._initializer is not None:
            return self._initializer.localize(
                frame.pyramid, R_camera_last, stamp_ns, self._visible.shows)
        elapsed_s = motion.trusted_s(stamp_ns)
        return localize(
            self._map, np.flatnonzero(self._map.landmarks.active), frame.pyramid,
            motion.R_world_camera * R_camera_last.inv(), motion.position_at(stamp_ns),
            max(options.motion.position_sigma_per_s * elapsed_s,
                options.motion.min_position_sigma),
            self._scale, self._visible.shows, elapsed_s > options.max_fine_s,
            options.localization)

    def _locate_widely(self, frame: PreparedFrame) -> Localization | None:
        """Return the Localization somewhere near the last keyframe, None without."""
        options = self._options
        return locate_widely(
            self._map, frame.grey, frame.pyramid, self._used_pixels(frame),
            options.motion.position_sigma_per_s, self._visible.shows,
            options.localization.doubtful * self._scale, options.wide_baseline,
            options.localization)

    def _relocalize_nearby(self, frame: PreparedFrame, stamp_ns: int) -> Localization | None:
        """Return the Localization near one of the last keyframes, whatever the camera has done."""
        landmarks, options = self._map.landmarks, self._options
        for keyframe, R_camera_key in likely_turns(
                self._map.keyframes[-options.relocalization.nearby_keyframes:],
                frame.thumbnail)[:options.relocalization.nearby_attempts]:
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
                options.motion.position_sigma_per_s, self._scale, self._visible.shows, True,
                options.localization)
            if localization is not None:
                self._map.wake(localization.rows)
                self._correction.reset()
                return localization
        return None

    def _accept(self, frame: PreparedFrame, stamp_ns: int, localization: Localization) -> None:
        """Make this frame the last one that showed something."""
        pose, R_world_camera = localization.pose, localization.R_world_camera
        step = self._motion.update(stamp_ns, R_world_camera, pose.position)
        self._visible.update(frame.small, step.inv())
        self._thumbnail = frame.thumbnail
        self._scale += self._options.scale_rate * (localization.pose.scale - self._scale)
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
        # At the start nobody is judged for good.
        self._map.judge(localization.rows, localization.agreeing,
                        localization.pose.inverse_depths, for_good=self._initializer is None)

    def _is_keyframe(self, localization: Localization) -> bool:
        options = self._options.keyframes
        seen = localization.rows[localization.agreeing]
        last, some = self._map.keyframes[-1], seen[::4]
        parallax_rad = np.median(np.linalg.norm(
            self._map.directions(some, self._motion.position)
            - self._map.directions(some, last.position), axis=1))
        if parallax_rad > options.max_parallax_rad:
            return True
        if self._initializer is not None:
            return len(localization.rows) < options.min_survivors * len(self._map.landmarks)
        # In the beginning those that move by themselves must have time to tell.
        needed = self._options.localization
        mature = self._map.is_mature(seen).sum()
        return len(seen) < (options.min_survivors * self._landmarks_at_keyframe
                            if mature >= needed.min_mature else 2 * needed.min_points)

    def _add_keyframe(self, frame: PreparedFrame, localization: Localization) -> None:
        """Make this frame a keyframe, adjust the last ones, look for new landmarks."""
        self._initializer = None
        motion, before = self._motion, self._motion.R_world_camera
        observations = Observations.joined((
            localization.observations(self._map.landmarks, localization.agreeing),
            returning(self._map, frame.pyramid, before, motion.position, self._visible.shows,
                      self._options.localization)))
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
