# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Poses that compete where much moves by itself: what holds in most places is the world's."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np
from scipy.spatial.transform import Rotation

from sph_stab_ros.geometry.arrays import Bearings, Choice, Indices, Values, Vector
from sph_stab_ros.tracking.anchored.pose_estimation import (
    depths_at, fit_depths, fit_pose, Loss, Points, PoseEstimate, PoseOptions)

# R_camera_world and position.
Guess: TypeAlias = tuple[Rotation, Vector]


@dataclass(frozen=True)
class HypothesisOptions:
    """How many poses compete, and what speaks for them."""

    # The side of a place: a part of the sphere in which errors are alike. Somebody near fills few.
    place_rad: float = np.deg2rad(30)
    # Where the mean residual over all places, in deviations, is less, all of it is one scene, and
    # other starts need not be tried.
    undoubted: float = 1.3
    # Of so many random choices of places, in each of which such a share is taken, the best few are
    # refined. Two walkers of whom each fills four places leave every third choice without them.
    trials: int = 32
    tried_share: float = 0.12
    refined: int = 3
    # A choice of fewer points, five of which would do without outliers, is not tried.
    min_tried: int = 10
    # The position expected may itself come from someone who moves: so many times as uncertain.
    tried_sigmas: float = 3.0
    # A residual counts as so many deviations at most.
    truncation: float = 4.0
    # Random choices need not be exact.
    trial_pose: PoseOptions = PoseOptions(max_iterations=PoseOptions.min_iterations)
    # Refined from a start that is good already, or not worth it.
    refined_pose: PoseOptions = PoseOptions(loss=Loss(power=2, wide_start=1., max_scale=1.))


def fit_poses_among_movers(points: Points, guesses: Sequence[Guess], position_sigma: float,
                           rng: np.random.Generator, options: HypothesisOptions,
                           scale: float = 1.) -> tuple[list[PoseEstimate], Values]:
    """
    Return PoseEstimates of which one may be right where much moves by itself, and their costs.

    Who carries the camera, or walks beside it, may show more corners than plain walls do. So a
    pose is as good as it holds in many *places*, of equal say however many points are seen there:
    its cost is the mean over the places of the truncated residuals, in deviations times ``scale``.
    Starts are the ``guesses``, (R_camera_world, position) each, and unless one of these holds
    nearly everywhere, random choices of a few places (M. A. Fischler and R. C. Bolles, *Random
    sample consensus*, Communications of the ACM 24(6), 1981, with the truncated residuals of
    P. H. S. Torr and A. Zisserman, *MLESAC*, Computer Vision and Image Understanding 78(1), 2000).
    The guesses' poses come first, in their order.
    """
    refining = replace(
        options.refined_pose, loss=replace(options.refined_pose.loss, max_scale=scale))
    place, count = places(points.y, options.place_rad)
    share = 1 / (len(count) * count[place])
    # Of the points in one place errors are alike, more or less.
    say = count[place] ** -0.5

    def cost(pose: PoseEstimate) -> float:
        return np.minimum(pose.sizes / scale, options.truncation) @ share

    def refined(R_camera_world: Rotation, position: Vector) -> PoseEstimate:
        # A point of the wrong depth would be taken for an outlier.
        rho = depths_at(points, R_camera_world.as_matrix(), position, refining)
        return fit_pose(points, R_camera_world, position, position_sigma, refining, say, rho)

    poses = [refined(*guess) for guess in guesses]
    if min(map(cost, poses)) > options.undoubted:
        tried = []
        for chosen in rng.random((options.trials, len(count))) < options.tried_share:
            some = chosen[place]
            if some.sum() >= options.min_tried:
                pose = fit_pose(points[some], *guesses[0], options.tried_sigmas * position_sigma,
                                options.trial_pose, say[some])
                tried.append(fit_depths(points, pose, options.trial_pose))
        poses += [refined(pose.R_camera_world, pose.position)
                  for pose in sorted(tried, key=cost)[:options.refined]]
    return poses, np.array([cost(pose) for pose in poses])


def places(y: Bearings, side_rad: float) -> tuple[Indices, Indices]:
    """
    Return for bearings y (N, 3) the numbers (N,) of the places that they are in, and counts.

    Places are parts of the sphere of about equal solid angle, squares with such a side.
    """
    lat = np.arcsin(np.clip(y[:, 1], -1, 1))
    band = np.rint(lat / side_rad)
    around = np.rint(2 * np.pi / side_rad * np.cos(band * side_rad)).clip(1)
    turns = np.arctan2(y[:, 0], y[:, 2]) / (2 * np.pi) + 0.5
    along = np.minimum(np.floor(turns * around), around - 1)
    # One number for both, without the gaps: numpy.unique takes twenty times as long.
    cell = ((band - band.min()) * around.max() + along).astype(int)
    count = np.bincount(cell)
    some = count > 0
    return (np.cumsum(some) - 1)[cell], count[some]


def agreement(y: Bearings, agreeing: Choice, options: HypothesisOptions) -> float:
    """Return in which share of the places those of bearings y (N, 3) agree that are to."""
    place, count = places(y, options.place_rad)
    return float(np.mean(np.bincount(place, agreeing) / count))
