# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Where frames were taken: where they are expected, else near a keyframe, else by features."""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from sph_stab_ros.geometry.arrays import Vector
from sph_stab_ros.geometry.rotations import rotation_from_matrix
from sph_stab_ros.tracking.anchored.body_mask import VisibleWorld
from sph_stab_ros.tracking.anchored.landmark_map import LandmarkMap
from sph_stab_ros.tracking.anchored.localization import Localization, localize
from sph_stab_ros.tracking.anchored.map_initialization import MapInitializer
from sph_stab_ros.tracking.anchored.options import AnchoredOptions
from sph_stab_ros.tracking.anchored.prepared_frame import PreparedFrame
from sph_stab_ros.tracking.anchored.thumbnail import align_thumbnails, likely_turns, Thumbnail
from sph_stab_ros.tracking.anchored.wide_baseline import locate_widely
from sph_stab_ros.tracking.motion_model import MotionModel


class FrameLocalizer:
    """
    Finds where frames were taken, in one map, from its first keyframe on.

    Parameters
    ----------
    landmark_map : LandmarkMap
        With one keyframe and its landmarks.
    thumbnail : Thumbnail
        Of that keyframe.
    visible : VisibleWorld
        Where landmarks are looked for.
    motion : MotionModel
        Where the camera is expected.
    options : AnchoredOptions
        How all of that is done.

    """

    def __init__(self, landmark_map: LandmarkMap, thumbnail: Thumbnail, visible: VisibleWorld,
                 motion: MotionModel, options: AnchoredOptions) -> None:
        self._map, self._visible, self._motion = landmark_map, visible, motion
        self._options = options
        self._last_thumbnail = thumbnail
        # Of the residuals, as it usually is.
        self._scale = 1.
        # For as long as there is one keyframe.
        self._initializer: MapInitializer | None = MapInitializer(
            landmark_map, options.initialization, options.localization, options.motion)

    @property
    def is_starting(self) -> bool:
        """Whether what was told so far may turn out to be wrong: nothing is decided yet."""
        return self._initializer is not None

    @property
    def R_world_continued(self) -> Rotation | None:
        """Return the last frame's orientation by the pose that counted before, if it is known."""
        return None if self._initializer is None else self._initializer.R_world_continued

    def end_start(self) -> None:
        """Decide for the last frame's pose: it becomes a keyframe."""
        self._initializer = None

    def localize(self, frame: PreparedFrame, stamp_ns: int) -> Localization | None:
        """Return the Localization of the next frame, None where it cannot be told."""
        if not len(self._map.landmarks):
            return None
        return (self._where_expected(frame, stamp_ns) or self._near_a_keyframe(frame, stamp_ns)
                or self._by_features(frame))

    def accept(self, frame: PreparedFrame, localization: Localization) -> None:
        """Make this frame the last one."""
        self._last_thumbnail = frame.thumbnail
        self._scale += self._options.scale_rate * (localization.pose.scale - self._scale)

    def _where_expected(self, frame: PreparedFrame, stamp_ns: int) -> Localization | None:
        """Return the Localization near where the camera is expected, None without."""
        motion = self._motion
        R_camera_last = align_thumbnails(
            self._last_thumbnail, frame.thumbnail, motion.predicted_rotation(stamp_ns).inv())
        R_world_camera = motion.R_world_camera * R_camera_last.inv()
        self._expect_motion(stamp_ns, R_world_camera, motion.position_at(stamp_ns))
        if self._initializer is not None:
            return self._initializer.localize(
                frame.pyramid, R_camera_last, stamp_ns, self._visible.shows)
        localization = self._by_active(frame, stamp_ns, R_world_camera)
        if localization is None or not self._map.readout.is_rolling:
            return localization
        # Once more: now it is known how the camera moved while the picture was read.
        self._expect_motion(stamp_ns, localization.R_world_camera, localization.pose.position)
        return self._by_active(frame, stamp_ns, localization.R_world_camera)

    def _expect_motion(self, stamp_ns: int, R_world_camera: Rotation, position: Vector) -> None:
        """Tell the read-out how the camera gets to a pose, where that makes a difference."""
        if self._map.readout.is_rolling:
            self._map.readout.set_motion(
                *self._motion.velocities_at(stamp_ns, R_world_camera, position))

    def _by_active(self, frame: PreparedFrame, stamp_ns: int,
                   R_world_camera: Rotation) -> Localization | None:
        """Return the Localization by all active landmarks from a guess, None without."""
        motion, options = self._motion, self._options
        elapsed_s = motion.trusted_s(stamp_ns)
        return localize(
            self._map, np.flatnonzero(self._map.landmarks.active), frame.pyramid,
            R_world_camera, motion.position_at(stamp_ns),
            max(options.motion.position_sigma_per_s * elapsed_s,
                options.motion.min_position_sigma),
            self._scale, self._visible.shows, elapsed_s > options.max_fine_s,
            options.localization)

    def _near_a_keyframe(self, frame: PreparedFrame, stamp_ns: int) -> Localization | None:
        """Return the Localization near one of the last keyframes, whatever the camera has done."""
        landmarks, options = self._map.landmarks, self._options
        for keyframe, R_camera_key in likely_turns(
                self._map.keyframes[-options.relocalization.nearby_keyframes:],
                frame.thumbnail)[:options.relocalization.nearby_attempts]:
            R_world_key = rotation_from_matrix(keyframe.R)
            if self._initializer is not None:
                R_camera_last = R_camera_key * R_world_key.inv() * self._motion.R_world_camera
                localization = self._initializer.localize(
                    frame.pyramid, R_camera_last, stamp_ns, self._visible.shows)
                if localization is not None:
                    return localization
                continue
            rows = np.flatnonzero((landmarks.host == keyframe.number)
                                  | np.isin(landmarks.number, keyframe.observations.number))
            localization = localize(
                self._map, rows, frame.pyramid, R_world_key * R_camera_key.inv(),
                keyframe.position, options.motion.position_sigma_per_s, self._scale,
                self._visible.shows, True, options.localization)
            if localization is not None:
                self._map.wake(localization.rows)
                return replace(localization, was_lost=True)
        return None

    def _by_features(self, frame: PreparedFrame) -> Localization | None:
        """Return the Localization somewhere near the last keyframe, None without."""
        options = self._options
        return locate_widely(
            self._map, frame.grey, frame.pyramid, self._visible.pixels_of(frame.grey),
            options.motion.position_sigma_per_s, self._visible.shows,
            options.localization.doubtful * self._scale, options.wide_baseline,
            options.localization)
