# Copyright 2026 The sph_stab_ros developers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""Rotation and position against points of more or less known depth."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sph_stab_ros.estimators.pose import fit_pose
from synthetic import angle_deg, random_rotation, unit

POSITION = np.array((0.1, -0.05, 0.2))
SIGMA_RAD = 1e-3


def tangents(y):
    """Return the sphere's unit directions (2, N, 3) at y per standard deviation."""
    first = unit(np.cross(y, (0.3, 0.5, 0.8)))
    return np.stack((first, np.cross(y, first))) / SIGMA_RAD


def points(rng, R, position, count=400, noise_rad=0.):
    """Return x, y (N, 3) and inverse depths (N,) of points 1 to 5 away, seen from a pose."""
    x = unit(rng.normal(size=(count, 3)))
    rho = rng.uniform(0.2, 1, size=count)
    y = unit(R.apply(x - rho[:, None] * position))
    return x, unit(y + noise_rad * rng.normal(size=y.shape)), rho


def fit(x, y, rho, information, **changed):
    """Return the PoseEstimate of points whose depths are known to ``information``."""
    information = np.full(len(x), float(information))
    return fit_pose(x, y, changed.get('whitening', tangents(y)), rho, information, np.zeros(3))


def test_known_depths_give_rotation_and_position():
    rng = np.random.default_rng(1)
    R = random_rotation(rng, 3)
    estimate = fit(*points(rng, R, POSITION), information=1e6)
    assert angle_deg(estimate.R, R) < 1e-3
    np.testing.assert_allclose(estimate.position, POSITION, atol=1e-4)
    assert estimate.weights.min() > 0.99


def test_unknown_depths_give_rotation_direction_and_the_depths():
    rng = np.random.default_rng(2)
    R = random_rotation(rng, 1)
    x, y, rho = points(rng, R, POSITION)
    estimate = fit(x, y, np.full(len(x), 0.6), information=1.)
    assert angle_deg(estimate.R, R) < 0.01
    assert unit(estimate.position) @ unit(POSITION) > 0.999
    # In the unit that the prior sets.
    unit_ratio = np.linalg.norm(estimate.position) / np.linalg.norm(POSITION)
    error = np.abs(estimate.inverse_depths * unit_ratio - rho)
    assert np.median(error) < 0.01


def test_without_motion_there_is_rotation_only():
    rng = np.random.default_rng(3)
    R = random_rotation(rng, 2)
    x, y, _ = points(rng, R, np.zeros(3), noise_rad=SIGMA_RAD)
    estimate = fit(x, y, np.ones(len(x)), information=1.)
    assert angle_deg(estimate.R, R) < 0.02
    assert np.linalg.norm(estimate.position) < 3e-3


@pytest.mark.parametrize('share', (0.1, 0.3))
def test_points_that_move_by_themselves_do_not_win(share):
    rng = np.random.default_rng(4)
    R = random_rotation(rng, 1)
    x, y, rho = points(rng, R, POSITION, noise_rad=SIGMA_RAD)
    wrong = np.arange(len(x)) < share * len(x)
    y[wrong] = unit(y[wrong] + (0.05, 0.02, 0.))
    estimate = fit(x, y, rho, information=100.)
    assert angle_deg(estimate.R, R) < 0.03
    assert np.median(estimate.weights[wrong]) < 0.1 < 0.5 < np.median(estimate.weights[~wrong])


def test_a_point_without_information_across_its_edge_does_not_pull_along_it():
    rng = np.random.default_rng(5)
    R = random_rotation(rng, 1)
    x, y, rho = points(rng, R, POSITION)
    whitening = tangents(y)
    slid = np.arange(len(x)) % 2 == 0
    y[slid] = unit(y[slid] + 0.02 * SIGMA_RAD * whitening[1, slid])
    whitening[1, slid] *= 1e-3
    estimate = fit(x, y, rho, information=1e4, whitening=whitening)
    assert angle_deg(estimate.R, R) < 0.01


def test_the_whole_turns_with_the_points():
    rng = np.random.default_rng(6)
    R = random_rotation(rng, 2)
    x, y, rho = points(rng, R, POSITION, noise_rad=SIGMA_RAD)
    mount = random_rotation(rng, 130)
    plain = fit(x, y, rho, information=10.)
    whitening = np.stack([mount.apply(w) for w in tangents(y)])
    turned = fit(mount.apply(x), mount.apply(y), rho, information=10., whitening=whitening)
    assert angle_deg(turned.R, mount * plain.R * mount.inv()) < 2e-3
    np.testing.assert_allclose(turned.position, mount.apply(plain.position), atol=1e-4)


def test_errors_are_as_large_as_the_covariance_says():
    squared = []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        x, y, rho = points(rng, Rotation.identity(), POSITION, count=150, noise_rad=SIGMA_RAD)
        estimate = fit(x, y, rho + 0.05 * rng.normal(size=len(rho)), information=400.)
        error = estimate.R.as_rotvec()
        squared.append(error @ np.linalg.solve(estimate.covariance[:3, :3], error) / 3)
    assert 0.5 < np.mean(squared) < 2
