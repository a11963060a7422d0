# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Calibrations of lenses by others: as ROS and Kalibr write them, against OpenCV's own model."""

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from sph_stab_ros.calibration.file import read_calibration
from sph_stab_ros.config import (
    DUAL_FISHEYE, EQUISOLID, FISHEYE, FisheyeConfig, LensConfig, StabilizerConfig)
from sph_stab_ros.geometry.lens_model import lens_of
from sph_stab_ros.geometry.projection_factory import check_projection, projection_of
from sph_stab_ros.replay import arguments
from synthetic import unit

K = np.array([[285.1, 0., 421.3], [0., 286.6, 400.9], [0., 0., 1.]])
D = np.array([-0.0105, 0.0435, -0.0411, 0.0078])
CAMERA_INFO = """\
image_width: 848
image_height: 800
camera_name: fisheye1
camera_matrix:
  rows: 3
  cols: 3
  data: [285.1, 0, 421.3, 0, 286.6, 400.9, 0, 0, 1]
distortion_model: equidistant
distortion_coefficients:
  rows: 1
  cols: 4
  data: [-0.0105, 0.0435, -0.0411, 0.0078]
rectification_matrix:
  rows: 3
  cols: 3
  data: [1, 0, 0, 0, 1, 0, 0, 0, 1]
projection_matrix:
  rows: 3
  cols: 4
  data: [285.1, 0, 421.3, 0, 0, 286.6, 400.9, 0, 0, 0, 1, 0]
"""
CAM = """\
  cam_overlaps: [1]
  camera_model: pinhole
  distortion_coeffs: [-0.0105, 0.0435, -0.0411, 0.0078]
  distortion_model: equidistant
  intrinsics: [285.1, 286.6, 421.3, 400.9]
  resolution: [848, 800]
  rostopic: /cam0/image_raw
"""
# The second one looks back, a little to its left, and is rolled.
R_CAM1_CAM0 = Rotation.from_euler('YXZ', (176, 2, -3), degrees=True)
ROWS = np.column_stack((R_CAM1_CAM0.as_matrix(), (0.01, 0., -0.02))).tolist()
T_CN_CNM1 = '  T_cn_cnm1:\n' + ''.join(f'  - {row}\n' for row in (*ROWS, [0.0, 0.0, 0.0, 1.0]))
CAMCHAIN = f'cam0:\n{CAM}cam1:\n{T_CN_CNM1}{CAM}'


@pytest.fixture
def written(tmp_path):
    """Return a function that writes a text into a file and returns its path."""
    def write(text):
        path = tmp_path / 'lens.yaml'
        path.write_text(text)
        return path
    return write


def opencv_pixels(xyz):
    """Return where OpenCV's fisheye model has bearings (N, 3) in front of the camera."""
    return cv2.fisheye.projectPoints(xyz[None], np.zeros(3), np.zeros(3), K, D)[0][0]


def bearings(max_angle_deg, count=300):
    """Return vectors (N, 3) that are not too far off the axis z."""
    x = unit(np.random.default_rng(0).normal(size=(20 * count, 3)))
    return x[x[:, 2] > np.cos(np.deg2rad(max_angle_deg))][:count]


def located(projection, xyz):
    """Return the pixels (N, 2) of bearings (N, 3), all of which are seen."""
    u, v, face = projection.pixels(*np.moveaxis(xyz[None], -1, 0))
    assert face.max() <= 1
    return np.stack((u[0], v[0]), axis=-1)


@pytest.mark.parametrize('text', (CAMERA_INFO, f'cam0:\n{CAM}'), ids=('ros', 'kalibr'))
def test_a_lens_is_opencvs(written, text):
    config = StabilizerConfig(
        projection=FISHEYE, fisheye=FisheyeConfig(fov_deg=180., file=str(written(text))))
    check_projection(config)
    x = bearings(85)
    for scale in (1, 2):
        projection = projection_of((848 * scale, 800 * scale), config)
        np.testing.assert_allclose(
            located(projection, x), (opencv_pixels(x) + 0.5) * scale - 0.5, atol=1e-3)


@pytest.mark.parametrize('size_wh, second', [((1696, 800), (848, 0)), ((848, 1600), (0, 800))])
def test_two_lenses_lie_side_by_side_or_one_above_the_other(written, size_wh, second):
    config = StabilizerConfig(projection=DUAL_FISHEYE, fisheye=FisheyeConfig(
        fov_deg=190., file=str(written(CAMCHAIN))))
    projection = projection_of(size_wh, config)
    x = bearings(80)
    np.testing.assert_allclose(located(projection, x), opencv_pixels(x), atol=1e-3)
    np.testing.assert_allclose(
        located(projection, R_CAM1_CAM0.inv().apply(x)), opencv_pixels(x) + second, atol=2e-3)


@pytest.mark.parametrize('text, projection', [(CAMERA_INFO, FISHEYE), (CAMCHAIN, DUAL_FISHEYE)])
def test_a_calibration_on_the_command_line_chooses_the_projection(written, text, projection):
    path = written(text)
    assert {name: value for name, (_, value) in read_calibration(path).items()} == {
        'projection': projection, 'fisheye.file': str(path)}
    _, settings = arguments(['in.mp4', '--calibration', str(path)])
    assert settings.config.projection == projection


@pytest.mark.parametrize('text, reason', [
    (CAMERA_INFO.replace('equidistant', 'plumb_bob'), "'plumb_bob' is not read"),
    (CAMERA_INFO.replace('image_width: 848\n', ''), 'no image_width in it'),
    (CAMERA_INFO.replace('0.0435, ', ''), 'numbers that are none'),
    (CAMERA_INFO.replace('-0.0105', '-0.9'), "yaml' cannot be used as a calibration: radius_px "
     'must lie within'),
    (CAMERA_INFO.replace('285.1, 0', '.nan, 0'), 'a calibration: radius_px must lie within'),
    (CAMERA_INFO.replace('0.0078', '0.006'), 'turns back before 95 degrees'),
    (CAMCHAIN.replace('pinhole', 'omni'), "'omni' is not read"),
    (CAMCHAIN, 'is a calibration of 2 lenses, the projection has 1'),
    ('- 1', 'no calibration'), ('a: [', 'not YAML')])
def test_what_cannot_be_used_is_said_in_one_line(written, capsys, text, reason):
    path = written(text)
    with pytest.raises(SystemExit) as status:
        arguments(['in.mp4', '--projection', FISHEYE, '-p', f'fisheye.file:={path}'])
    assert status.value.code == 2
    line = capsys.readouterr().err.strip().splitlines()[-1]
    assert reason in line


def test_a_file_that_is_not_there_is_said_in_one_line(capsys):
    with pytest.raises(SystemExit):
        arguments(['in.mp4', '--projection', FISHEYE, '-p', 'fisheye.file:=nowhere.yaml'])
    assert "'nowhere.yaml' cannot be read" in capsys.readouterr().err


@pytest.mark.parametrize('model, radius', [
    ('equidistant', lambda theta: theta / (np.pi / 2)),
    (EQUISOLID, lambda theta: np.sin(theta / 2) / np.sin(np.pi / 4))])
def test_models_are_what_their_names_say(model, radius):
    lens = lens_of(LensConfig(100., 50., 80., 0., 0., roll_deg=0., aspect=0.5), model)
    theta = np.deg2rad((1., 30., 60., 90., 120., 140.))
    along_u = np.stack((np.sin(theta), 0 * theta, np.cos(theta)), axis=-1)[None]
    u, v, found = lens.pixels(along_u)
    np.testing.assert_allclose(u[0], 100 + 80 * radius(theta))
    np.testing.assert_allclose(v[0], 50)
    np.testing.assert_allclose(found[0], theta)
    _, v, _ = lens.pixels(along_u[..., [1, 0, 2]])
    np.testing.assert_allclose(v[0], 50 + 40 * radius(theta))
