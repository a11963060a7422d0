# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Keyframes and depths of points that are adjusted together."""

from dataclasses import replace

from bundle_windows import KEYFRAMES, perturbed, SIGMA_RAD, true_window
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sph_stab_ros.tracking.anchored import bundle_adjustment
from sph_stab_ros.tracking.anchored.bundle_adjustment import BundleOptions
from sph_stab_ros.tracking.anchored.pose_estimation import MEDIAN_2D
from synthetic import random_rotation, unit

OPTIONS = BundleOptions()


def adjust(window, keep_distance=False, options=OPTIONS):
    return bundle_adjustment.adjust(window, options, keep_distance)


def errors_deg(R, truth):
    """Return the angles (K,) between rotation matrices (K, 3, 3)."""
    return np.rad2deg(
        (Rotation.from_matrix(R) * Rotation.from_matrix(truth).inv()).magnitude())


def in_unit_of(p, truth):
    """Return positions p (K, 3) in the unit of length in which the last is as far as the true."""
    return p * np.linalg.norm(truth[-1]) / np.linalg.norm(p[-1])


def cost(window, adjusted, scale):
    """Return what is minimised, at a given scale, of the observations' own geometry."""
    h, k, i = window.host[window.point], window.keyframe, window.point
    z = (np.einsum('mij,mj->mi', adjusted.R[h], window.x[i])
         - adjusted.inverse_depths[i, None] * (adjusted.p[k] - adjusted.p[h]))
    b = unit(np.einsum('mij,mi->mj', adjusted.R[k], z))
    sizes = np.linalg.norm(np.einsum('mki,mi->mk', window.sqrt_information, b - window.y), axis=1)
    if scale is None:
        scale = np.clip(np.median(sizes) / MEDIAN_2D, OPTIONS.min_scale, OPTIONS.max_scale)
    width = OPTIONS.cauchy_width
    return scale, (width ** 2 * np.log1p((sizes / (width * scale)) ** 2).sum()
                   + window.information
                   @ (adjusted.inverse_depths - window.inverse_depths) ** 2)


@pytest.mark.parametrize('keep_distance', (False, True))
@pytest.mark.parametrize('seed', range(3))
def test_disturbed_keyframes_come_back(seed, keep_distance):
    rng = np.random.default_rng(seed)
    truth = true_window(rng)
    start = perturbed(rng, truth)
    adjusted = adjust(start, keep_distance)
    p = in_unit_of(adjusted.p, truth.p)
    rho = adjusted.inverse_depths * np.linalg.norm(adjusted.p[-1]) / np.linalg.norm(truth.p[-1])
    assert errors_deg(start.R, truth.R).max() > 0.5
    assert errors_deg(adjusted.R, truth.R).max() < 0.01
    np.testing.assert_allclose(p, truth.p, atol=1e-3)
    np.testing.assert_allclose(rho, truth.inverse_depths, atol=0.01)


def test_at_the_truth_nothing_moves():
    rng = np.random.default_rng(3)
    truth = true_window(rng)
    adjusted = adjust(truth)
    np.testing.assert_allclose(adjusted.R, truth.R, atol=1e-9)
    np.testing.assert_allclose(adjusted.p, truth.p, atol=1e-9)
    assert adjusted.weights.min() > 0.999


@pytest.mark.parametrize('fixed', ((0,), (0, 1), (1, 4), (0, 2, 5)))
def test_fixed_keyframes_stay_exactly(fixed):
    rng = np.random.default_rng(4)
    truth = true_window(rng, noise_rad=SIGMA_RAD)
    free = ~np.isin(np.arange(KEYFRAMES), fixed)
    start = perturbed(rng, replace(truth, free=free))
    adjusted = adjust(start)
    np.testing.assert_array_equal(adjusted.R[~free], start.R[~free])
    np.testing.assert_array_equal(adjusted.p[~free], start.p[~free])
    assert errors_deg(adjusted.R, truth.R)[free].max() < 0.1
    assert adjusted.covariance.shape == (6 * free.sum(), 6 * free.sum())


def test_two_fixed_keyframes_set_the_unit_of_length():
    rng = np.random.default_rng(5)
    truth = true_window(rng)
    start = perturbed(rng, replace(truth, free=np.arange(KEYFRAMES) > 1))
    adjusted = adjust(replace(start, inverse_depths=1.2 * start.inverse_depths))
    np.testing.assert_allclose(adjusted.p, truth.p, atol=2e-3)


def test_the_last_keyframe_keeps_its_distance_where_it_is_to():
    rng = np.random.default_rng(6)
    truth = true_window(rng)
    # What is known of the depths says that all is larger.
    start = replace(truth, inverse_depths=truth.inverse_depths / 1.3,
                    information=np.full(len(truth.x), 30.))
    distance = np.linalg.norm(truth.p[-1])
    kept, free = adjust(start, keep_distance=True), adjust(start)
    assert abs(np.linalg.norm(kept.p[-1]) / distance - 1) < 1e-3
    assert np.linalg.norm(free.p[-1]) / distance > 1.1


def test_sightings_of_something_else_count_little():
    rng = np.random.default_rng(7)
    truth = true_window(rng, noise_rad=SIGMA_RAD)
    wrong = rng.random(len(truth.y)) < 0.15
    truth.y[wrong] = unit(truth.y[wrong] + rng.normal(0, 0.05, (wrong.sum(), 3)))
    adjusted = adjust(perturbed(rng, truth), keep_distance=True)
    assert np.median(adjusted.weights[wrong]) < 0.05 < 0.5 < np.median(adjusted.weights[~wrong])
    assert errors_deg(adjusted.R, truth.R).max() < 0.1
    np.testing.assert_allclose(in_unit_of(adjusted.p, truth.p), truth.p, atol=0.01)


@pytest.mark.parametrize('keep_distance', (False, True))
def test_the_result_turns_with_the_world(keep_distance):
    rng = np.random.default_rng(8)
    start = perturbed(rng, true_window(rng, noise_rad=SIGMA_RAD, information=3.))
    world = random_rotation(rng, 100)
    turned = replace(start, R=world.as_matrix() @ start.R, p=world.apply(start.p))
    plain, other = adjust(start, keep_distance), adjust(turned, keep_distance)
    assert errors_deg(other.R, world.as_matrix() @ plain.R).max() < 1e-3
    np.testing.assert_allclose(other.p, world.apply(plain.p), atol=1e-4)
    np.testing.assert_allclose(other.inverse_depths, plain.inverse_depths, atol=1e-3)
    np.testing.assert_allclose(other.weights, plain.weights, atol=0.05)


@pytest.mark.parametrize('turn_deg, move, depth', ((1, 0.02, 0.2), (20, 0.3, 1.), (90, 1., 2.)))
def test_no_step_makes_it_worse(turn_deg, move, depth):
    one_step = BundleOptions(max_iterations=1)
    for seed in range(6):
        rng = np.random.default_rng(seed)
        window = perturbed(rng, true_window(rng, 40, SIGMA_RAD), turn_deg, move, depth)
        lower = 0
        for _ in range(6):
            adjusted = adjust(window, options=one_step)
            scale, before = cost(window, window, None)
            _, after = cost(window, adjusted, scale)
            assert after <= before * (1 + 1e-9)
            lower += after < before
            window = replace(window, R=adjusted.R, p=adjusted.p,
                             inverse_depths=adjusted.inverse_depths)
        assert lower >= 2


def test_a_depth_known_as_well_as_it_is_seen_ends_half_way():
    truth = true_window(np.random.default_rng(10))
    truth = replace(truth, free=np.arange(KEYFRAMES) == KEYFRAMES - 1)
    seen = adjust(truth).information
    one = np.arange(len(truth.x)) == 50
    guess = np.where(one, truth.inverse_depths + 1e-5, truth.inverse_depths)
    adjusted = adjust(replace(truth, inverse_depths=guess,
                              information=np.where(one, seen, truth.information)))
    error = adjusted.inverse_depths[one] - truth.inverse_depths[one]
    np.testing.assert_allclose(error, 0.5e-5, rtol=0.05)


def test_errors_are_as_large_as_the_covariance_says():
    squared = []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        truth = true_window(rng, noise_rad=SIGMA_RAD, information=1e6)
        adjusted = adjust(truth)
        turns = (Rotation.from_matrix(adjusted.R)
                 * Rotation.from_matrix(truth.R).inv()).as_rotvec()
        error = np.hstack((turns, adjusted.p - truth.p))[truth.free].ravel()
        squared.append(error @ np.linalg.solve(adjusted.covariance, error) / len(error))
    assert 0.5 < np.mean(squared) < 2


def test_depths_are_as_certain_as_is_said():
    squared = []
    for seed in range(5):
        rng = np.random.default_rng(seed)
        truth = true_window(rng, noise_rad=SIGMA_RAD)
        fixed = replace(truth, free=np.arange(KEYFRAMES) == KEYFRAMES - 1)
        adjusted = adjust(fixed)
        error = adjusted.inverse_depths - truth.inverse_depths
        squared.append(adjusted.information * error ** 2)
    assert 0.5 < np.mean(squared) < 2


@pytest.mark.parametrize('keep_distance', (False, True))
@pytest.mark.parametrize('unit_ratio', (0.3, 7., 100.))
def test_the_unit_of_length_does_not_matter(unit_ratio, keep_distance):
    for seed in range(11, 15):
        rng = np.random.default_rng(seed)
        start = perturbed(rng, true_window(rng, noise_rad=SIGMA_RAD, information=3.))
        other = adjust(replace(start, p=unit_ratio * start.p,
                               inverse_depths=start.inverse_depths / unit_ratio,
                               information=unit_ratio ** 2 * start.information), keep_distance)
        plain = adjust(start, keep_distance)
        turns = (Rotation.from_matrix(other.R) * Rotation.from_matrix(plain.R).inv()).as_rotvec()
        left = np.hstack((turns, other.p / unit_ratio - plain.p))[start.free].ravel()
        # A tenth of the standard deviations.
        assert left @ np.linalg.solve(plain.covariance, left) / len(left) < 0.1 ** 2
        np.testing.assert_allclose(other.inverse_depths * unit_ratio, plain.inverse_depths,
                                   atol=1e-3)
