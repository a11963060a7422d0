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

Its ancestors: keyframes from G. Klein and D. Murray, *Parallel tracking and mapping for small AR
workspaces*, International Symposium on Mixed and Augmented Reality, 2007; patches that are aligned
with their first look from C. Forster, M. Pizzoli and D. Scaramuzza, *SVO: fast semi-direct
monocular visual odometry*, International Conference on Robotics and Automation, 2014.
"""

import numpy as np

from sph_stab_ros.geometry.arrays import Covariance, Grey, Mask, Vector
from sph_stab_ros.geometry.rotations import rotate_covariance, rotation_from_matrix
from sph_stab_ros.images.texture import has_texture
from sph_stab_ros.tracking.anchored.body_mask import VisibleWorld
from sph_stab_ros.tracking.anchored.correction import SmoothCorrection
from sph_stab_ros.tracking.anchored.frame_localizer import FrameLocalizer
from sph_stab_ros.tracking.anchored.landmark_map import LandmarkMap
from sph_stab_ros.tracking.anchored.landmarks import Observations
from sph_stab_ros.tracking.anchored.localization import Localization, returning
from sph_stab_ros.tracking.anchored.options import AnchoredOptions
from sph_stab_ros.tracking.anchored.prepared_frame import PreparedFrame
from sph_stab_ros.tracking.anchored.readout import Readout
from sph_stab_ros.tracking.anchored.relocalization import Relocalizer
from sph_stab_ros.tracking.base import (
    GyroRotation, no_gyro, status_of, TrackedOrientation, TrackingStatus)
from sph_stab_ros.tracking.motion_model import MotionModel


class AnchoredTracker:
    """
    Orientation among landmarks, of which those at places seen before are used again.

    Parameters
    ----------
    used : (H, W) bool, optional
        Pixels to use.
    max_prediction_s : float
        For how long the last angular velocity is trusted.
    gyro_rotation : callable
        Returns the turn ``R_from_to`` between two stamps, or None.
    options : AnchoredOptions
    readout : Readout, optional
        How the rows of pictures are read; all at once by default.

    """

    def __init__(self, used: Mask | None = None, max_prediction_s: float = 0.5,
                 gyro_rotation: GyroRotation = no_gyro,
                 options: AnchoredOptions = AnchoredOptions(),
                 readout: Readout | None = None) -> None:
        self._options, self._used, self._readout = options, used, readout or Readout()
        self._max_prediction_s, self._turn_between = max_prediction_s, gyro_rotation
        self.reset()

    def reset(self) -> None:
        """Forget everything: the next frame's orientation is the new world."""
        options = self._options
        self._map = LandmarkMap(options.landmark_map, self._readout)
        self._visible = VisibleWorld(self._used, options.body_mask)
        self._motion = MotionModel(self._max_prediction_s, self._turn_between, options.motion)
        self._covariance: Covariance = np.zeros((3, 3))
        self._correction = SmoothCorrection(options.correction)
        self._localization: Localization | None = None
        self._keyframe_to_add: tuple[PreparedFrame, Localization] | None = None
        self._relocalizer: Relocalizer | None = None

    @property
    def body_mask(self) -> Mask:
        """Pixels (80, 160) bool of the camera that stand still while the world turns."""
        return self._visible.body.mask

    @property
    def options(self) -> AnchoredOptions:
        """Return how all of it is done."""
        return self._options

    @property
    def visible(self) -> VisibleWorld:
        """Return where the camera sees the world."""
        return self._visible

    @property
    def lens_misalignment(self) -> tuple[Vector, Covariance]:
        """Rotation vector (3,) between a stitched picture's halves, and its covariance (3, 3)."""
        return self._map.lenses.apart, self._map.lenses.apart_covariance

    @property
    def landmark_map(self) -> LandmarkMap:
        """Return what is known of the surroundings, to be looked at."""
        return self._map

    @property
    def localization(self) -> Localization | None:
        """
        Return how the last frame was localized, None if it was not.

        Its rows are those of ``landmark_map`` until the next settle.
        """
        return self._localization

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
        self._localization = None
        frame = PreparedFrame(grey, self._options.landmark_map.patches, self._options.thumbnails)
        if not has_texture(frame.small):
            return self._predicted(stamp_ns)
        if not self._map.keyframes:
            self._start_map(frame, stamp_ns)
        else:
            localization = self._localizer.localize(frame, stamp_ns)
            if localization is None:
                held = self._predicted(stamp_ns)
                if held.status is TrackingStatus.LOST:
                    self._motion.R_world_camera = held.R_world_camera
                    self._start_anew(frame)
                return held
            self._localization = localization
            self._accept(frame, stamp_ns, localization)
            self._judge_landmarks(localization)
            if self._is_keyframe(localization):
                self._keyframe_to_add = frame, localization
        return TrackedOrientation(
            self._correction.R_out_world * self._motion.R_world_camera,
            status_of(self._covariance), self._covariance)

    def settle(self) -> None:
        """Do what the last orientation did not have to wait for: keyframes, relocalisation."""
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
            keyframes, frame.grey, self._motion.R_world_camera,
            self._visible.pixels_of(frame.grey), self._options.relocalization)
        self._covariance = self._options.relocalization.lost_rad ** 2 * np.eye(3)
        self._start_map(frame, None)

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
        self._readout.stand_still()
        self._map = LandmarkMap(options.landmark_map, self._readout)
        self._motion.reset(stamp_ns)
        self._correction.reset()
        self._visible.update(frame.small, None)
        self._map.add_keyframe(
            self._motion.R_world_camera, self._motion.position, self._covariance, frame.grey,
            frame.thumbnail, Observations.none())
        self._map.add_landmarks(frame.grey, frame.pyramid, self._visible.pixels())
        self._landmarks_at_keyframe = options.landmark_map.max_landmarks
        self._localizer = FrameLocalizer(
            self._map, frame.thumbnail, self._visible, self._motion, options)

    def _accept(self, frame: PreparedFrame, stamp_ns: int, localization: Localization) -> None:
        """Make this frame the last one that showed something."""
        pose, R_world_camera = localization.pose, localization.R_world_camera
        step = self._motion.update(stamp_ns, R_world_camera, pose.position)
        self._visible.update(frame.small, step.inv())
        self._localizer.accept(frame, localization)
        self._covariance = (self._map.keyframes[-1].covariance
                            + rotate_covariance(pose.covariance[:3, :3], R_world_camera)
                            + self._map.lens_covariance(R_world_camera))
        R_world_continued = self._localizer.R_world_continued
        if R_world_continued is not None:
            # When another pose counts than did before, the picture follows smoothly.
            self._correction.hide(R_world_continued, R_world_camera)
        if localization.was_lost:
            self._correction.reset()
        self._correction.step()

    def _judge_landmarks(self, localization: Localization) -> None:
        """Note which landmarks agree; deactivate those that are not seen or do not."""
        # At the start nobody is judged for good.
        self._map.judge(localization.rows, localization.agreeing,
                        localization.pose.inverse_depths, for_good=not self._localizer.is_starting)

    def _is_keyframe(self, localization: Localization) -> bool:
        options = self._options.keyframes
        seen = localization.rows[localization.agreeing]
        last, some = self._map.keyframes[-1], seen[::4]
        parallax_rad = np.median(np.linalg.norm(
            self._map.directions(some, self._motion.position)
            - self._map.directions(some, last.position), axis=1))
        if parallax_rad > options.max_parallax_rad:
            return True
        if self._localizer.is_starting:
            return len(localization.rows) < options.min_survivors * len(self._map.landmarks)
        # In the beginning those that move by themselves must have time to tell.
        needed = self._options.localization
        mature = self._map.is_mature(seen).sum()
        return len(seen) < (options.min_survivors * self._landmarks_at_keyframe
                            if mature >= needed.min_mature else 2 * needed.min_points)

    def _add_keyframe(self, frame: PreparedFrame, localization: Localization) -> None:
        """Make this frame a keyframe, adjust the last ones, look for new landmarks."""
        self._localizer.end_start()
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
