# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""
The start of a map, where nothing is decided before parallax tells.

Of what the first picture shows, some stands still and some walks, maybe nearer and richer in
corners; as long as the camera has hardly moved, either may be the world. So each frame is compared
with the first one afresh, of unknown depths; landmarks are followed from frame to frame, whichever
pose they speak for; and of several poses that one counts which holds in most places.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from sph_stab_ros.geometry.arrays import Covariance, Indices, Values
from sph_stab_ros.geometry.conventions import NS_PER_S
from sph_stab_ros.geometry.rotations import rotation_from_matrix
from sph_stab_ros.tracking.anchored.landmark_map import LandmarkMap
from sph_stab_ros.tracking.anchored.localization import (
    is_supported, Localization, LocalizationOptions, look_along, Usable)
from sph_stab_ros.tracking.anchored.patches import Pyramid
from sph_stab_ros.tracking.anchored.pose_estimation import Points, PoseEstimate
from sph_stab_ros.tracking.anchored.pose_hypotheses import fit_poses_among_movers, Guess, places
from sph_stab_ros.tracking.motion_model import MotionOptions


@dataclass(frozen=True)
class InitializationOptions:
    """How poses compete at the start of a map."""

    # Where the camera is not known to be a pose is right even if it holds in so few of the places:
    # those of walkers, and of the robot's body.
    min_agreement: float = 0.3
    # So many poses compete from one frame to the next, those being one that differ by less: some
    # deviations of a single corner.
    rivals: int = 3
    same_rad: float = np.deg2rad(0.02)
    # Of so many places, the mean of truncated residuals in deviations, one for each e-fold of
    # likelihood: residuals of one place are alike from frame to frame.
    temperature: float = 4.


class MapInitializer:
    """
    The landmarks of a map's only keyframe, and the poses that may be the last frame's.

    Parameters
    ----------
    landmark_map : LandmarkMap
        With one keyframe and its landmarks.
    options : InitializationOptions
    localization : LocalizationOptions
    motion : MotionOptions

    """

    def __init__(self, landmark_map: LandmarkMap, options: InitializationOptions,
                 localization: LocalizationOptions, motion: MotionOptions) -> None:
        self._map = landmark_map
        self._options, self._localization, self._motion = options, localization, motion
        self._first_ns: int | None = None
        # Orientation by the pose that counted before, to tell how far another one differs; None
        # where the last frame was not localized here.
        self.R_world_continued: Rotation | None = None
        # Where each landmark was last seen or, if it was missed since, would be if it were far.
        self._y = landmark_map.landmarks.x.copy()
        # R_last_key and the position in that camera of each, the one that counted first.
        self._rivals: list[Guess] = [(Rotation.identity(), np.zeros(3))]
        self._rng = np.random.default_rng(0)

    def localize(self, pyramid: Pyramid, R_camera_last: Rotation, stamp_ns: int,
                 is_usable: Usable) -> Localization | None:
        """
        Return the Localization of the next frame, None where it cannot be told.

        ``R_camera_last`` is a guess.
        """
        self.R_world_continued = None
        if self._first_ns is None:
            # By now it is known how the camera moved.
            self._first_ns = stamp_ns
            self._map.correct_first()
            self._y = self._map.landmarks.x.copy()
        options = self._localization
        sigma = max(self._motion.position_sigma_per_s * (stamp_ns - self._first_ns) / NS_PER_S,
                    self._motion.min_position_sigma)
        R_world_key = rotation_from_matrix(self._map.keyframes[0].R)
        for _ in range(options.max_attempts):
            guesses = [
                (R_camera_last * R_last_key * R_world_key.inv(), R_world_key.apply(position))
                for R_last_key, position in self._rivals]
            R_world_camera = guesses[0][0].inv()
            found, points = self._look_for(pyramid, R_camera_last, R_world_camera, is_usable)
            if len(found) < options.min_points:
                return None
            poses, costs = fit_poses_among_movers(
                points, guesses, sigma, self._rng, options.hypotheses)
            pose = poses[np.argmin(costs)]
            agreeing = options.pose.loss.inliers(pose.sizes, pose.scale)
            if not is_supported(points.y, agreeing, options, self._options.min_agreement):
                return None
            R_camera_last = pose.R_camera_world * R_world_key * self._rivals[0][0].inv()
            if (pose.R_camera_world * R_world_camera).magnitude() < options.good_prediction_rad:
                break
        self._y = R_camera_last.apply(self._y)
        self._y[found] = points.y
        ranked = [poses[i] for i in np.argsort(costs, kind='stable')]
        self._rivals = [(one.R_camera_world * R_world_key, R_world_key.inv().apply(one.position))
                        for one in distinct(ranked, self._options.same_rad)[:self._options.rivals]]
        self.R_world_continued = poses[0].R_camera_world.inv()
        pose.covariance[:3, :3] += contested(
            poses, costs, len(places(points.y, options.hypotheses.place_rad)[1]),
            self._options.temperature)
        return Localization(found, points, pose, agreeing)

    def _look_for(self, pyramid: Pyramid, R_camera_last: Rotation, R_world_camera: Rotation,
                  is_usable: Usable) -> tuple[Indices, Points]:
        """Return which landmarks are found near where they were last seen, as Points."""
        rows = np.flatnonzero(self._map.landmarks.active)
        found, points = look_along(
            (R_world_camera * R_camera_last).apply(self._y[rows]), self._map, rows, pyramid,
            R_world_camera, is_usable, self._localization.search)
        return found, points.as_new(self._map.options.first_information)


def contested(poses: list[PoseEstimate], costs: Values, places_seen: int,
              temperature: float) -> Covariance:
    """
    Return the covariance (3, 3) in rad² of the best pose's rotation, in the camera, by its rivals.

    Each may be right, the less likely the fewer places agree.
    """
    likely = np.exp((costs.min() - costs) * places_seen / temperature)
    best = poses[np.argmin(costs)].R_camera_world.inv()
    off = np.array([(one.R_camera_world * best).as_rotvec() for one in poses])
    return (off * likely[:, None]).T @ off / likely.sum()


def distinct(poses: Sequence[PoseEstimate], same_rad: float) -> list[PoseEstimate]:
    """Return those PoseEstimates that are not turned like one before, by so much at least."""
    kept: list[PoseEstimate] = []
    for pose in poses:
        if all((pose.R_camera_world * one.R_camera_world.inv()).magnitude() > same_rad
               for one in kept):
            kept.append(pose)
    return kept
