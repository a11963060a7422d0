# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Poses that compete where much moves by itself: what holds in most places is the world's."""

from collections.abc import Sequence
from dataclasses import replace
from typing import TypeAlias

import numpy as np
from scipy.spatial.transform import Rotation

from sph_stab_ros.geometry.arrays import Bearings, Choice, Indices, Values, Vector
from sph_stab_ros.tracking.anchored.pose_estimation import (
    depths_at, fit_depths, fit_pose, GEMAN_MCCLURE_LOSS, MIN_ITERATIONS, Points, PoseEstimate)

# Where the mean residual over all places, in deviations, is less, all of it is one scene, and
# other starts need not be tried.
UNDOUBTED = 1.3
# Of so many random choices of places, in each of which such a share is taken, the best few are
# refined. Two walkers of whom each fills four places leave every third choice without them.
TRIALS = 32
TRIED_SHARE = 0.12
MIN_TRIED = 10
REFINED = 3
PLACE_RAD = np.deg2rad(30)
# The position expected may itself come from someone who moves.
TRIED_SIGMAS = 3.0
TRUNCATION = 4.0

# R_camera_world and position.
Guess: TypeAlias = tuple[Rotation, Vector]


def fit_poses_among_movers(points: Points, guesses: Sequence[Guess], position_sigma: float,
                           rng: np.random.Generator,
                           scale: float = 1.) -> tuple[list[PoseEstimate], Values]:
    """
    Return PoseEstimates of which one may be right where much moves by itself, and their costs.

    Who carries the camera, or walks beside it, may show more corners than plain walls do. So a
    pose is as good as it holds in many *places*, of equal say however many points are seen there:
    its cost is the mean over the places of the truncated residuals, in deviations times ``scale``.
    Starts are the ``guesses``, (R_camera_world, position) each, and unless one of these holds
    nearly everywhere, random choices of a few places. The guesses' poses come first, in their
    order.
    """
    place, count = places(points.y)
    share = 1 / (len(count) * count[place])
    # Of the points in one place errors are alike, more or less.
    say = count[place] ** -0.5

    def cost(pose: PoseEstimate) -> float:
        return np.minimum(pose.sizes / scale, TRUNCATION) @ share

    def refined(R_camera_world: Rotation, position: Vector) -> PoseEstimate:
        # A point of the wrong depth would be taken for an outlier.
        rho = depths_at(points, R_camera_world.as_matrix(), position)
        return fit_pose(points, R_camera_world, position, position_sigma,
                        replace(GEMAN_MCCLURE_LOSS, max_scale=scale), say=say,
                        inverse_depths=rho)

    poses = [refined(*guess) for guess in guesses]
    if min(map(cost, poses)) > UNDOUBTED:
        tried = []
        for chosen in rng.random((TRIALS, len(count))) < TRIED_SHARE:
            some = chosen[place]
            if some.sum() >= MIN_TRIED:
                tried.append(fit_depths(points, fit_pose(
                    points[some], *guesses[0], TRIED_SIGMAS * position_sigma,
                    iterations=MIN_ITERATIONS, say=say[some])))
        poses += [refined(pose.R_camera_world, pose.position)
                  for pose in sorted(tried, key=cost)[:REFINED]]
    return poses, np.array([cost(pose) for pose in poses])


def places(y: Bearings) -> tuple[Indices, Indices]:
    """
    Return for bearings y (N, 3) the numbers (N,) of the places that they are in, and counts.

    Places are parts of the sphere of about equal solid angle.
    """
    lat = np.arcsin(np.clip(y[:, 1], -1, 1))
    band = np.rint(lat / PLACE_RAD)
    around = np.rint(2 * np.pi / PLACE_RAD * np.cos(band * PLACE_RAD)).clip(1)
    turns = np.arctan2(y[:, 0], y[:, 2]) / (2 * np.pi) + 0.5
    along = np.minimum(np.floor(turns * around), around - 1)
    _, place, count = np.unique(
        np.stack((band, along)), axis=1, return_inverse=True, return_counts=True)
    return place.ravel(), count


def agreement(y: Bearings, agreeing: Choice) -> float:
    """Return in which share of the places those of bearings y (N, 3) agree that are to."""
    place, count = places(y)
    return float(np.mean(np.bincount(place, agreeing) / count))
