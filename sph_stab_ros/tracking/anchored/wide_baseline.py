# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Where a camera is after a large step: by features, for which nothing need be expected."""

from dataclasses import dataclass

import numpy as np

from sph_stab_ros.geometry.arrays import Grey, Mask
from sph_stab_ros.geometry.rotations import rotation_from_matrix
from sph_stab_ros.tracking.anchored.landmark_map import LandmarkMap
from sph_stab_ros.tracking.anchored.localization import (
    is_supported, Localization, LocalizationOptions, look_along, Usable)
from sph_stab_ros.tracking.anchored.patches import Pyramid
from sph_stab_ros.tracking.anchored.pose_estimation import fit_depths
from sph_stab_ros.tracking.anchored.pose_hypotheses import fit_poses_among_movers
from sph_stab_ros.tracking.anchored.relocalization import turn_with_less_parallax
from sph_stab_ros.tracking.frame_to_frame.estimators.essential import (
    epipolar_distance, fit_essential, INLIER_RAD)
from sph_stab_ros.tracking.frame_to_frame.features import detect, match


@dataclass(frozen=True)
class WideBaselineOptions:
    """How features lead to landmarks."""

    # Landmarks have moved as those of so many nearest features have in the mean.
    neighbours: int = 3
    # Of the landmarks looked for such a share is found at the right place; some are by chance.
    min_found: float = 0.2
    # The step that features tell has no length; so many distances of landmarks for a start.
    step: float = 0.2


def locate_widely(landmark_map: LandmarkMap, grey: Grey, pyramid: Pyramid, used: Mask,
                  position_sigma: float, is_usable: Usable, scale: float,
                  options: WideBaselineOptions,
                  localization: LocalizationOptions) -> Localization | None:
    """
    Return the Localization of a camera not far from the last keyframe, None if it cannot be told.

    A-KAZE features give the turn, by an essential matrix, and where landmarks will about be.
    """
    keyframe = landmark_map.keyframes[-1]
    pairs = match(keyframe.features(used), detect(grey, used))
    estimate = fit_essential(pairs)
    if estimate is None:
        return None
    landmarks = landmark_map.landmarks
    assert estimate.t_current is not None
    R_camera_key = turn_with_less_parallax(estimate, pairs)
    E = np.cross(np.eye(3), estimate.t_current) @ R_camera_key.as_matrix()
    pairs = pairs[epipolar_distance(E[None], pairs)[0] < INLIER_RAD]
    if len(pairs) < localization.min_points:
        return None
    rows = np.flatnonzero(landmarks.active | (landmarks.host == keyframe.number)
                          | np.isin(landmarks.number, keyframe.observations.number))
    before = landmark_map.directions(rows, keyframe.position) @ keyframe.R
    nearest = np.argsort(-before @ pairs.previous.T, axis=1)[:, :options.neighbours]
    moved = pairs.current - R_camera_key.apply(pairs.previous)
    expected = R_camera_key.apply(before) + moved[nearest].mean(axis=1)
    R_world_camera = rotation_from_matrix(keyframe.R) * R_camera_key.inv()
    found, points = look_along(
        R_world_camera.apply(expected / np.linalg.norm(expected, axis=1, keepdims=True)),
        landmark_map, rows, pyramid, R_world_camera, is_usable, localization.search)
    if len(found) < max(localization.min_points, options.min_found * len(rows)):
        return None
    if len(landmark_map.keyframes) == 1:
        points = points.as_new(landmark_map.options.first_information)
    step = -options.step * R_world_camera.apply(estimate.t_current)
    guesses = [(R_world_camera.inv(), keyframe.position + way * step) for way in (1, 0, 3, -1)]
    poses, costs = fit_poses_among_movers(
        points, guesses, position_sigma, np.random.default_rng(0), localization.hypotheses,
        scale)
    pose = fit_depths(points, poses[np.argmin(costs)], localization.pose)
    agreeing = localization.pose.loss.inliers(pose.sizes, pose.scale)
    if not is_supported(points.y, agreeing, localization, localization.min_agreement):
        return None
    return Localization(found, points, pose, agreeing)
