# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""A video is levelled by what its camera measured, and dark pictures are bridged by its gyro."""

import numpy as np
import pytest
from sph_stab_ros.geometry.conventions import NS_PER_S
from sph_stab_ros.geometry.trajectory import read_tum
from sph_stab_ros.geometry.warp import rotate_equirect
from sph_stab_ros.replay import main
from telemetry_files import body_forces, body_rates, camm, gopro, insta360, orientation, with_track
from tiny_recordings import textured_sphere, write_video

UP = 0., -1., 0.
TIMES_S = np.arange(0, 7, 1 / 15)
# Longer than prediction is trusted without a gyro.
DARK = range(60, 90)


@pytest.fixture(scope='module')
def pictures():
    sphere = textured_sphere(256)
    return [rotate_equirect(sphere, R) * np.uint8(number not in DARK)
            for number, R in enumerate(orientation(TIMES_S))]


def trailed(path, trailer):
    path.write_bytes(path.read_bytes() + trailer)
    return path


@pytest.mark.parametrize('write', [
    lambda path, *of: with_track(path, b'gpmd', gopro(*of), 1000),
    lambda path, *of: with_track(path, b'camm', camm(*of)),
    lambda path, *of: trailed(path, insta360(*of))], ids=['GoPro', 'CAMM', 'Insta360'])
def test_the_cameras_own_sensors_level_and_bridge_the_dark(write, pictures, tmp_path, capsys):
    t = np.arange(0, 7.2, 1 / 200)
    video = write(write_video(tmp_path / 'ride.mp4', pictures, np.round(TIMES_S * NS_PER_S)),
                  t, body_rates(t), body_forces(t))
    trajectory = tmp_path / 'out.tum'
    assert main([str(video), '--trajectory', str(trajectory), '-p', 'level:=imu']) == 0
    assert ' of telemetry, 0 left out' in capsys.readouterr().out
    # Nothing is measured before the first picture: the level is approached from there on.
    found, true = read_tum(trajectory).rotations[DARK[0] - 1:], orientation(TIMES_S)[DARK[0] - 1:]
    tilts_rad = np.arccos(np.clip(np.sum(
        found.inv().apply(UP) * true.inv().apply(UP), axis=1), -1, 1))
    assert np.rad2deg(tilts_rad).max() < 1
    turns = found[0].inv() * found, true[0].inv() * true
    assert np.rad2deg((turns[0].inv() * turns[1]).magnitude()).max() < 1
