# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Recordings of two fisheye circles, offline: stitched for what needs spheres, or as they are."""

import json

from dual_fisheye_frames import fisheye_picture
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from sph_stab_ros.calibration.file import calibration_text
from sph_stab_ros.config import DUAL_FISHEYE, FisheyeConfig, LensConfig, StabilizerConfig
from sph_stab_ros.evaluate import main as evaluate
from sph_stab_ros.evaluation.stitched import Stitched
from sph_stab_ros.recording import open_recording
from sph_stab_ros.recording.bag_writer import BagWriter
from sph_stab_ros.replay import main as replay
from synthetic import textured_sphere
from tiny_recordings import stamps_of

SMALL = FisheyeConfig(
    width=640, height=320, front=LensConfig(160.2, 158.1, 140.),
    rear=LensConfig(478.9, 161.4, 143., yaw_deg=179., pitch_deg=1., roll_deg=-92.))
COUNT = 16


@pytest.fixture(scope='module')
def turns():
    """Return R_world_camera of the recording."""
    t = np.linspace(0, 1, COUNT)
    angles_deg = np.stack((40 * t, 15 * np.sin(6 * t), -10 * t ** 2), axis=-1)
    return Rotation.from_euler('YXZ', angles_deg, degrees=True)


@pytest.fixture(scope='module')
def bag(turns, tmp_path_factory):
    """Return a bag of pictures with their truth; the second picture is of another size."""
    world = textured_sphere(1280)
    path = tmp_path_factory.mktemp('circles') / 'bag'
    with BagWriter(path) as writer:
        for number, (stamp_ns, R) in enumerate(zip(map(int, stamps_of(COUNT)), turns)):
            picture = fisheye_picture(world, SMALL, R)
            writer.write_orientation('/truth', stamp_ns, 'world', R)
            writer.write_jpeg('/image/compressed', stamp_ns, 'camera',
                              picture[:-20] if number == 1 else picture)
    return path


@pytest.fixture(scope='module')
def calibration(tmp_path_factory):
    """Return the file with the calibration."""
    path = tmp_path_factory.mktemp('circles') / 'small.yaml'
    path.write_text(calibration_text(SMALL, '# Small.\n'))
    return path


def test_frames_come_as_spheres(bag, turns):
    """What does not fit is left out and counted, each time anew."""
    recording = Stitched(open_recording(bag), StabilizerConfig(
        projection=DUAL_FISHEYE, fisheye=SMALL))
    for _ in range(2):
        frames = list(recording.frames())
        assert [frame.image.shape for frame in frames] == (COUNT - 1) * [(284, 568)]
        assert recording.skipped == {'not as calibrated': 1}
    expected = textured_sphere(568, turns[-1])
    assert np.abs(frames[-1].image.astype(float) - expected).mean() < 3


def test_spheres_stay_as_they_are(turning_bag):
    plain = open_recording(turning_bag)
    for frame, stitched in zip(plain.frames(), Stitched(plain, StabilizerConfig()).frames(),
                               strict=True):
        assert np.array_equal(frame.image, stitched.image)


def test_orientations_are_those_of_the_camera(bag, calibration, tmp_path, capsys):
    out, every = tmp_path / 'a.json', ['--estimators', 'anchored,pts', '--json']
    assert evaluate([str(bag), '--calibration', str(calibration), *every, str(out)]) == 0
    for figures in json.loads(out.read_text())['estimators'].values():
        assert figures['frames'] == COUNT - 1 and figures['lost_frames'] == 0
        assert figures['geodesic_deg']['max'] < 0.5
    assert evaluate([str(bag), '--calibration', str(calibration), '--inject', '1',
                     *every, str(out)]) == 0
    assert json.loads(out.read_text())['estimators']['anchored']['geodesic_deg']['mean'] < 0.5


def test_a_part_of_the_sphere_is_not_turned_as_if_it_were_all(turning_bag, tmp_path, capsys):
    half = ('--projection', 'cropped_equirect', '-p', 'crop.height:=0.5')
    assert evaluate([str(turning_bag), *half, '--inject', '1']) == 1
    assert '--inject needs pictures of the whole sphere' in capsys.readouterr().err


def test_a_replay_writes_spheres_and_views(bag, calibration, tmp_path, capsys):
    assert replay([str(bag), str(tmp_path / 'out'), '--calibration', str(calibration)]) == 0
    assert '1x not as calibrated' in capsys.readouterr().out
    sphere, *_ = open_recording(tmp_path / 'out', 'stabilized/image/compressed').frames()
    assert sphere.image.shape[:2] == (284, 568)
    pytest.importorskip('av')
    assert replay([str(bag), str(tmp_path / 'a.mp4'), '--calibration', str(calibration),
                   '--side-by-side']) == 0
    first, *_ = open_recording(tmp_path / 'a.mp4').frames()
    assert first.image.shape == (2 * 284, 4 * 284, 3)
