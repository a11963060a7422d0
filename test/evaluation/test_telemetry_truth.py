# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""A gyro as truth: its bias, its clock and its mount are found, and errors are the estimate's."""

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from sph_stab_ros.evaluate import main
from sph_stab_ros.evaluation.orientation_errors import compare
from sph_stab_ros.evaluation.telemetry_truth import align_gyro, integrated, without_bias
from sph_stab_ros.geometry.conventions import NS_PER_S, R_BODY_CAMERA
from sph_stab_ros.geometry.trajectory import Trajectory
from sph_stab_ros.geometry.warp import rotate_equirect
from telemetry_files import (
    body_forces, body_rates, camm, gopro, orientation, with_track)
from tiny_recordings import textured_sphere, write_video

BIAS_RAD_S = np.deg2rad((0.4, -0.7, 0.3))
MOUNT = Rotation.from_euler('ZYX', (70., -25., 160.), degrees=True)


def stamps(rate_hz, start_s, seconds):
    return np.round((start_s + np.arange(0, seconds, 1 / rate_hz)) * NS_PER_S).astype(np.int64)


def estimated(seconds=20.):
    stamps_ns = stamps(30, 0, seconds)
    return Trajectory(stamps_ns, orientation(stamps_ns / NS_PER_S))


def measured(offset_s=0., bias_rad_s=BIAS_RAD_S, mount=Rotation.identity(), rate_hz=200):
    """Return stamps and rates of a gyro that is turned by ``mount``, by a clock ahead."""
    stamps_ns = stamps(rate_hz, -1, 22)
    rates = mount.apply(body_rates(stamps_ns / NS_PER_S)) + bias_rad_s
    return stamps_ns + round(offset_s * NS_PER_S), rates


def test_integrated_rates_are_the_turns():
    stamps_ns, rates = measured(bias_rad_s=np.zeros(3))
    found = integrated(stamps_ns, rates).relative_to_first().rotations
    camera = orientation(stamps_ns / NS_PER_S)
    true = R_BODY_CAMERA * (camera[0].inv() * camera) * R_BODY_CAMERA.inv()
    assert np.rad2deg((true.inv() * found).magnitude()).max() < 0.01


def test_a_bias_taken_out_is_as_if_it_had_not_been():
    stamps_ns, rates = measured()
    found = without_bias(integrated(stamps_ns, rates), BIAS_RAD_S).rotations
    true = integrated(stamps_ns, rates - BIAS_RAD_S).rotations
    assert np.rad2deg((true.inv() * found).magnitude()).max() < 1e-6


@pytest.mark.parametrize('offset_s', [0., 0.31, -0.0123])
@pytest.mark.parametrize('seed', [0, 1])
def test_mount_clock_and_bias_are_found_together(offset_s, seed):
    mount = Rotation.random(random_state=seed)
    found = align_gyro(integrated(*measured(offset_s, mount=mount)), estimated())
    assert found.mount_solved
    assert np.rad2deg(((mount * R_BODY_CAMERA).inv() * found.R_body_camera).magnitude()) < 0.02
    assert abs(found.clock_offset_ns / NS_PER_S - offset_s) < 2e-4
    assert np.rad2deg(np.abs(found.gyro_bias_rad_s - BIAS_RAD_S)).max() < 0.005


def test_errors_are_those_of_the_estimate():
    """An estimate that trembles by a known angle; its constant drift alone is not seen."""
    rng = np.random.default_rng(0)
    estimate = estimated()
    tremble = Rotation.from_rotvec(np.deg2rad(rng.normal(0, 0.1, (len(estimate), 3))))
    estimate = Trajectory(estimate.stamps_ns, estimate.rotations * tremble)
    truth = integrated(*measured())
    found = align_gyro(truth, estimate)
    errors = compare(without_bias(truth, found.gyro_bias_rad_s), estimate, found)
    # Of the difference of two, in three axes.
    expected_deg = np.median(np.linalg.norm(rng.normal(0, 0.1 * np.sqrt(2), (10**5, 3)), axis=1))
    assert np.median(errors.per_frame_deg) == pytest.approx(expected_deg, rel=0.1)
    assert np.median(errors.per_second_deg) == pytest.approx(expected_deg, rel=0.1)


@pytest.fixture(scope='module')
def frames():
    t = np.arange(0, 5, 1 / 15)
    sphere = textured_sphere(256)
    return t, [rotate_equirect(sphere, R) for R in orientation(t)]


def figures_of(path, tmp_path, *arguments):
    file = tmp_path / 'figures.json'
    assert main([str(path), '--estimators', 'anchored', '--json', str(file), *arguments]) == 0
    return json.loads(file.read_text())


def test_a_video_with_a_gyro_is_evaluated_by_itself(frames, tmp_path, capsys):
    times_s, pictures = frames
    video = write_video(tmp_path / 'ride.mp4', pictures, np.round(times_s * NS_PER_S))
    # A sensor that is 25 ms late.
    t = np.arange(0, 5.2, 1 / 200)
    late = body_rates(t - 0.025) + BIAS_RAD_S
    with_track(video, b'gpmd', gopro(t, late, body_forces(t - 0.025)), 1000)
    said = figures_of(video, tmp_path, '--truth', 'telemetry')
    assert said['truth'] == 'telemetry' and said['mount']['source'] == 'solved'
    assert abs(said['clock_offset_s'] - 0.025) < 0.003
    assert np.abs([said['mount'][key] for key in ('yaw_deg', 'pitch_deg', 'roll_deg')]).max() < 0.5
    assert np.abs(said['gyro_bias_deg_s'] - np.rad2deg(BIAS_RAD_S)).max() < 0.1
    assert said['estimators']['anchored']['per_second_deg']['median'] < 0.3
    printed = capsys.readouterr().out
    assert 'the truth is a gyro' in printed and 'geodesic' not in printed


def test_orientations_of_camm_are_truth_as_any_other(frames, tmp_path, capsys):
    times_s, pictures = frames
    video = write_video(tmp_path / 'ride.mp4', pictures, np.round(times_s * NS_PER_S))
    t = np.arange(0, 5.2, 1 / 50)
    with_track(video, b'camm', camm(t, R_world_camera=orientation(t)))
    said = figures_of(video, tmp_path, '--truth', 'telemetry', '--clock-offset', '0')
    assert said['truth'] == 'telemetry' and 'gyro_bias_deg_s' not in said
    assert said['estimators']['anchored']['geodesic_deg']['mean'] < 0.5
    assert 'geodesic' in capsys.readouterr().out


def test_a_gyro_is_truth_where_it_is_asked_for(frames, tmp_path, capsys):
    video = write_video(tmp_path / 'ride.mp4', frames[1][:3])
    with_track(video, b'gpmd', gopro(*(of(np.arange(9.)) for of in (
        np.array, body_rates, body_forces))), 1000)
    assert main([str(video), '--estimators', 'anchored']) == 1
    line, = capsys.readouterr().err.splitlines()
    assert 'as truth would do: telemetry' in line


def test_a_video_without_telemetry_says_so(frames, tmp_path, capsys):
    video = write_video(tmp_path / 'ride.mp4', frames[1][:3])
    assert main([str(video), '--estimators', 'anchored', '--truth', 'telemetry']) == 1
    line, = capsys.readouterr().err.splitlines()
    assert 'has no topic telemetry' in line and '--inject' in line
