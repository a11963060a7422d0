# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Rotation and position against points of more or less known depth."""

from dataclasses import replace

import numpy as np
from pose_points import HERE, points, POSITION, SIGMA_RAD, tangents
import pytest
from scipy.spatial.transform import Rotation

from sph_stab_ros.tracking.anchored.pose_estimation import (
    fit_depths, fit_pose, Loss, Points, PoseOptions)
from sph_stab_ros.tracking.anchored.pose_hypotheses import (
    agreement, fit_poses_among_movers, HypothesisOptions, places)
from synthetic import angle_deg, random_rotation, unit

OPTIONS = PoseOptions()
AMONG_MOVERS = HypothesisOptions()


def fit(seen, estimator=fit_pose, R=Rotation.identity(), position=HERE, sigma=1.):
    return estimator(seen, R, position, sigma, OPTIONS)


def turned(seen, R_world, R_camera):
    """Return the Points of a turned world, seen by a turned camera."""
    return replace(
        seen, x=R_world.apply(seen.x), origins=R_world.apply(seen.origins),
        y=R_camera.apply(seen.y), sqrt_information=seen.sqrt_information @ R_camera.as_matrix().T)


@pytest.mark.parametrize('seed', range(5))
def test_known_depths_give_rotation_and_position(seed):
    rng = np.random.default_rng(seed)
    R = random_rotation(rng, 3)
    seen = points(rng, R, POSITION)
    estimate = fit(seen)
    assert angle_deg(estimate.R_camera_world, R) < 1e-3
    np.testing.assert_allclose(estimate.position, POSITION, atol=1e-4)
    assert estimate.weights.min() > 0.99


def test_from_the_truth_nothing_moves():
    rng = np.random.default_rng(1)
    R = random_rotation(rng, 100)
    seen = points(rng, R, POSITION)
    estimate = fit(seen, R=R, position=POSITION)
    assert angle_deg(estimate.R_camera_world, R) < 1e-6
    np.testing.assert_allclose(estimate.position, POSITION, atol=1e-8)
    np.testing.assert_allclose(estimate.inverse_depths, seen.inverse_depths, atol=1e-8)


def test_unknown_depths_give_rotation_direction_and_the_depths():
    rng = np.random.default_rng(2)
    R = random_rotation(rng, 1)
    seen = points(rng, R, POSITION, information=1., spread=0.)
    estimate = fit(replace(seen, inverse_depths=np.full(len(seen), 0.6)))
    assert angle_deg(estimate.R_camera_world, R) < 0.01
    assert unit(estimate.position) @ unit(POSITION) > 0.999
    # In the unit that the prior sets.
    unit_ratio = np.linalg.norm(estimate.position) / np.linalg.norm(POSITION)
    error = np.abs(estimate.inverse_depths * unit_ratio - seen.inverse_depths)
    assert np.median(error) < 0.01


def test_without_motion_there_is_rotation_only():
    rng = np.random.default_rng(3)
    R = random_rotation(rng, 2)
    seen = points(rng, R, HERE, noise_rad=SIGMA_RAD, information=1., spread=0.)
    estimate = fit(replace(seen, inverse_depths=np.ones(len(seen))))
    assert angle_deg(estimate.R_camera_world, R) < 0.02
    assert np.linalg.norm(estimate.position) < 3e-3


def test_without_points_that_are_near_the_position_expected_stays():
    rng = np.random.default_rng(4)
    R = random_rotation(rng, 2)
    seen = points(rng, R, POSITION)
    seen = replace(seen, inverse_depths=np.zeros(len(seen)), y=unit(R.apply(seen.x)))
    estimate = fit(
        replace(seen, sqrt_information=tangents(seen.y)), position=POSITION + 0.1, sigma=0.05)
    assert angle_deg(estimate.R_camera_world, R) < 1e-3
    np.testing.assert_allclose(estimate.position, POSITION + 0.1, atol=1e-6)
    np.testing.assert_allclose(np.diag(estimate.covariance)[3:], 0.05 ** 2, rtol=0.01)


@pytest.mark.parametrize('share', (0.1, 0.3))
def test_points_that_move_by_themselves_do_not_win(share):
    rng = np.random.default_rng(4)
    R = random_rotation(rng, 1)
    seen = points(rng, R, POSITION, noise_rad=SIGMA_RAD, information=100.)
    wrong = np.arange(len(seen)) < share * len(seen)
    seen.y[wrong] = unit(seen.y[wrong] + (0.05, 0.02, 0.))
    estimate = fit(seen)
    assert angle_deg(estimate.R_camera_world, R) < 0.03
    assert np.median(estimate.weights[wrong]) < 0.1 < 0.5 < np.median(estimate.weights[~wrong])


def test_a_point_without_information_across_its_edge_does_not_pull_along_it():
    rng = np.random.default_rng(5)
    R = random_rotation(rng, 1)
    seen = points(rng, R, POSITION, information=1e4)
    slid = np.arange(len(seen)) % 2 == 0
    seen.y[slid] = unit(seen.y[slid] + 0.02 * SIGMA_RAD * seen.sqrt_information[slid, 1])
    seen.sqrt_information[slid, 1] *= 1e-3
    assert angle_deg(fit(seen).R_camera_world, R) < 0.01


@pytest.mark.parametrize('seed', range(3))
def test_the_whole_turns_with_the_points(seed):
    rng = np.random.default_rng(seed)
    R = random_rotation(rng, 2)
    seen = points(rng, R, POSITION, noise_rad=SIGMA_RAD, information=10.)
    world, mount = random_rotation(rng, 70), random_rotation(rng, 130)
    plain = fit(seen, position=POSITION / 2)
    other = fit(turned(seen, world, mount), R=mount * world.inv(),
                position=world.apply(POSITION / 2))
    # The last step may be left out in one and not in the other.
    left = other.R_camera_world * world * plain.R_camera_world.inv() * mount.inv()
    assert left.magnitude() < 2 * OPTIONS.step_tolerance
    np.testing.assert_allclose(other.position, world.apply(plain.position),
                               atol=2 * OPTIONS.step_tolerance)
    np.testing.assert_allclose(other.inverse_depths, plain.inverse_depths, atol=1e-3)
    np.testing.assert_allclose(other.weights, plain.weights, atol=0.02)
    axes = np.zeros((6, 6))
    axes[:3, :3], axes[3:, 3:] = mount.as_matrix(), world.as_matrix()
    np.testing.assert_allclose(other.covariance, axes @ plain.covariance @ axes.T,
                               atol=1e-2 * np.abs(plain.covariance[:3, :3]).max())


def test_a_position_known_as_well_as_it_is_seen_ends_in_between():
    rng = np.random.default_rng(12)
    R = random_rotation(rng, 20)
    sigma = 3e-5
    off = sigma * unit(rng.normal(size=3))
    estimate = fit(points(rng, R, POSITION), R=R, position=POSITION + off, sigma=sigma)
    # Of Gaussians, the mean is weighted by the covariances.
    pulled = estimate.covariance[:, 3:] @ off / sigma ** 2
    assert 0.2 < np.linalg.norm(pulled[3:]) / sigma < 0.8
    error = np.r_[(estimate.R_camera_world * R.inv()).as_rotvec(), estimate.position - POSITION]
    np.testing.assert_allclose(error, pulled, atol=0.03 * sigma)


@pytest.mark.parametrize('estimator', (fit_pose, fit_depths))
def test_a_depth_known_as_well_as_it_is_seen_ends_half_way(estimator):
    rng = np.random.default_rng(13)
    R = random_rotation(rng, 20)
    seen = points(rng, R, POSITION, count=4000)
    z = seen.x - seen.inverse_depths[:, None] * (POSITION - seen.origins)
    # A bearing moves by this per inverse depth, in standard deviations.
    moves = (np.linalg.norm(np.cross(seen.x, POSITION - seen.origins), axis=1)
             / (z ** 2).sum(axis=1) / SIGMA_RAD)
    guess = replace(seen, inverse_depths=seen.inverse_depths + 1e-5)
    pose = fit(seen, R=R, position=POSITION)
    if estimator is fit_pose:
        guess = replace(guess, information=moves ** 2 / Loss.min_scale ** 2)
        # The pose is held by points whose depths are known.
        both = Points.joined((guess[:20], seen))
        rho = fit(both, R=R, position=POSITION).inverse_depths[:20]
    else:
        rho = fit_depths(replace(guess, information=moves ** 2), pose, OPTIONS).inverse_depths[:20]
    np.testing.assert_allclose(rho - seen.inverse_depths[:20], 0.5e-5, rtol=0.05)


@pytest.mark.parametrize('information, noise', ((400., 1.), (1e6, 1.), (1e6, 0.4)))
def test_errors_are_as_large_as_the_covariance_says(information, noise):
    squared = []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        R = random_rotation(rng, 20)
        seen = points(rng, R, POSITION, 150, noise * SIGMA_RAD, information)
        rho = seen.inverse_depths + rng.normal(size=len(seen)) / np.sqrt(information)
        estimate = fit(replace(seen, inverse_depths=rho), R=R, position=POSITION)
        error = np.r_[(estimate.R_camera_world * R.inv()).as_rotvec(),
                      estimate.position - POSITION]
        squared.append([error[:3] @ np.linalg.solve(estimate.covariance[:3, :3], error[:3]) / 3,
                        error @ np.linalg.solve(estimate.covariance, error) / 6])
    assert (0.5 < np.mean(squared, axis=0)).all() and (np.mean(squared, axis=0) < 2).all()


def test_at_a_known_pose_depths_are_found_and_the_pose_is_left_alone():
    rng = np.random.default_rng(7)
    R = random_rotation(rng, 40)
    pose = fit(points(rng, R, POSITION), R=R, position=POSITION)
    seen = points(rng, R, POSITION, information=1e-3)
    # At infinity, and with nothing to tell the depth by.
    seen.inverse_depths[0], seen.y[0] = 0., unit(R.apply(seen.x[0]))
    seen.origins[1], seen.y[1] = POSITION, R.apply(seen.x[1])
    seen = replace(seen, sqrt_information=tangents(seen.y))
    guess = np.full(len(seen), 0.6)
    estimate = fit_depths(replace(seen, inverse_depths=guess), pose, OPTIONS)
    baseline = np.linalg.norm(np.cross(seen.x, POSITION - seen.origins), axis=1)
    told = baseline > 0.05
    np.testing.assert_allclose(estimate.inverse_depths[told], seen.inverse_depths[told], atol=2e-3)
    assert estimate.inverse_depths[1] == guess[1]
    assert estimate.R_camera_world is pose.R_camera_world
    assert estimate.position is pose.position
    assert estimate.covariance is pose.covariance
    assert np.median(estimate.sizes) < 0.01


def test_depths_stay_between_infinity_and_the_nearest():
    rng = np.random.default_rng(8)
    pose = fit(points(rng, Rotation.identity(), POSITION))
    seen = points(rng, Rotation.identity(), POSITION, information=1e-3)
    anywhere = replace(seen, y=unit(rng.normal(size=seen.y.shape)))
    anywhere = replace(anywhere, sqrt_information=tangents(anywhere.y))
    for rho in (fit_depths(anywhere, pose, OPTIONS).inverse_depths, fit(anywhere).inverse_depths):
        assert rho.min() >= 0 and rho.max() <= OPTIONS.max_inverse_depth
        assert (rho == 0).any()


def with_somebody(rng, R, width_deg, centre_deg, share=0.45, count=400):
    """Return Points of which a share, in one sector of azimuths, goes its own way."""
    seen = points(rng, R, POSITION, 20 * count, SIGMA_RAD, 4.)
    azimuth_deg = np.rad2deg(np.arctan2(seen.y[:, 0], seen.y[:, 2])) - centre_deg
    inside = np.abs((azimuth_deg + 180) % 360 - 180) < width_deg / 2
    movers = round(share * count)
    chosen = np.r_[np.flatnonzero(inside)[:movers], np.flatnonzero(~inside)[:count - movers]]
    seen = seen[chosen]
    moving = np.arange(count) < movers
    own = Rotation.from_rotvec(np.deg2rad((1, 4, -1)))
    seen.y[moving] = own.apply(seen.y[moving])
    return replace(seen, sqrt_information=tangents(seen.y)), moving


def fit_among_movers(seen, R=Rotation.identity(), position=HERE, sigma=1.):
    """Return the best of the poses, and the costs of all."""
    poses, costs = fit_poses_among_movers(
        seen, [(R, position)], sigma, np.random.default_rng(0), AMONG_MOVERS)
    return poses[np.argmin(costs)], costs


@pytest.mark.parametrize('width_deg, centre_deg', ((90, 0), (100, 20), (110, -170)))
@pytest.mark.parametrize('share', (0.45, 0.65))
def test_who_holds_one_side_of_the_picture_does_not_win(width_deg, centre_deg, share):
    """Not even with the most corners: it is the places that count."""
    rng = np.random.default_rng(9)
    R = random_rotation(rng, 1)
    seen, moving = with_somebody(rng, R, width_deg, centre_deg, share)
    plain, (among, _) = fit(seen), fit_among_movers(seen)
    assert angle_deg(plain.R_camera_world, R) > 0.3
    assert angle_deg(among.R_camera_world, R) < 0.05
    np.testing.assert_allclose(among.position, POSITION, atol=0.01)
    assert np.median(among.weights[moving]) < 0.1 < 0.5 < np.median(among.weights[~moving])


@pytest.mark.parametrize('seed', range(4))
def test_two_groups_of_unknown_depths_are_told_apart(seed):
    """The mover is nearer, richer, and what was held for the pose so far is his."""
    rng = np.random.default_rng(seed)
    R, own = random_rotation(rng, 2), random_rotation(rng, 2)
    world = points(rng, R, POSITION, 250, SIGMA_RAD, 0.3, spread=0.)
    walker = points(rng, own, 3 * np.roll(POSITION, 1), 3000, SIGMA_RAD, 0.3, spread=0.)
    walker = walker[walker.x @ unit(rng.normal(size=3)) > 0.75][:350]
    seen = Points.joined((world, walker))
    seen = replace(seen, inverse_depths=np.ones(len(seen)), sqrt_information=tangents(seen.y))
    estimate, _ = fit_among_movers(seen, R=own)
    assert angle_deg(estimate.R_camera_world, R) < 0.06
    held = OPTIONS.loss.inliers(estimate.sizes, estimate.scale)
    assert held[:250].mean() > 0.9 and held[250:].mean() < 0.3


def test_where_all_is_one_scene_nothing_else_is_tried():
    rng = np.random.default_rng(10)
    R = random_rotation(rng, 1)
    seen = points(rng, R, POSITION, noise_rad=SIGMA_RAD, information=4.)
    estimate, costs = fit_among_movers(seen)
    assert len(costs) == 1
    assert angle_deg(estimate.R_camera_world, R) < 0.05


def test_places_are_of_equal_size():
    y = unit(np.random.default_rng(14).normal(size=(100_000, 3)))
    place, count = places(y, AMONG_MOVERS.place_rad)
    np.testing.assert_array_equal(np.bincount(place), count)
    # But for those at the poles.
    assert np.percentile(count, 90) / np.percentile(count, 10) < 1.5


def test_agreement_counts_places():
    crowd = np.tile((0., 0., 1.), (90, 1))
    elsewhere = np.array(((1., 0, 0), (-1, 0, 0), (0, 0, -1)))
    y = np.concatenate((crowd, elsewhere))
    assert agreement(y, np.arange(93) < 90, AMONG_MOVERS) == pytest.approx(1 / 4)
    assert agreement(y, np.arange(93) >= 90, AMONG_MOVERS) == pytest.approx(3 / 4)


def test_some_of_the_points_are_those_points():
    seen = points(np.random.default_rng(11), Rotation.identity(), POSITION, 6)
    some = seen[np.array((True, False, True, True, False, False))]
    assert len(some) == 3
    np.testing.assert_array_equal(some.y, seen.y[[0, 2, 3]])
    np.testing.assert_array_equal(some.sqrt_information, seen.sqrt_information[[0, 2, 3]])
    np.testing.assert_array_equal(some.origins, seen[[0, 2, 3]].origins)


def best_among_movers(seen, R, position, sigma, _):
    """Return what fit_pose does, where much may move by itself."""
    return fit_among_movers(seen, R, position, sigma)[0]


@pytest.mark.parametrize('estimator', (fit_pose, best_among_movers))
@pytest.mark.parametrize('unit_ratio', (0.3, 7., 100.))
def test_the_unit_of_length_does_not_matter(unit_ratio, estimator):
    rng = np.random.default_rng(14)
    R = random_rotation(rng, 2)
    seen = points(rng, R, POSITION, noise_rad=SIGMA_RAD, information=10.)
    guess = 0.5 * POSITION
    plain = fit(seen, estimator, position=guess, sigma=0.5)
    other = fit(replace(seen, origins=unit_ratio * seen.origins,
                        inverse_depths=seen.inverse_depths / unit_ratio,
                        information=unit_ratio ** 2 * seen.information),
                estimator, position=unit_ratio * guess, sigma=0.5 * unit_ratio)
    # The last step may be left out in one and not in the other.
    left = other.R_camera_world * plain.R_camera_world.inv()
    assert left.magnitude() < 2 * OPTIONS.step_tolerance
    np.testing.assert_allclose(other.position / unit_ratio, plain.position,
                               atol=2 * OPTIONS.step_tolerance)
    # A redescending loss settles slowly, and its last depths are not waited for.
    np.testing.assert_allclose(other.inverse_depths * unit_ratio, plain.inverse_depths,
                               atol=1e-3 if estimator is fit_pose else 5e-3)
    # Whatever the axes: of a covariance by the other one all eigenvalues are 1.
    units = np.diag((1, 1, 1, *3 * [1 / unit_ratio]))
    ratios = np.linalg.eigvals(np.linalg.solve(
        plain.covariance, units @ other.covariance @ units)).real
    np.testing.assert_allclose(ratios, 1, rtol=0.02)
