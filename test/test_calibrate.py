# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Lenses of known parameters are found from others that are wrong."""

from dataclasses import replace
from pathlib import Path

import cv2
from dual_fisheye_frames import fisheye_picture, fisheye_pixels
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from sph_stab_ros.calibrate import arguments, main
from sph_stab_ros.calibration.dual_fisheye import calibrate, CalibrationError, for_size
from sph_stab_ros.calibration.file import calibration_text, read_calibration, THETA_S
from sph_stab_ros.config import ConfigError, FisheyeConfig, settings_of
from sph_stab_ros.geometry.fisheye import dual_fisheye
from sph_stab_ros.replay import main as replay
from tiny_recordings import write_bag

ROOT = Path(__file__).resolve().parents[1]
START = FisheyeConfig()
TRUE = replace(
    START,
    front=replace(START.front, center_u_px=321.5, center_v_px=317.9, radius_px=286.5),
    rear=replace(START.rear, center_u_px=957., center_v_px=321., radius_px=282.5,
                 yaw_deg=180.7, pitch_deg=-0.5, roll_deg=-91.2))
PICTURES = 8


def config_in(path):
    """Return the FisheyeConfig of the calibration in a file."""
    return settings_of(read_calibration(path)).config.fisheye


def noisy_sphere(seed):
    """Return a grey sphere (1024, 2048) with texture at scales from a quarter of a degree up."""
    rng = np.random.default_rng(seed)
    grey = np.full((1024, 2048), 128.)
    for sigma_px in (1.5, 4, 10):
        noise = cv2.GaussianBlur(rng.normal(size=grey.shape), (0, 0), sigma_px)
        grey += 25 * noise / noise.std()
    return np.uint8(np.clip(grey, 0, 255))


@pytest.fixture(scope='module')
def greys():
    """
    Return pictures by the lenses of TRUE, with faults.

    The rear lens is darker, there is noise, and things close by, a seventh of the ring, look
    different to the two.
    """
    world, near = noisy_sphere(0), noisy_sphere(1)
    bearings, _ = fisheye_pixels(TRUE)
    hidden = (bearings @ (0.6, 0.8, 0) > 0.9) & (np.arange(TRUE.width) > TRUE.width / 2)
    rng = np.random.default_rng(0)
    found = []
    for R in Rotation.random(PICTURES, random_state=0):
        grey = fisheye_picture(world, TRUE, R).astype(float)
        grey[hidden] = fisheye_picture(near, TRUE, R)[hidden]
        grey[:, TRUE.width // 2:] *= 0.8
        found.append(np.uint8(np.clip(grey + rng.normal(scale=2, size=grey.shape), 0, 255)))
    return found


@pytest.fixture(scope='module')
def calibration(greys):
    """Return the Calibration from the parameters of a usual Theta S."""
    return calibrate(greys, START)


def test_the_lenses_agree_afterwards(calibration):
    assert np.rad2deg(np.median(calibration.before_rad)) > 1
    assert np.rad2deg(np.median(calibration.after_rad)) < 0.05
    assert len(calibration.after_rad) > 500


def test_the_parameters_are_found(calibration):
    """Of the radii only the sum shows; which of them is wrong is not known, and k1 little."""
    found = calibration.config
    for lens in ('front', 'rear'):
        for name, tolerance in (('center_u_px', 0.3), ('center_v_px', 0.3), ('radius_px', 2.5),
                                ('k1', 0.005), ('k2', 0), ('yaw_deg', 0.1), ('pitch_deg', 0.1),
                                ('roll_deg', 0.1)):
            values = [getattr(getattr(one, lens), name) for one in (found, TRUE)]
            assert np.ptp(values) <= tolerance, (lens, name)
    assert (found.front.radius_px + found.rear.radius_px
            == pytest.approx(TRUE.front.radius_px + TRUE.rear.radius_px, abs=0.2))
    assert found == replace(START, front=found.front, rear=found.rear)


def test_the_whole_sphere_is_nearer_to_the_truth(calibration):
    """Also where one lens alone sees it; the camera as a whole may be turned."""
    true, seen = fisheye_pixels(TRUE)

    def errors_deg(config):
        bearings, _ = fisheye_pixels(config)
        a, b = (one[seen][::101] for one in (true, bearings))
        R, _ = Rotation.align_vectors(a, b)
        return np.rad2deg(np.linalg.norm(R.apply(b) - a, axis=1))

    assert np.median(errors_deg(START)) > 0.7
    assert errors_deg(calibration.config).max() < 0.6


def test_what_agrees_already_stays(greys, calibration):
    again = calibrate(greys, calibration.config)
    assert np.rad2deg(np.median(again.before_rad)) < 0.05
    for name, tolerance in (('center_u_px', 0.1), ('yaw_deg', 0.05), ('roll_deg', 0.05)):
        values = [getattr(one.config.rear, name) for one in (calibration, again)]
        assert np.ptp(values) < tolerance, name


def test_the_size_of_the_pictures_does_not_matter():
    larger = for_size(TRUE, (1920, 1080))
    for a, b in zip(dual_fisheye(TRUE, (1920, 1080)).lenses,
                    dual_fisheye(larger, (1920, 1080)).lenses):
        np.testing.assert_allclose(a.center_px, b.center_px)
        assert a.radius_px == pytest.approx(b.radius_px)
    assert for_size(larger, (1280, 720)).rear.center_u_px == pytest.approx(TRUE.rear.center_u_px)


@pytest.mark.parametrize('fault', ('blank', 'one side', 'other lenses', 'no overlap'))
def test_what_cannot_be_calibrated_is_refused(greys, fault):
    config, pictures = START, greys
    if fault == 'blank':
        noise = np.random.default_rng(0).normal(100, 1, size=(PICTURES, *greys[0].shape))
        pictures, reason = list(np.uint8(noise)), 'too little texture'
    elif fault == 'one side':
        # Of the front lens, above the middle.
        pictures, reason = [grey.copy() for grey in greys], 'directions'
        for grey in pictures:
            grey[330:, :640] = 90
    elif fault == 'other lenses':
        config = replace(START, rear=replace(START.rear, roll_deg=90.))
        reason = 'texture|do not agree'
    else:
        config, reason = replace(START, fov_deg=182.), 'overlap'
    with pytest.raises(CalibrationError, match=reason) as error:
        calibrate(pictures, config)
    assert '\n' not in str(error.value)


def test_a_calibration_is_the_same_when_read_again(tmp_path):
    (tmp_path / 'a.yaml').write_text(calibration_text(TRUE, '# About.\n'))
    assert config_in(tmp_path / 'a.yaml') == TRUE
    # The node's own way of reading it, and the shorthand.
    for flag in ('--params-file', '--calibration'):
        _, settings = arguments(['rec', '--out', 'out.yaml', flag, str(tmp_path / 'a.yaml')])
        assert settings.config.fisheye == TRUE
        assert settings.config.projection == 'dual_fisheye'


def test_the_package_has_the_calibration_of_a_theta_s():
    path = ROOT / 'config' / 'theta_s.yaml'
    assert path.read_text() == calibration_text(FisheyeConfig(), THETA_S), (
        'run: python3 -m sph_stab_ros.calibration.file > config/theta_s.yaml')
    assert config_in(path) == FisheyeConfig()
    assert config_in(ROOT / 'config' / 'stabilizer.yaml') == FisheyeConfig()


@pytest.mark.parametrize('text, reason', (
    ('', 'has no parameters'), ('- 1', 'no ros__parameters'), ('{', 'not YAML in line 1'),
    ('/**: {ros__parameters: {flow: dis}}', r'has no parameters fisheye\.\*'),
    ('/**: {ros__parameters: 3}', r'ros__parameters of /\*\* have no names'),
    ('camera: {ros__parameters: {fisheye: {fov_deg: 200}}}', 'no parameters of the stabilizer'),
    ('/**: {ros__parameters: {fisheye: {front: {k9: 1.0}}}}', "no parameter 'fisheye.front.k9'"),
    ('/**: {ros__parameters: {fisheye: {front.k1: wide}}}', 'fisheye.front.k1 is a float'),
    ('/**: {ros__parameters: {fisheye: {front: 1.0}}}', "no parameter 'fisheye.front'"),
    ('/**: {ros__parameters: {fisheye: {fov_deg: 100}}}', 'fisheye.fov_deg must lie within'),
))
def test_a_faulty_file_is_refused_with_the_reason(tmp_path, text, reason):
    (tmp_path / 'a.yaml').write_text(text)
    with pytest.raises(ConfigError, match=reason) as error:
        config_in(tmp_path / 'a.yaml')
    assert str(tmp_path) in str(error.value) and '\n' not in str(error.value)
    with pytest.raises(ConfigError, match='No such file'):
        config_in(tmp_path / 'b.yaml')


@pytest.fixture(scope='module')
def bag(greys, tmp_path_factory):
    """Return a bag of the pictures."""
    return write_bag(tmp_path_factory.mktemp('fisheye') / 'bag', greys)


def test_the_command_writes_what_the_node_and_replay_read(bag, tmp_path, capsys):
    out, trajectory = tmp_path / 'calibration.yaml', tmp_path / 'a.tum'
    assert main([str(bag), '--out', str(out)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert 'before' in lines[1] and 'after' in lines[2]
    found = config_in(out)
    assert found.rear.roll_deg == pytest.approx(TRUE.rear.roll_deg, abs=0.1)
    assert all(f'# {line}' in out.read_text() for line in lines)
    assert replay([str(bag), '--calibration', str(out), '--trajectory', str(trajectory)]) == 0
    assert len(trajectory.read_text().splitlines()) == PICTURES
    # Not a second time.
    assert main([str(bag), '--out', str(out)]) == 1
    assert '--force' in capsys.readouterr().err


def test_recordings_of_something_else_are_refused(bag, turning_bag, tmp_path, capsys):
    out = tmp_path / 'a.yaml'
    assert main([str(turning_bag), '--out', str(out)]) == 1
    assert '256x128' in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
    assert replay([str(bag)]) == 1
    assert 'not 2:1: 8' in capsys.readouterr().err.splitlines()[-1]


@pytest.mark.parametrize('wrong', (
    [], ['--calibration', 'none.yaml'],))
def test_wrong_calls_exit_with_2(bag, wrong, capsys):
    with pytest.raises(SystemExit) as ended:
        main([str(bag), *(['--out', 'a.yaml'] if wrong else []), *wrong])
    assert ended.value.code == 2
    with pytest.raises(SystemExit) as ended:
        replay([str(bag), '--projection', 'equirect', '--calibration', 'none.yaml'])
    assert ended.value.code == 2
    assert all(line.startswith(('calibrate: ', 'replay: '))
               for line in capsys.readouterr().err.splitlines())


def test_photos_agree_after_calibration(shared_data):
    """Real texture: less of it, and larger plain parts."""
    photos = [cv2.resize(cv2.imread(str(shared_data / 'photos' / name),
                                    cv2.IMREAD_REDUCED_GRAYSCALE_2),
                         (2048, 1024), interpolation=cv2.INTER_AREA)
              for name in ('machu-picchu.jpg', 'nitish_360_4096.jpg', 'petra.jpg')]
    rotations = Rotation.random(9, random_state=2)
    greys = [fisheye_picture(photos[i % len(photos)], TRUE, R) for i, R in enumerate(rotations)]
    found = calibrate(greys, START)
    assert np.rad2deg(np.median(found.after_rad)) < 0.05
    assert found.config.rear.roll_deg == pytest.approx(TRUE.rear.roll_deg, abs=0.1)
