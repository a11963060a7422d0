# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What the evaluator says of estimates whose errors are known."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sph_stab_ros.evaluation.alignment import (
    align_trajectories, Alignment, EvaluationError, has_truth)
from sph_stab_ros.evaluation.orientation_errors import compare
from sph_stab_ros.evaluation.runs import increasing
from sph_stab_ros.geometry.conventions import NS_PER_S, R_BODY_CAMERA
from sph_stab_ros.geometry.trajectory import Trajectory

START_NS = 1_700_000_000_123_456_789
SECONDS = 20.
MOUNT = Rotation.from_euler('ZYX', (70., -25., 160.), degrees=True)
R_MOCAP_WORLD = Rotation.from_rotvec((0.7, -1.1, 2.0))


def stamps(rate_hz, start_s=0., seconds=SECONDS):
    return START_NS + np.round(
        (start_s + np.arange(0, seconds, 1 / rate_hz)) * NS_PER_S).astype(np.int64)


def flight(stamps_ns, axes=(25, 15, 60)):
    """Return R_world_camera of a smooth motion, up to ``axes`` degrees about x, z, y."""
    t = (stamps_ns - START_NS) / NS_PER_S
    angles = [np.sin(1.9 * t) + 0.3 * np.sin(4.1 * t + 1),
              np.sin(1.3 * t + 2) + 0.2 * np.sin(5 * t),
              np.sin(0.6 * t) + 0.2 * np.sin(2.6 * t)]
    return Rotation.from_euler('XZY', (np.array(angles) * np.array(axes)[:, None]).T, degrees=True)


def estimated(rate_hz=30, **motion):
    stamps_ns = stamps(rate_hz)
    return Trajectory(stamps_ns, flight(stamps_ns, **motion))


def true(rate_hz=100, mount=MOUNT, clock_offset_s=0., **motion):
    """Return what motion capture would say of the same flight, from before it to after it."""
    stamps_ns = stamps(rate_hz, -2.003, SECONDS + 4)
    R_mocap_body = R_MOCAP_WORLD * flight(stamps_ns, **motion) * mount.inv()
    return Trajectory(stamps_ns + round(clock_offset_s * NS_PER_S), R_mocap_body)


def evaluated(truth, estimate, **known):
    return compare(truth, estimate, align_trajectories(
        truth, estimate, **{'clock_offset_ns': 0, **known}))


@pytest.mark.parametrize('rate_hz', [50, 100, 333])
@pytest.mark.parametrize('seed', range(3))
def test_perfect_estimate_has_no_error(rate_hz, seed):
    mount = Rotation.random(random_state=seed)
    truth, estimate = true(rate_hz, mount), estimated()
    found = align_trajectories(truth, estimate, clock_offset_ns=0)
    errors = compare(truth, estimate, found)
    assert found.mount_solved
    assert np.rad2deg((found.R_body_camera.inv() * mount).magnitude()) < 0.01
    assert errors.geodesic_deg.max() < 0.02
    assert errors.absolute_rpy_deg.max() < 0.02
    assert len(errors.time_s) == len(estimate)


@pytest.mark.parametrize('offset_s', [0., 0.4, -1.2345, 3e8 + 0.0377])
@pytest.mark.parametrize('rate_hz', [15, 30])
def test_clock_offset_is_found(offset_s, rate_hz):
    truth, estimate = true(clock_offset_s=offset_s), estimated(rate_hz)
    found = align_trajectories(truth, estimate)
    assert abs(found.clock_offset_ns / NS_PER_S - offset_s) < 2e-4
    assert compare(truth, estimate, found).geodesic_deg.max() < 0.02


def test_clock_offset_is_found_from_a_noisy_estimate():
    rng = np.random.default_rng(0)
    estimate = estimated(15)
    noise = Rotation.from_rotvec(np.deg2rad(rng.normal(0, 0.1, (len(estimate), 3))).cumsum(axis=0))
    estimate = Trajectory(estimate.stamps_ns, noise * estimate.rotations)
    found = align_trajectories(true(clock_offset_s=0.4), estimate)
    assert abs(found.clock_offset_ns / NS_PER_S - 0.4) < 1e-3


@pytest.mark.parametrize('phase', [0, 3])
def test_a_vibration_does_not_mislead_the_clock(phase):
    """A ground robot turns slowly and vibrates at half the frame rate."""
    def vibrating(stamps_ns):
        t = (stamps_ns - START_NS) / NS_PER_S
        roll, pitch = (0.4 * np.sin(2 * np.pi * hz * t + phase) for hz in (7.1, 6.7))
        return Rotation.from_euler(
            'YXZ', np.transpose((20 * np.sin(0.5 * t + phase), pitch, roll)), degrees=True)
    rng = np.random.default_rng(phase)
    taken_ns, true_ns = stamps(15), stamps(100, -1.003, SECONDS + 2)
    noise = Rotation.from_rotvec(np.deg2rad(rng.normal(0, 0.02, (len(taken_ns), 3))))
    found = align_trajectories(Trajectory(true_ns + 4 * 10**8, vibrating(true_ns) * MOUNT.inv()),
                               Trajectory(taken_ns, vibrating(taken_ns) * noise))
    assert abs(found.clock_offset_ns / NS_PER_S - 0.4) < 1e-3


def test_mount_does_not_follow_moments_of_lost_tracking():
    estimate = estimated()
    kicks = Rotation.from_rotvec(np.where(
        np.arange(len(estimate))[:, None] >= 300, (0.5, 0.3, 0.), 0.))
    estimate = Trajectory(estimate.stamps_ns, kicks * estimate.rotations)
    found = align_trajectories(true(), estimate, clock_offset_ns=0)
    assert np.rad2deg((found.R_body_camera.inv() * MOUNT).magnitude()) < 0.01


@pytest.mark.parametrize('spoil', [
    lambda R: R.inv(),
    lambda R: Rotation.from_rotvec(R.as_rotvec() * (1, 1, -1)),
    lambda R: Rotation.from_rotvec(R.as_rotvec()[:, [1, 0, 2]]),
], ids=['inverted', 'one axis reversed', 'two axes swapped'])
def test_wrong_convention_is_not_hidden_by_the_mount(spoil):
    estimate = estimated()
    estimate = Trajectory(estimate.stamps_ns, spoil(estimate.rotations))
    assert evaluated(true(), estimate).geodesic_deg.mean() > 10


def test_motion_about_one_axis_leaves_the_mount_as_configured():
    planar = {'axes': (0.2, 0.2, 60)}
    truth, estimate = true(**planar), estimated(**planar)
    found = align_trajectories(truth, estimate, clock_offset_ns=0)
    assert not found.mount_solved
    assert (found.R_body_camera * R_BODY_CAMERA.inv()).magnitude() == pytest.approx(0)


def test_motion_about_one_axis_is_right_with_the_right_mount():
    planar = {'axes': (0.2, 0.2, 60)}
    truth, estimate = true(mount=MOUNT, clock_offset_s=0.4, **planar), estimated(**planar)
    found = align_trajectories(truth, estimate, MOUNT)
    assert abs(found.clock_offset_ns / NS_PER_S - 0.4) < 1e-3
    assert compare(truth, estimate, found).geodesic_deg.max() < 0.02
    inverted = Trajectory(estimate.stamps_ns, estimate.rotations.inv())
    assert compare(truth, inverted, found).geodesic_deg.mean() > 10


def test_known_drift_is_scored():
    """Three degrees per minute about the world's vertical, the camera's y at the start."""
    estimate = estimated()
    seconds = (estimate.stamps_ns - START_NS) / NS_PER_S
    drift = Rotation.from_rotvec(np.deg2rad(3. / 60 * seconds)[:, None] * (0, 1, 0))
    R_first = estimate.rotations[0]
    estimate = Trajectory(estimate.stamps_ns,
                          R_first * drift * R_first.inv() * estimate.rotations)
    errors = compare(true(), estimate, Alignment(MOUNT))
    figures = errors.summary()
    assert figures['drift_deg_per_min'] == pytest.approx(3., abs=0.01)
    assert figures['geodesic_deg']['end'] == pytest.approx(1., abs=0.01)
    assert figures['geodesic_deg']['mean'] == pytest.approx(0.5, abs=0.01)
    assert figures['per_frame_deg']['median'] == pytest.approx(3. / 60 / 30, abs=1e-3)


def test_errors_over_time_are_those_of_the_nearest_frames():
    stamps_ns = stamps(30)
    seconds = (stamps_ns - START_NS) / NS_PER_S
    drift = Trajectory(stamps_ns, Rotation.from_rotvec(
        np.deg2rad(seconds)[:, None] * (0, 1, 0)))
    still = Trajectory(stamps_ns, Rotation.from_rotvec(np.zeros((len(drift), 3))))
    told = compare(still, drift, Alignment(Rotation.identity())).over_time(4.99)
    # A whole last period counts though its end is where the next frame would be.
    assert told['time_s'] == pytest.approx([4.99, 9.98, 14.97, 19.96], abs=1 / 60)
    assert told['geodesic_deg'] == pytest.approx(told['time_s'], abs=1e-6)
    assert compare(still, drift, Alignment(Rotation.identity())).over_time(
        20)['time_s'] == pytest.approx([20 - 1 / 30])
    assert compare(still, drift, Alignment(Rotation.identity())).over_time(21)['time_s'] == []


@pytest.mark.parametrize('axis, optical', [('roll', (0, 0, 1)), ('pitch', (-1, 0, 0)),
                                           ('yaw', (0, -1, 0))])
def test_axes_are_those_of_the_camera_body(axis, optical):
    """A step of two degrees about one axis is an error of that axis alone."""
    step = np.where(np.arange(600) < 300, 0., np.deg2rad(2.))[:, None] * optical
    figures = compare(true(axes=(0, 0, 0)), Trajectory(stamps(30), Rotation.from_rotvec(step)),
                      Alignment(MOUNT)).summary()
    expected = {'roll': 0., 'pitch': 0., 'yaw': 0.} | {axis: 1.}
    assert figures['mean_abs_error_deg'] == pytest.approx(expected, abs=1e-6)
    assert figures['per_frame_deg']['max'] == pytest.approx(2.)
    assert figures['per_frame_deg']['p95'] == pytest.approx(0., abs=1e-6)


def test_full_turns_are_no_error():
    stamps_ns = stamps(30)
    turn = Rotation.from_rotvec(np.linspace(0, 4 * np.pi, len(stamps_ns))[:, None] * (0, -1, 0))
    estimate = Trajectory(stamps_ns, turn)
    errors = compare(estimate, estimate, Alignment(Rotation.identity()))
    assert errors.absolute_rpy_deg.max() < 1e-6
    assert errors.estimate_rpy_deg[-1, 2] == pytest.approx(720.)


def test_frames_in_gaps_of_the_truth_are_not_evaluated():
    truth, estimate = true(), estimated()
    t = (truth.stamps_ns - START_NS) / NS_PER_S
    kept = (t < 5) | (t > 7)
    gappy = Trajectory(truth.stamps_ns[kept], truth.rotations[kept])
    errors = evaluated(gappy, estimate)
    assert len(errors.time_s) == pytest.approx(len(estimate) - 60, abs=2)
    assert not np.any((errors.time_s > 5.05) & (errors.time_s < 6.95))
    assert errors.geodesic_deg.max() < 0.02
    assert len(errors.per_frame_deg) == len(errors.time_s) - 2


def test_truth_is_known_on_its_samples_and_over_short_pauses():
    truth = Trajectory(np.array((0, 10, 20, 500, 510)) * 10**6, Rotation.from_rotvec(
        np.zeros((5, 3))))
    asked_ms = np.array((-1, 0, 15, 20, 21, 499, 500, 510, 511))
    assert has_truth(truth, asked_ms * 10**6).tolist() == [
        False, True, True, True, False, False, True, True, False]


@pytest.mark.parametrize('shift_s, said', [
    (1e6, 'do not overlap'), (SECONDS + 1.8, 'frames have')])
def test_too_little_overlap_is_refused(shift_s, said):
    truth, estimate = true(clock_offset_s=shift_s), estimated()
    with pytest.raises(EvaluationError, match=said):
        align_trajectories(truth, estimate, clock_offset_ns=0)


def test_unrelated_truth_gives_no_clock_offset():
    rng = np.random.default_rng(1)
    walk = Rotation.from_rotvec(rng.normal(0, 0.02, (2000, 3)).cumsum(axis=0))
    with pytest.raises(EvaluationError, match='clock offset'):
        align_trajectories(Trajectory(stamps(100), walk), estimated())


def test_orientations_whose_stamps_go_back_are_left_out():
    trajectory = increasing([5, 7, 6, 7, 9], Rotation.from_rotvec(np.arange(15).reshape(5, 3)))
    assert trajectory.stamps_ns.tolist() == [5, 7, 9]
