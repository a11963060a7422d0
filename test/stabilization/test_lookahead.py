# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The virtual camera of a recording whose end is known, by its laws."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sph_stab_ros.config import SmoothingConfig
from sph_stab_ros.stabilization.lookahead import kernel_weights, rotation_vectors, smooth

TAU_S = 0.8
FOLLOW = SmoothingConfig('follow', TAU_S)
YAW_FOLLOW = SmoothingConfig('yaw_follow', TAU_S)
# What is beyond the kernel's reach, at irregular times.
REACH_RAD = 1e-4


def frames(rate_hz=20, duration_s=6.):
    """Return times in seconds and in nanoseconds."""
    times_s = np.arange(0, duration_s, 1 / rate_hz)
    return times_s, np.rint(times_s * 1e9).astype(int)


def about(axis, angles_rad):
    """Return turns by angles (N,) about an axis."""
    axis = np.array(axis, float) / np.linalg.norm(axis)
    return Rotation.from_rotvec(np.outer(angles_rad, axis))


def wandering(times_s, seed=0, size=0.5):
    """Return smooth orientations about all axes."""
    rng = np.random.default_rng(seed)
    return Rotation.from_rotvec(size * sum(
        np.sin(np.outer(times_s, rng.uniform(0.3, 3, 3)) + rng.uniform(0, 6, 3))
        for _ in range(3)))


def assert_same(a, b, within_rad=1e-6):
    """See that orientations are the same."""
    assert np.max((a.inv() * b).magnitude()) < within_rad


@pytest.mark.parametrize('seed', range(3))
def test_the_world_may_be_turned(seed):
    """However the world is turned, so is what is shown."""
    times_s, times_ns = frames()
    R_world_camera = wandering(times_s, seed)
    R_other_world = Rotation.random(random_state=seed)
    assert_same(smooth(FOLLOW, times_ns, R_other_world * R_world_camera),
                R_other_world * smooth(FOLLOW, times_ns, R_world_camera))


@pytest.mark.parametrize('config', (FOLLOW, YAW_FOLLOW))
def test_time_may_run_backwards(config):
    """A recording played backwards shows the same film, backwards, at any times of frames."""
    times_ns = np.cumsum(np.random.default_rng(1).integers(20, 90, 120)) * 1_000_000
    R_world_camera = wandering(times_ns / 1e9)
    backwards = smooth(config, times_ns[-1] - times_ns[::-1], R_world_camera[::-1])
    assert_same(backwards[::-1], smooth(config, times_ns, R_world_camera), REACH_RAD)


@pytest.mark.parametrize('config', (FOLLOW, YAW_FOLLOW))
@pytest.mark.parametrize('hertz', (0.2, 0.5, 1.))
def test_a_wave_comes_out_without_lag_at_the_expected_gain(config, hertz):
    """That is the square of the live smoother's gain, and no phase."""
    times_s, times_ns = frames(30, 20.)
    phase = 2 * np.pi * hertz * times_s
    R_world_camera = about((0, 1, 0), 0.3 * np.sin(phase))
    shown = smooth(config, times_ns, R_world_camera).as_rotvec()[:, 1]
    inside = (times_s > 5) & (times_s < 15)
    waves = np.stack((np.sin(phase), np.cos(phase)), axis=1)
    in_phase, across = np.linalg.lstsq(waves[inside], shown[inside], rcond=None)[0] / 0.3
    gain = 1 / (1 + (np.pi * hertz * TAU_S) ** 2) ** 2
    assert in_phase == pytest.approx(gain, abs=0.003)
    assert abs(across) < 1e-3


def test_a_steady_turn_passes_unchanged_from_the_first_frame_to_the_last():
    """By any number of whole turns, at any times of frames, at both ends too."""
    times_ns = np.cumsum(np.random.default_rng(2).integers(20, 90, 150)) * 1_000_000
    R_world_camera = Rotation.random(random_state=4) * about((1, 2, 3), 4. * times_ns / 1e9)
    assert_same(smooth(FOLLOW, times_ns, R_world_camera), R_world_camera, REACH_RAD)


def test_a_camera_at_rest_stays_at_rest():
    """For any orientation, and for pauses between frames."""
    times_ns = np.array([0, 33, 66, 9000, 9033, 100_000]) * 1_000_000
    R = Rotation.random(random_state=5)
    assert_same(smooth(FOLLOW, times_ns, Rotation.concatenate([R] * 6)),
                Rotation.concatenate([R] * 6))


def test_a_quick_turn_is_begun_before_and_never_overshot():
    """The picture stays between both ends and goes one way; half of it is done in the middle."""
    times_s, times_ns = frames(30, 8.)
    shown = smooth(FOLLOW, times_ns, about((0, 1, 0), np.deg2rad(170) * (times_s > 3.99)))
    angles_deg = np.rad2deg(rotation_vectors(shown, 0)[:, 1])
    assert np.diff(angles_deg).min() > -1e-6
    assert -1e-6 < angles_deg.min() and angles_deg.max() < 170 + 1e-6
    assert angles_deg[119:121].mean() == pytest.approx(85, abs=0.01)


@pytest.mark.parametrize('seed', range(3))
def test_the_picture_keeps_near_the_camera(seed):
    """By half of the largest angular acceleration times the square of the time constant."""
    times_s, times_ns = frames(50, 8.)
    R_world_camera = about((1, 0, 2), np.sin(1.3 * times_s + seed) + 0.3 * np.sin(4 * times_s))
    steps = (R_world_camera[:-1].inv() * R_world_camera[1:]).as_rotvec() * 50
    largest = np.linalg.norm(np.diff(steps, axis=0) * 50, axis=1).max()
    apart_rad = (R_world_camera.inv() * smooth(FOLLOW, times_ns, R_world_camera)).magnitude()
    assert 0 < apart_rad.max() <= 0.5 * largest * TAU_S ** 2


def test_the_horizon_stays_level_over_the_pole():
    """Yaw_follow turns about the vertical alone, and goes on where there is no heading."""
    times_s, times_ns = frames()
    tipping = about((0, 1, 0), 0.5 * times_s) * about((1, 0, 0), 1.5 * np.sin(times_s))
    shown = smooth(YAW_FOLLOW, times_ns, tipping)
    np.testing.assert_allclose(shown.apply((0, 1, 0)), len(times_s) * [[0, 1, 0]], atol=1e-9)
    assert (shown[:-1].inv() * shown[1:]).magnitude().max() < np.deg2rad(20)


def test_frames_of_one_time_look_alike():
    """A frame whose time does not go on is shown like the one before it."""
    times_s, times_ns = frames(10, 2.)
    times_ns[5] = times_ns[4]
    shown = smooth(FOLLOW, times_ns, wandering(times_s))
    assert_same(shown[4], shown[5])


def test_one_frame_and_none_with_a_heading():
    """What cannot be averaged is shown as it is, or as the world."""
    R = Rotation.from_rotvec([[0.1, 0.2, 0.3]])
    assert_same(smooth(FOLLOW, [5], R), R)
    assert_same(smooth(YAW_FOLLOW, [5], about((1, 0, 0), [np.pi / 2])), Rotation.identity(1))


def test_weights_are_those_of_the_filter_run_both_ways():
    """Positive, of sum 1, of variance τ²."""
    times_s = np.arange(-12, 12, 0.01)
    w = kernel_weights(times_s, TAU_S / 2)
    assert w.min() > -1e-12
    assert w.sum() == pytest.approx(1)
    assert w @ times_s ** 2 == pytest.approx(TAU_S ** 2, rel=1e-3)
