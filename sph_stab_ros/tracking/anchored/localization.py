# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Where a camera is, by the landmarks that it sees."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from scipy.spatial.transform import Rotation

from sph_stab_ros.geometry.arrays import Bearings, Choice, Indices, Vector, Vectors
from sph_stab_ros.geometry.rotations import cross
from sph_stab_ros.tracking.anchored.landmark_map import LandmarkMap
from sph_stab_ros.tracking.anchored.landmarks import Landmarks, Observations
from sph_stab_ros.tracking.anchored.patches import LEVELS, Pyramid
from sph_stab_ros.tracking.anchored.pose_estimation import (
    fit_depths, fit_pose, Points, PoseEstimate, PoseOptions)
from sph_stab_ros.tracking.anchored.pose_hypotheses import (
    agreement, fit_poses_among_movers, HypothesisOptions)


@dataclass(frozen=True)
class SearchOptions:
    """Which landmarks count as found."""

    # Patches are found where they look the same, the search has settled, and not too far away
    # from where they are expected: farther than half a patch is something else.
    min_correlation: float = 0.75
    max_last_step_px: float = 0.5
    max_offset_px: float = 6.0
    # Nor is a patch that has shrunk or grown by more the same: a landmark's distance, by that
    # from which its patch was cut.
    min_distance: float = 0.4
    max_distance: float = 3.0
    # What remains of a landmark's error, its own shape above all, does not shrink with finer
    # pixels than those of 640 columns.
    max_px_per_rad: float = 640 / (2 * np.pi)


@dataclass(frozen=True)
class LocalizationOptions:
    """When a camera is localized."""

    search: SearchOptions = SearchOptions()
    pose: PoseOptions = PoseOptions()
    hypotheses: HypothesisOptions = HypothesisOptions()
    # Fewer may agree by chance on a pose of six unknowns.
    min_points: int = 20
    # Residuals that many times as large as usual say that not all of it is one scene any more: who
    # stood still begins to walk.
    doubtful: float = 1.5
    # Where fewer landmarks are mature, all have a say in the pose: twice what a pose needs.
    min_mature: int = 40
    # A pose that holds in fewer of the places is none: right ones were seen from 0.69 on, among
    # four walkers, wrong ones up to 0.59, among pictures that are 20° apart.
    min_agreement: float = 0.63
    # A prediction that was off by more, a pixel of 640 columns, is taken up and the search made
    # anew, in all so many times.
    good_prediction_rad: float = np.deg2rad(0.5)
    max_attempts: int = 3
    # At a keyframe so many of those inactive are looked for, as many as may be active; they are
    # back within so many standard deviations, since both have drifted.
    max_returning: int = 600
    returning_size: float = 8.0


# Tells of bearings in the camera which to use.
Usable: TypeAlias = Callable[[Bearings], Choice]


@dataclass(frozen=True)
class Localization:
    """
    A PoseEstimate by the landmarks in rows (N,), and Points (N) as they were seen.

    ``agreeing`` (N,) bool tells which of them are where the pose says; ``was_lost`` whether the
    camera is somewhere else than was expected.
    """

    rows: Indices
    points: Points
    pose: PoseEstimate
    agreeing: Choice
    was_lost: bool = False

    @property
    def R_world_camera(self) -> Rotation:
        """Return the camera's orientation."""
        return self.pose.R_camera_world.inv()

    def observations(self, landmarks: Landmarks, which: Choice) -> Observations:
        """Return the Observations of those in ``which`` (N,) bool."""
        return Observations(landmarks.number[self.rows[which]], self.points.y[which],
                            self.points.sqrt_information[which])


def localize(landmark_map: LandmarkMap, rows: Indices, pyramid: Pyramid, R_world_camera: Rotation,
             position: Vector, position_sigma: float, usual_scale: float, is_usable: Usable,
             coarsely: bool, options: LocalizationOptions) -> Localization | None:
    """
    Return the Localization of a camera from a guess, None where it cannot be told.

    Parameters
    ----------
    landmark_map : LandmarkMap
        What is known.
    rows : (N,) int
        Of the landmarks to look for, ascending.
    pyramid : Pyramid
        The camera's picture.
    R_world_camera : Rotation
        The guess.
    position : (3,)
        The same.
    position_sigma : float
        Standard deviation of the latter.
    usual_scale : float
        Of the residuals of poses.
    is_usable : callable
        Tells of bearings (N, 3) in the camera which to use.
    coarsely : bool
        Whether the guess may be off by more than 2 px, including all depths.
    options : LocalizationOptions
        When it is told.

    """
    guess, doubtful = position, options.doubtful * usual_scale
    for _ in range(options.max_attempts):
        found, points = match_landmarks(
            landmark_map, rows, pyramid, R_world_camera, guess, is_usable, options.search,
            LEVELS if coarsely else 1)
        if len(found) < options.min_points:
            return None
        mature = landmark_map.is_mature(found)
        if mature.sum() < options.min_mature:
            mature[:] = True
        voters, guess_pose = points[mature], (R_world_camera.inv(), position)
        pose = fit_pose(voters, *guess_pose, position_sigma, options.pose)
        if pose.scale > doubtful:
            poses, costs = fit_poses_among_movers(
                voters, [guess_pose, (pose.R_camera_world, pose.position)], position_sigma,
                np.random.default_rng(0), options.hypotheses, doubtful)
            pose = poses[np.argmin(costs)]
        pose = fit_depths(points, pose, options.pose)
        agreeing = options.pose.loss.inliers(pose.sizes, pose.scale)
        if not is_supported(points.y, agreeing, options, options.min_agreement, mature):
            return None
        off_rad = (pose.R_camera_world * R_world_camera).magnitude()
        R_world_camera, guess = pose.R_camera_world.inv(), pose.position
        if off_rad < options.good_prediction_rad:
            break
        coarsely = True
    return Localization(found, points, pose, agreeing)


def is_supported(y: Bearings, agreeing: Choice, options: LocalizationOptions,
                 min_agreement: float, voters: Choice | None = None) -> bool:
    """
    Tell whether enough of what is seen along y (N, 3) agrees with a pose: ``agreeing`` (N,) bool.

    ``min_points`` of them, and ``min_agreement`` of the places where there are any, or any of the
    voters (N,) bool.
    """
    counted = slice(None) if voters is None else voters
    return bool(agreeing.sum() >= options.min_points) and not (
        min_agreement > agreement(y[counted], agreeing[counted], options.hypotheses))


def match_landmarks(landmark_map: LandmarkMap, rows: Indices, pyramid: Pyramid,
                    R_world_camera: Rotation, position: Vector, is_usable: Usable,
                    options: SearchOptions, levels: int = LEVELS) -> tuple[Indices, Points]:
    """Return which of the landmarks in rows are found from a guessed pose, and as what Points."""
    return look_along(landmark_map.rays(rows, position), landmark_map, rows, pyramid,
                      R_world_camera, is_usable, options, levels)


def look_along(z: Vectors, landmark_map: LandmarkMap, rows: Indices, pyramid: Pyramid,
               R_world_camera: Rotation, is_usable: Usable, options: SearchOptions,
               levels: int = LEVELS) -> tuple[Indices, Points]:
    """
    Return which of the landmarks in rows are found in guessed directions, and as what Points.

    The rays z (N, 3), in the world, are as long as the landmarks are farther than from the hosts.
    """
    landmarks, patches = landmark_map.landmarks, landmark_map.patches
    distance = np.sqrt(np.einsum('ni,ni->n', z, z))
    b = z / distance[:, None]
    camera_axes = R_world_camera.as_matrix()
    nearness = landmark_map.landmarks.inverse_depth[rows] / distance
    expected = landmark_map.lenses.as_seen(
        landmark_map.readout.as_seen(b @ camera_axes, nearness))
    seen = np.flatnonzero(
        (np.abs(expected[:, 1]) < np.sin(pyramid.options.max_latitude_rad)) & is_usable(expected)
        & (distance > options.min_distance) & (distance < options.max_distance))
    rows = rows[seen]
    b, expected, distance, nearness = (one[seen] for one in (b, expected, distance, nearness))
    # Tangents go along from x to b without a twist.
    x, east, origins = landmark_map.in_world(rows)
    east -= (np.einsum('ni,ni->n', east, b)
             / (1 + np.einsum('ni,ni->n', x, b)))[:, None] * (x + b)
    east = east @ camera_axes
    south = cross(expected, east)
    offsets, correlation, last_step_px = patches.find(
        landmarks.patch[rows], pyramid, expected, east, south, 1 / distance, levels)
    found = ((correlation > options.min_correlation) & (last_step_px < options.max_last_step_px)
             & (np.linalg.norm(offsets, axis=1) * pyramid.px_per_rad() < options.max_offset_px))
    rows = rows[found]
    offsets, expected, east, south, nearness = (
        one[found] for one in (offsets, expected, east, south, nearness))
    y = landmark_map.readout.corrected(landmark_map.lenses.corrected(
        expected + offsets[:, :1] * east + offsets[:, 1:] * south), nearness)
    px_per_rad = min(pyramid.px_per_rad(), options.max_px_per_rad)
    sqrt_information = (patches.sqrt_information_px[landmarks.patch[rows]] * px_per_rad
                        @ np.stack((east, south), axis=1))
    return rows, Points(x[found], origins[found], landmarks.inverse_depth[rows],
                        landmarks.information[rows], y, sqrt_information)


def returning(landmark_map: LandmarkMap, pyramid: Pyramid, R_world_camera: Rotation,
              position: Vector, is_usable: Usable, options: LocalizationOptions) -> Observations:
    """Wake inactive landmarks that are seen from a known pose; return their Observations."""
    rows, points = match_landmarks(
        landmark_map, landmark_map.near(position, options.max_returning), pyramid,
        R_world_camera, position, is_usable, options.search)
    b = landmark_map.directions(rows, position) @ R_world_camera.as_matrix()
    sizes = np.linalg.norm(np.einsum('nki,ni->nk', points.sqrt_information, b - points.y), axis=1)
    back = (sizes < options.returning_size) & landmark_map.is_mature(rows)
    landmark_map.wake(rows[back])
    return Observations(landmark_map.landmarks.number[rows[back]], points.y[back],
                        points.sqrt_information[back])
