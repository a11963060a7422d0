# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The virtual camera's motion: a low-pass on the sphere, by its laws."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sph_stab_ros.config import SmoothingConfig, StabilizerConfig, TrackerConfig
from sph_stab_ros.geometry.warp import perspective_view
from sph_stab_ros.images.frame import Frame
from sph_stab_ros.stabilization.level import heading
from sph_stab_ros.stabilization.pipeline import Stabilizer
from sph_stab_ros.stabilization.smoothing import Smoother
from synthetic import angle_deg, textured_sphere

TAU_S = 0.8
FOLLOW = SmoothingConfig('follow', TAU_S)
YAW_FOLLOW = SmoothingConfig('yaw_follow', TAU_S)
LOCK = SmoothingConfig('lock', TAU_S)


def stamps(rate_hz, duration_s):
    """Return times in seconds and as stamps in nanoseconds."""
    times_s = np.arange(0, duration_s, 1 / rate_hz)
    return times_s, np.rint(times_s * 1e9).astype(int)


def smoothed(config, stamps_ns, R_world_camera, smoother=None):
    """Return R_world_virtual of all orientations."""
    smoother = smoother or Smoother()
    return Rotation.concatenate([smoother.update(config, int(stamp_ns), R)
                                 for stamp_ns, R in zip(stamps_ns, R_world_camera)])


def about(axis, angles_rad):
    """Return turns by angles (N,) about an axis."""
    axis = np.array(axis, float) / np.linalg.norm(axis)
    return Rotation.from_rotvec(np.outer(angles_rad, axis))


def wandering(times_s, seed=0, size=1.):
    """Return smooth orientations all over the place, and their steepest moments too."""
    rng = np.random.default_rng(seed)
    waves = sum(np.sin(np.outer(times_s, rng.uniform(0.3, 3, 3)) + rng.uniform(0, 6, 3))
                for _ in range(3))
    return Rotation.from_rotvec(size * waves)


def angles_rad(R, axis):
    """Return continuous angles (N,) of turns about an axis."""
    return np.unwrap(R.as_rotvec() @ (np.array(axis, float) / np.linalg.norm(axis)))


def bend(R_world_virtual):
    """Return the change of turn from step to step in radians."""
    steps = (R_world_virtual[:-1].inv() * R_world_virtual[1:]).as_rotvec()
    return np.linalg.norm(np.diff(steps, axis=0), axis=1)


@pytest.mark.parametrize('frequency_hz', (0.05, 0.2, 0.5, 1., 3.))
@pytest.mark.parametrize('config, axis', (
    (FOLLOW, (0, 1, 0)), (FOLLOW, (1, -2, 0.5)), (YAW_FOLLOW, (0, 1, 0))))
def test_gain_and_phase_are_those_of_the_low_pass(config, axis, frequency_hz):
    settling_s = 12 * TAU_S
    times_s, stamps_ns = stamps(60, settling_s + 2 / frequency_hz)
    wave = np.exp(2j * np.pi * frequency_hz * times_s)
    R_world_virtual = smoothed(config, stamps_ns, about(axis, 0.5 * wave.imag))
    settled = times_s >= settling_s
    basis = np.stack((wave.real, wave.imag, np.ones_like(times_s)), axis=1)[settled]
    fit = np.linalg.lstsq(basis, angles_rad(R_world_virtual, axis)[settled])[0]
    response = (fit[1] + 1j * fit[0]) / 0.5
    expected = 1 / (1 + 2j * np.pi * frequency_hz * TAU_S / 2)**2
    # Between frames, here 20 or more in a period, a sine is not quite straight.
    assert abs(response - expected) < 0.01 * abs(expected)


def test_a_step_is_answered_without_overshoot():
    times_s, stamps_ns = stamps(1000, 6 * TAU_S)
    angles = np.where(times_s > 0, 1.2, 0.)
    answer = angles_rad(smoothed(FOLLOW, stamps_ns, about((1, 1, 1), angles)), (1, 1, 1))
    x = 2 * times_s / TAU_S
    np.testing.assert_allclose(answer, 1.2 * (1 - (1 + x) * np.exp(-x)), atol=2e-3)
    assert answer.max() <= 1.2 and (np.diff(answer) >= -1e-12).all()


@pytest.mark.parametrize('rate_rad_s', (0.1, 1.5, 12.))
@pytest.mark.parametrize('config', (FOLLOW, YAW_FOLLOW), ids=lambda config: config.mode)
def test_a_steady_turn_is_followed_by_the_time_constant_later(config, rate_rad_s):
    """Also where that is more than half a turn."""
    times_s, stamps_ns = stamps(30, 12 * TAU_S)
    R_world_virtual = smoothed(config, stamps_ns, about((0, 1, 0), rate_rad_s * times_s))
    lag_s = times_s[-1] - angles_rad(R_world_virtual, (0, 1, 0))[-1] / rate_rad_s
    assert lag_s == pytest.approx(TAU_S, rel=1e-6)


@pytest.mark.parametrize('config', (FOLLOW, YAW_FOLLOW), ids=lambda config: config.mode)
def test_how_often_and_how_regularly_frames_come_makes_no_difference(config):
    rng = np.random.default_rng(1)
    corners_s = np.array((0., 0.7, 1.1, 2.5, 4.))
    few_ns = np.rint(corners_s * 1e9).astype(int)
    many_ns = np.union1d(few_ns, rng.integers(0, 4 * 10**9, 300))
    angles = np.interp(many_ns * 1e-9, corners_s, (0., 0.9, -0.3, 2., 1.))
    many = smoothed(config, many_ns, about((0, 1, 0), angles))
    at_corners = np.searchsorted(many_ns, few_ns)
    few = smoothed(config, few_ns, about((0, 1, 0), angles[at_corners]))
    assert angle_deg(few, many[at_corners]).max() < 1e-6


def test_the_frame_rate_hardly_matters_where_the_axis_changes():
    fine = smoothed(FOLLOW, *(lambda t, ns: (ns, wandering(t)))(*stamps(240, 4)))
    coarse = smoothed(FOLLOW, *(lambda t, ns: (ns, wandering(t)))(*stamps(30, 4)))
    assert angle_deg(coarse, fine[::8]).max() < 0.5


@pytest.mark.parametrize('config, R_world_other', (
    (FOLLOW, Rotation.random(random_state=3)), (YAW_FOLLOW, Rotation.from_rotvec((0, 2, 0)))))
def test_turning_the_world_turns_the_result(config, R_world_other):
    times_s, stamps_ns = stamps(30, 5)
    R_other_camera = wandering(times_s)
    expected = R_world_other * smoothed(config, stamps_ns, R_other_camera)
    assert angle_deg(smoothed(config, stamps_ns, R_world_other * R_other_camera),
                     expected).max() < 1e-6


def test_following_does_not_depend_on_how_the_camera_sits():
    """With other axes of the camera, the virtual camera has the same other axes."""
    times_s, stamps_ns = stamps(30, 5)
    R_camera_other = Rotation.random(random_state=4)
    expected = smoothed(FOLLOW, stamps_ns, wandering(times_s)) * R_camera_other
    assert angle_deg(smoothed(FOLLOW, stamps_ns, wandering(times_s) * R_camera_other),
                     expected).max() < 1e-6


def test_lock_is_the_world_exactly():
    times_s, stamps_ns = stamps(30, 5)
    R_world_virtual = smoothed(LOCK, stamps_ns, wandering(times_s))
    np.testing.assert_array_equal(R_world_virtual.as_quat(), np.tile((0, 0, 0, 1), (150, 1)))


def test_the_horizon_is_level_whatever_the_camera_does():
    times_s, stamps_ns = stamps(30, 20)
    vertical = smoothed(YAW_FOLLOW, stamps_ns, wandering(times_s)).apply((0, 1, 0))
    np.testing.assert_allclose(vertical, np.tile((0, 1, 0), (600, 1)), atol=1e-12)


@pytest.mark.slow
def test_the_sphere_is_not_left_in_an_hour():
    times_s, stamps_ns = stamps(5, 3600)
    matrices = smoothed(FOLLOW, stamps_ns, wandering(times_s, size=2.)).as_matrix()
    np.testing.assert_allclose(matrices @ matrices.transpose(0, 2, 1),
                               np.broadcast_to(np.eye(3), matrices.shape), atol=1e-12)


def test_no_turn_makes_the_picture_jump():
    """Not by half a turn, not over a pole, and not where camera and picture face away."""
    times_s, stamps_ns = stamps(30, 20)
    for seed in range(3):
        R_world_camera = wandering(times_s, seed, size=2.)
        for config in (FOLLOW, YAW_FOLLOW):
            # The pull towards a target at most one turn ahead changes the rate by no more.
            most = 2 * np.pi * (2 / TAU_S / 30)**2
            assert bend(smoothed(config, stamps_ns, R_world_camera)).max() < most


def test_without_a_heading_the_last_one_is_kept():
    times_s, stamps_ns = stamps(30, 4)
    # Up to 5° from the zenith, where the camera turns about itself.
    tilts = Rotation.from_rotvec(np.outer(np.minimum(times_s, np.deg2rad(85)), (1, 0, 0)))
    spinning = about((0, 1, 0), np.where(times_s > 1.6, times_s - 1.6, 0))
    R_world_camera = spinning * tilts
    R_world_virtual = smoothed(YAW_FOLLOW, stamps_ns, R_world_camera)
    assert heading(R_world_camera[0]) is not None and heading(R_world_camera[-1]) is None
    assert angle_deg(R_world_virtual[-1], Rotation.identity()) < 1e-6


def test_changes_of_mode_and_time_constant_do_not_make_the_picture_jump():
    times_s, stamps_ns = stamps(30, 20)
    R_world_camera = about((1, 3, -1), 0.4 * times_s)
    configs = (FOLLOW, LOCK, SmoothingConfig('follow', 0.3), YAW_FOLLOW, LOCK)
    smoother = Smoother()
    R_world_virtual = Rotation.concatenate([
        smoothed(config, stamps_ns[part], R_world_camera[part], smoother)
        for config, part in zip(configs, np.array_split(np.arange(len(times_s)), len(configs)))])
    assert bend(R_world_virtual).max() < np.pi * (2 / 0.3 / 30)**2
    # Home again, within four seconds.
    assert angle_deg(R_world_virtual[-1], Rotation.identity()) < 0.3


@pytest.mark.parametrize('second_ns', (0, 10**9))
def test_stamps_that_do_not_increase_leave_the_picture_where_it_is(second_ns):
    smoother = Smoother()
    smoother.update(FOLLOW, 10**9, Rotation.identity())
    R = smoother.update(FOLLOW, second_ns, Rotation.from_rotvec((0, 1, 0)))
    assert R.magnitude() == 0
    R = smoother.update(FOLLOW, second_ns + 10**9, Rotation.from_rotvec((0, 1, 0)))
    assert 0.5 < R.magnitude() < 1


def test_the_pictures_are_those_of_the_virtual_camera():
    """The follower's picture at the end of a slow turn is the world's, turned."""
    stabilizer = Stabilizer(StabilizerConfig(
        tracker=TrackerConfig(working_width=256), smoothing=FOLLOW))
    for i in range(40):
        R = Rotation.from_rotvec((0.01 * i, 0.02 * i, 0))
        stabilized = stabilizer.process(Frame(textured_sphere(256, R), i * 33_333_333))
    assert angle_deg(stabilized.R_world_camera, R) < 0.3
    R_world_virtual = stabilized.R_world_virtual
    assert 5 < angle_deg(R_world_virtual, Rotation.identity()) < angle_deg(R, Rotation.identity())
    expected = textured_sphere(256, R_world_virtual).astype(int)
    assert np.abs(stabilized.sphere() - expected).mean() < 4
    assert np.abs(stabilized.sphere() - textured_sphere(256).astype(int)).mean() > 15
    R_virtual_view = Rotation.from_rotvec((0.2, 1, 0))
    view = stabilized.view(R_virtual_view, 1., (64, 64))
    expected = perspective_view(
        textured_sphere(256, R_world_virtual), R_virtual_view, 1., (64, 64)).astype(int)
    assert np.abs(view - expected).mean() < 4


def test_a_live_change_of_mode_reaches_the_picture_smoothly():
    config = StabilizerConfig(tracker=TrackerConfig(working_width=256))
    stabilizer = Stabilizer(config)
    for i in range(60):
        if i == 20:
            stabilizer.reconfigure(StabilizerConfig(tracker=config.tracker, smoothing=FOLLOW))
        R = Rotation.from_rotvec((0, 0.02 * i, 0))
        stabilized = stabilizer.process(Frame(textured_sphere(256, R), i * 33_333_333))
        if i <= 20:
            assert angle_deg(stabilized.R_world_virtual, Rotation.identity()) < 0.1
    assert angle_deg(stabilized.R_world_virtual, Rotation.identity()) > 10
