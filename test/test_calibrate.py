# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Lenses of known parameters are found from others that are wrong."""

from dataclasses import replace
from itertools import islice
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
from sph_stab_ros.config.parameter_file import read_parameter_files
from sph_stab_ros.geometry.fisheye import dual_fisheye
from sph_stab_ros.recording import open_recording
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
                                ('k1', 0.005), ('k2', 0), ('k4', 1e-4), ('yaw_deg', 0.1),
                                ('pitch_deg', 0.1),
                                ('roll_deg', 0.1)):
            values = [getattr(getattr(one, lens), name) for one in (found, TRUE)]
            assert np.ptp(values) <= tolerance, (lens, name)
    assert (found.front.radius_px + found.rear.radius_px
            == pytest.approx(TRUE.front.radius_px + TRUE.rear.radius_px, abs=0.2))
    assert found == replace(START, front=found.front, rear=found.rear)
    assert {'radius of both', 'rear roll', 'rear centre down'} <= {*calibration.told}
    assert {'difference of the radii', 'k1 of both'} <= {*calibration.untold}


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
    for name, tolerance in (('center_u_px', 0.1), ('yaw_deg', 0.1), ('roll_deg', 0.05),
                            ('k4', 2e-5)):
        values = [getattr(one.config.rear, name) for one in (calibration, again)]
        assert np.ptp(values) < tolerance, name


def test_the_size_of_the_pictures_does_not_matter():
    larger = for_size(TRUE, (1920, 1080))
    for a, b in zip(dual_fisheye(TRUE, (1920, 1080)).lenses,
                    dual_fisheye(larger, (1920, 1080)).lenses):
        np.testing.assert_allclose(a.center_px, b.center_px)
        assert a.radius_px == pytest.approx(b.radius_px)
    assert for_size(larger, (1280, 720)).rear.center_u_px == pytest.approx(TRUE.rear.center_u_px)


@pytest.mark.parametrize('fault', ('blank', 'other lenses', 'no overlap'))
def test_what_cannot_be_calibrated_is_refused(greys, fault):
    config, pictures = START, greys
    if fault == 'blank':
        noise = np.random.default_rng(0).normal(100, 1, size=(PICTURES, *greys[0].shape))
        pictures, reason = list(np.uint8(noise)), 'too little texture'
    elif fault == 'other lenses':
        config = replace(START, rear=replace(START.rear, roll_deg=90.))
        reason = 'texture|do not agree'
    else:
        config, reason = replace(START, fov_deg=182.), 'overlap'
    with pytest.raises(CalibrationError, match=reason) as error:
        calibrate(pictures, config)
    assert '\n' not in str(error.value)


def disagreements_deg(config):
    """Return by how much lenses of a config disagree about what those of TRUE see, all around."""
    around, off = np.meshgrid(np.arange(0, 2 * np.pi, 0.05), np.deg2rad((-3, 0, 3)))
    x = np.stack((np.cos(off) * np.cos(around), np.cos(off) * np.sin(around), np.sin(off)), -1)
    true, lenses = (dual_fisheye(one, (TRUE.width, TRUE.height)).lenses for one in (TRUE, config))
    seen = [lens.bearings(np.stack(by.pixels(x)[:2], axis=-1)) for lens, by in zip(lenses, true)]
    return np.rad2deg(np.linalg.norm(seen[0] - seen[1], axis=-1))


def seen_upright():
    """Return pictures of a camera that turns about its upright axis: sky above, a body below."""
    world = noisy_sphere(0)
    world[:400], world[620:] = 200, 60
    return [fisheye_picture(world, TRUE, Rotation.from_euler('Y', 29. * n, degrees=True))
            for n in range(12)]


def seen_on_one_side(greys):
    """Return pictures whose front circle is plain below the middle."""
    pictures = [grey.copy() for grey in greys]
    for grey in pictures:
        grey[330:, :640] = 90
    return pictures


@pytest.mark.parametrize('shown, untold', (
    ('half', ()), ('upright', ('rear yaw',))), ids=('half', 'upright'))
def test_what_shows_little_is_calibrated_as_far_as_it_tells(greys, shown, untold):
    """Where nothing is seen too, the lenses agree much better than before, or it says so."""
    pictures = seen_on_one_side(greys) if shown == 'half' else seen_upright()
    found = calibrate(pictures, START)
    assert {'radius of both', 'rear roll'} <= {*found.told}
    assert {*untold, 'difference of the radii'} <= {*found.untold}
    before_deg, after_deg = map(disagreements_deg, (START, found.config))
    assert np.median(before_deg) > 1
    assert after_deg.max() < 0.2


def test_what_half_of_the_pictures_tell_the_others_tell_too(greys):
    halves = [calibrate(half, START) for half in (greys[::2], greys[1::2])]
    for name, tolerance in (('center_u_px', 0.5), ('yaw_deg', 0.2), ('roll_deg', 0.02)):
        assert np.ptp([getattr(half.config.rear, name) for half in halves]) < tolerance


def test_other_lenses_are_calibrated_by_their_model():
    true, start = (replace(one, model='equisolid') for one in (TRUE, START))
    world = noisy_sphere(0)
    greys = [fisheye_picture(world, true, R) for R in Rotation.random(5, random_state=0)]
    found = calibrate(greys, start)
    assert np.rad2deg(np.median(found.after_rad)) < 0.05
    assert found.config.rear.roll_deg == pytest.approx(TRUE.rear.roll_deg, abs=0.1)


def test_stretched_pictures_have_stretched_circles():
    config = replace(TRUE, stretched=True)
    found = for_size(config, (1280, 640))
    for a, b in zip(dual_fisheye(config, (1280, 640)).lenses,
                    dual_fisheye(found, (1280, 640)).lenses):
        np.testing.assert_allclose(a.center_px, b.center_px)
        assert (a.radius_px, a.aspect) == pytest.approx((b.radius_px, b.aspect))


def test_a_real_camera_is_calibrated(shared_data):
    """
    A Gear 360 on a road, whose config is degrees off: sky above, bodywork below.

    One half of its pictures tells what the other does.
    """
    recording = open_recording(shared_data / 'gear360_road' / 'fallback.mp4')
    start = settings_of(read_parameter_files([ROOT / 'config' / 'gear360.yaml'])).config.fisheye
    greys = [frame.grey() for frame in islice(recording.frames(), 0, None, 8)]
    start = for_size(replace(start, front=replace(start.front, radius_px=296., k4=0.),
                             rear=replace(start.rear, radius_px=296., k4=0.)), (1280, 720))
    middle = len(greys) // 2
    halves = [calibrate(half, start) for half in (greys[:middle], greys[middle:])]
    for half in halves:
        assert np.rad2deg(np.median(half.before_rad)) > 3
        assert np.rad2deg(np.median(half.after_rad)) < 0.3
        assert {'radius of both', 'rear roll', 'k4 of both'} <= {*half.told}
        assert 'k1 of both' in half.untold
    for lens in ('front', 'rear'):
        for name, tolerance in (('radius_px', 1.5), ('center_v_px', 1.5), ('center_u_px', 3),
                                ('k4', 2e-4), ('roll_deg', 0.1), ('pitch_deg', 0.5)):
            values = [getattr(getattr(half.config, lens), name) for half in halves]
            assert np.ptp(values) < tolerance, (lens, name)


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
    assert lines[3].startswith('told: radius of both') and lines[4].startswith('not told')
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
