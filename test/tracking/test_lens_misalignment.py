# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Halves of a stitched picture that are turned against each other."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sph_stab_ros.tracking.anchored.bundle_adjustment import adjust, BundleOptions
from sph_stab_ros.tracking.anchored.bundle_window import pose_and_point_equations, residuals
from sph_stab_ros.tracking.anchored.lens_misalignment import (
    apart, lens_equations, Lenses, LensOptions)
from synthetic import angle_deg, unit
from test_bundle_adjustment import perturbed, true_window

STITCH_RAD = np.deg2rad((0.2, -0.15, 0.25))


def learnt(rng, stitch_rad, noise_rad=2e-4, rounds=20):
    """Return the Lenses of a camera with such a stitch error, that turns and moves."""
    lenses = Lenses(LensOptions())
    for _ in range(rounds):
        window = true_window(rng, noise_rad=noise_rad)
        seen = apart(np.stack((window.x, window.x)).reshape(-1, 3), -stitch_rad)
        window = replace(window, x=lenses.corrected(seen[:len(window.x)]),
                         y=lenses.corrected(apart(window.y, -stitch_rad)))
        adjusted = adjust(perturbed(rng, window, 0.1, 1e-3, 0.05), BundleOptions())
        lenses.learn(*lens_equations(window, adjusted))
    return lenses


def test_the_halves_are_turned_apart():
    x = unit(np.random.default_rng(0).normal(size=(100, 3)))
    front, turned = x[:, 2] > 0, apart(x, STITCH_RAD)
    half = Rotation.from_rotvec(STITCH_RAD / 2)
    np.testing.assert_allclose(turned[front], half.apply(x[front]), atol=1e-5)
    np.testing.assert_allclose(turned[~front], half.inv().apply(x[~front]), atol=1e-5)


@pytest.mark.parametrize('seed', range(2))
def test_a_stitch_error_is_learnt(seed):
    lenses = learnt(np.random.default_rng(seed), STITCH_RAD)
    np.testing.assert_allclose(lenses.apart, STITCH_RAD, atol=np.deg2rad(0.03))


def test_what_is_well_stitched_is_left_alone():
    lenses = learnt(np.random.default_rng(3), np.zeros(3))
    assert np.rad2deg(np.linalg.norm(lenses.apart)) < 0.01


def test_what_is_not_known_of_the_lenses_grows_with_the_turn():
    lenses = Lenses(LensOptions())
    sigmas = [np.sqrt(lenses.covariance(
        Rotation.from_rotvec((0, angle, 0)).as_matrix())[0, 0])
              for angle in (0, 0.5, 1, 3)]
    assert sigmas[0] == 0
    assert (np.diff(sigmas) > 0).all()


def test_the_gradient_is_that_of_the_cost():
    rng = np.random.default_rng(5)
    window = perturbed(rng, true_window(rng, noise_rad=1e-3))
    state, weights = (window.R, window.p, window.inverse_depths), rng.uniform(size=len(window.y))

    def cost(rotvec):
        other = replace(window, x=apart(window.x, rotvec), y=apart(window.y, rotvec))
        return weights @ (residuals(other, *state) ** 2).sum(axis=1) / 2
    _, g, *_ = pose_and_point_equations(window, *state, weights, lenses=True)
    step = 1e-5 * np.eye(3)
    np.testing.assert_allclose(
        g[-3:], [(cost(one) - cost(-one)) / 2e-5 for one in step], rtol=1e-6)


def test_a_turn_of_the_camera_is_no_stitch_error():
    rng = np.random.default_rng(4)
    window = true_window(rng)
    H, g = lens_equations(window, adjust(perturbed(rng, window), BundleOptions()))
    assert np.linalg.eigvalsh(H).min() > 0
    assert angle_deg(Rotation.from_rotvec(np.linalg.solve(H, g)), Rotation.identity()) < 1e-3
