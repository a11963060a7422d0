# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Laws that every estimator keeps, on pairs of bearings with exact truth."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sph_stab_ros.tracking.frame_to_frame.estimators import (
    BearingPairs, epipolar, essential, fit_epipolar, fit_essential, fit_moment, FitStatus, moment)
from sph_stab_ros.tracking.frame_to_frame.estimators.base import weighted_median
from synthetic import angle_deg, point_pairs, random_rotation, unit


def fit_pts_epipolar(pairs):
    """Return the 5-DoF fit as the method has it: started from the essential matrix."""
    return fit_epipolar(pairs, fit_essential(pairs))


FITS = {'pts': fit_essential, 'moment': fit_moment, 'pts_epipolar': fit_pts_epipolar}
SEEDS = range(4)
every_fit = pytest.mark.parametrize('fit', FITS.values(), ids=FITS)
every_seed = pytest.mark.parametrize('seed', SEEDS)


@every_fit
@every_seed
@pytest.mark.parametrize('rotation_deg', (0., 1., 5., 40.))
def test_rotation_with_translation_is_recovered(fit, seed, rotation_deg):
    rng = np.random.default_rng(seed)
    R = random_rotation(rng, rotation_deg)
    pairs = point_pairs(rng, R, 0.15 * unit(rng.normal(size=3)), noise_rad=1e-3)
    assert angle_deg(fit(pairs).R_current_previous, R) < 0.3


@every_fit
@every_seed
@pytest.mark.parametrize('rotation_deg', (0., 0.2, 5., 40.))
def test_pure_rotation_is_recovered(fit, seed, rotation_deg):
    rng = np.random.default_rng(seed)
    R = random_rotation(rng, rotation_deg)
    pairs = point_pairs(rng, R, np.zeros(3), noise_rad=1e-3)
    assert angle_deg(fit(pairs).R_current_previous, R) < 0.05


@every_fit
@every_seed
def test_outliers_do_not_matter_much(fit, seed):
    rng = np.random.default_rng(seed)
    R = random_rotation(rng, 2)
    pairs = point_pairs(rng, R, 0.15 * unit(rng.normal(size=3)), noise_rad=1e-3, outliers=0.1)
    assert angle_deg(fit(pairs).R_current_previous, R) < (0.3 if fit is fit_essential else 1.)


@every_fit
@every_seed
def test_turning_the_cameras_turns_the_estimate(fit, seed):
    """Equivariance: x → A x, x' → B x' makes of R the rotation B R A⁻¹."""
    rng = np.random.default_rng(seed)
    R = random_rotation(rng, 1)
    pairs = point_pairs(rng, R, 0.3 * unit(rng.normal(size=3)), noise_rad=1e-4)
    A = Rotation.random(random_state=rng)
    B = random_rotation(rng, 2) * A
    turned = BearingPairs(A.apply(pairs.previous), B.apply(pairs.current), pairs.weights)
    expected = B * fit(pairs).R_current_previous * A.inv()
    start = B * A.inv()
    found = fit_moment(turned, start) if fit is fit_moment else fit(turned)
    assert angle_deg(found.R_current_previous, expected) < 0.05


@every_fit
@every_seed
def test_time_reversed_inverts_the_estimate(fit, seed):
    rng = np.random.default_rng(seed)
    R = random_rotation(rng, 2)
    pairs = point_pairs(rng, R, 0.1 * unit(rng.normal(size=3)), noise_rad=1e-4)
    back = BearingPairs(pairs.current, pairs.previous, pairs.weights)
    assert angle_deg(fit(back).R_current_previous, fit(pairs).R_current_previous.inv()) < 0.1


@every_fit
def test_too_few_pairs_are_no_estimate(fit):
    pairs = point_pairs(np.random.default_rng(0), Rotation.identity(), np.zeros(3), count=12)
    assert fit(pairs) is None if fit is not fit_pts_epipolar else fit_essential(pairs) is None
    assert fit_moment(BearingPairs.empty()) is None


@pytest.mark.parametrize('fit', (fit_essential, fit_pts_epipolar), ids=('pts', 'pts_epipolar'))
@every_seed
def test_the_epipole_is_where_the_flow_points(fit, seed):
    rng = np.random.default_rng(seed)
    t = unit(rng.normal(size=3))
    pairs = point_pairs(rng, random_rotation(rng, 3), 0.3 * t, noise_rad=1e-3)
    assert np.rad2deg(np.arccos(fit(pairs).t_current @ t)) < 2


@every_seed
@pytest.mark.parametrize('rotation_deg', (0., 1., 5., 10., 40.))
def test_moment_is_the_l1_fit_of_a_rotation(seed, rotation_deg):
    """An independent solver, iteratively reweighted Wahba, ends at the same rotation."""
    rng = np.random.default_rng(seed)
    R = random_rotation(rng, rotation_deg)
    pairs = point_pairs(rng, R, 0.15 * unit(rng.normal(size=3)), noise_rad=2e-3, outliers=0.05)
    l1 = Rotation.identity()
    for _ in range(200):
        flow = np.linalg.norm(pairs.current - l1.apply(pairs.previous), axis=1)
        l1 = Rotation.align_vectors(pairs.current, pairs.previous, pairs.weights
                                    / np.maximum(flow, 1e-5))[0]
    assert angle_deg(fit_moment(pairs).R_current_previous, l1) < 0.01


@every_seed
def test_the_moment_of_pure_translation_is_zero_at_any_depth(seed):
    """Points come in antipodal pairs of different depths; only the directions count."""
    rng = np.random.default_rng(seed)
    half = unit(rng.normal(size=(500, 3)))
    bearings = np.vstack((half, -half))
    moved = unit(bearings * rng.uniform(1, 10, size=(1000, 1)) + 0.1 * unit(rng.normal(size=3)))
    pairs = BearingPairs(bearings, moved, np.ones(1000))
    # x × f/|f| at antipodes is opposite up to the second order of the motion.
    assert moment_size(pairs, Rotation.identity()) < 1e-2
    assert moment_size(pairs, random_rotation(rng, 5)) > 0.3


def moment_size(pairs, R):
    """Return |M| as the estimator has it, of equal weights: JᵀM and JᵀJ tell it."""
    linearised = moment.linearise(R, pairs, pairs.weights / len(pairs), 0.)
    return np.sqrt(linearised.JTr @ np.linalg.solve(linearised.JTJ, linearised.JTr))


@every_seed
def test_without_parallax_epipolar_returns_its_start(seed):
    rng = np.random.default_rng(seed)
    pairs = point_pairs(rng, random_rotation(rng, 2), np.zeros(3), noise_rad=2e-3)
    start = fit_essential(pairs)
    estimate = fit_epipolar(pairs, start)
    assert estimate.status is FitStatus.NO_PARALLAX
    assert estimate.R_current_previous is start.R_current_previous


@every_seed
def test_epipolar_improves_on_its_start(seed):
    rng = np.random.default_rng(seed)
    R = random_rotation(rng, 2)
    pairs = point_pairs(rng, R, 0.5 * unit(rng.normal(size=3)), noise_rad=1e-3)
    start = fit_essential(pairs)
    off = random_rotation(rng, 0.5) * start.R_current_previous
    estimate = fit_epipolar(pairs, type(start)(off, 0., 100, start.t_current))
    assert angle_deg(estimate.R_current_previous, R) < 0.05


@every_seed
def test_jacobians_are_the_derivatives(seed):
    rng = np.random.default_rng(seed)
    pairs = point_pairs(rng, random_rotation(rng, 3), 0.2 * unit(rng.normal(size=3)), count=40)
    weights = np.full(40, 1 / 40)
    R, q = random_rotation(rng, 1), unit(rng.normal(size=3))

    def M(omega):
        """Return the moment of Eq. 2, smoothed."""
        x_r = moment.retract(R, omega).apply(pairs.previous)
        flow = pairs.current - x_r
        return (weights / np.hypot(np.linalg.norm(flow, axis=1), 0.01)) @ np.cross(x_r, flow)

    def omegas(step):
        state = epipolar.State(R, q).moved(step)
        return epipolar.flow_angles(pairs, state.R, state.q)

    J = numeric_jacobian(M, 3)
    linearised = moment.linearise(R, pairs, weights, 0.01)
    np.testing.assert_allclose(linearised.JTJ, J.T @ J, atol=1e-4 * np.abs(J.T @ J).max())
    np.testing.assert_allclose(linearised.JTr, J.T @ M(np.zeros(3)), atol=1e-6 * abs(J).max())

    J = numeric_jacobian(omegas, 5)
    linearised = epipolar.linearise(epipolar.State(R, q), pairs, weights, np.inf)
    np.testing.assert_allclose(
        linearised.JTJ, J.T @ J / 40, atol=1e-4 * np.abs(J.T @ J / 40).max())
    np.testing.assert_allclose(
        linearised.JTr, J.T @ omegas(np.zeros(5)) / 40, atol=1e-4 * np.abs(linearised.JTr).max())


def numeric_jacobian(function, size, step=1e-6):
    """Return the central differences of a function of a vector (size,) at zero."""
    return np.stack([(function(step * e) - function(-step * e)) / (2 * step)
                     for e in np.eye(size)], axis=-1)


def test_flow_angles_are_those_between_the_normals():
    """Ω as the paper writes it: the angle between N_q = q × x and N_f = (x + f) × x."""
    rng = np.random.default_rng(0)
    pairs = point_pairs(rng, Rotation.identity(), 0.5 * unit(rng.normal(size=3)), count=50)
    q = unit(rng.normal(size=3))
    N_q, N_f = np.cross(q, pairs.previous), np.cross(pairs.current, pairs.previous)
    np.testing.assert_allclose(
        np.abs(epipolar.flow_angles(pairs, Rotation.identity(), q)),
        np.arccos(np.sum(unit(N_q) * unit(N_f), axis=1)), atol=1e-6)


def test_an_essential_matrix_comes_apart_as_it_was_put_together():
    rng = np.random.default_rng(0)
    R, t = random_rotation(rng, 20), unit(rng.normal(size=3))
    pairs = point_pairs(rng, R, t, count=100)
    E = np.cross(np.eye(3), t).T @ R.as_matrix()
    for sign in (1, -1):
        found_R, found_t = essential.decompose(sign * E, pairs)
        assert angle_deg(found_R, R) < 1e-6
        np.testing.assert_allclose(found_t, t, atol=1e-9)
    assert essential.epipolar_distance(E[None], pairs).max() < 1e-9


def test_the_weighted_median_halves_the_weight():
    assert weighted_median(np.array((3., 1., 2.)), np.array((1., 1., 1.))) == 2
    assert weighted_median(np.array((3., 1., 2.)), np.array((9., 1., 1.))) == 3


@every_seed
def test_without_a_bound_epipolar_is_the_minimum_of_eq_8(seed):
    """No small step lowers the sum of squares, but for the kinks where an outlier's Ω passes π."""
    rng = np.random.default_rng(seed)
    R = random_rotation(rng, 2)
    pairs = point_pairs(rng, R, 0.5 * unit(rng.normal(size=3)), noise_rad=5e-3, outliers=0.05)
    plain = fit_epipolar(pairs, fit_essential(pairs), np.inf)

    def cost(state):
        return np.sum(epipolar.flow_angles(pairs, state.R, state.q) ** 2)

    state = epipolar.State(plain.R_current_previous, plain.t_current)
    for step in 1e-3 * np.vstack((np.eye(5), -np.eye(5))):
        assert cost(state.moved(step)) > (1 - 1e-5) * cost(state)
    bounded = fit_pts_epipolar(pairs)
    assert angle_deg(bounded.R_current_previous, plain.R_current_previous) > 1e-3
