# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Texts that users and pages send: what they say, or one line of the error that is ours."""

from argparse import ArgumentTypeError
from functools import cache
import json
from pathlib import Path
import tempfile

from fuzzing import examples, mutated, tried
from hypothesis import given, strategies as st
import pytest
from scipy.spatial.transform import Rotation
import small_bags
from sph_stab_ros.calibration.file import calibration_text, read_calibration
from sph_stab_ros.config import ConfigError, FisheyeConfig, settings_of
from sph_stab_ros.config.parameter_file import parameter_file, read_parameter_files
from sph_stab_ros.config.ros_yaml import parse_yaml
from sph_stab_ros.evaluation.arguments import clock_argument, frames_argument, mount_argument
from sph_stab_ros.geometry import lens_file
from sph_stab_ros.geometry.masks import load_mask, MaskError
from sph_stab_ros.geometry.trajectory import read_tum, tum_line
from sph_stab_ros.operator.protocol import COMMANDS, parse_command, ProtocolError
from sph_stab_ros.recording import open_recording, RecordingError
from sph_stab_ros.replay import arguments

YAML = """
/robot:
  stabilizer:
    ros__parameters: {views: [view, rear], level: imu, imu.roll_deg: 1e1}
/**: &all
  ros__parameters:
    view: {yaw_deg: -90., pitch_deg: 010, width: 0x280}
    mask: "lat:-90,-62"
"""
COMMAND_TEXTS = [json.dumps({'type': 'look', 'direction': [0, 0, 0, 1]}),
                 json.dumps({'type': 'drawn', 'sequence': 5}),
                 json.dumps({'type': 'set_mode', 'mode': 'lock'})]


@cache
def folder():
    """Return a folder for files, as long as the tests run."""
    return tempfile.TemporaryDirectory(prefix='fuzz_')


def written(data):
    """Write a file; return its path."""
    path = Path(folder().name) / 'input'
    path.write_bytes(data)
    return path


def is_one_line(error):
    return '\n' not in str(error) and str(error)


@given(mutated(*(one.encode() for one in COMMAND_TEXTS)) | st.text().map(str.encode))
@examples(200)
def test_commands_of_the_page(data):
    text = data.decode(errors='surrogateescape')
    with tried('command', text):
        try:
            assert isinstance(parse_command(text), tuple(COMMANDS.values()))
        except ProtocolError as error:
            assert is_one_line(error)


JSON = st.recursive(
    st.none() | st.booleans() | st.floats() | st.integers() | st.text(max_size=50),
    lambda inner: st.lists(inner, max_size=5) | st.dictionaries(st.text(max_size=9), inner),
    max_leaves=10)


@given(st.dictionaries(st.sampled_from(('direction', 'sequence', 'mode', 'more')), JSON),
       st.sampled_from([*COMMANDS]))
@examples(200)
def test_commands_with_any_values(values, kind):
    text = json.dumps({'type': kind, **values})
    with tried('command_values', text):
        try:
            assert isinstance(parse_command(text), COMMANDS[kind])
        except ProtocolError as error:
            assert is_one_line(error)


TUM = ''.join(tum_line(1_700_000_000_000_000_000 + n * 33_333_333, R)
              for n, R in enumerate(Rotation.random(4, random_state=0))).encode()


@given(mutated(TUM, b'# a comment\n' + TUM, b'1e3 0 0 0 0 0 0 1\n1e4 0 0 0 1e9 0 -.5 .5\n'))
@examples(150)
def test_tum_files(data):
    with tried('tum', data):
        try:
            assert len(read_tum(written(data)))
        except ValueError as error:
            assert is_one_line(error)


@given(mutated(YAML.encode(), parameter_file().encode(),
               calibration_text(FisheyeConfig(), '# lenses').encode()))
@examples(100)
def test_parameter_files(data):
    with tried('parameters', data):
        path = written(data)
        for read in (lambda: settings_of(read_parameter_files([path])),
                     lambda: read_calibration(path)):
            try:
                read()
            except ConfigError as error:
                assert is_one_line(error)


ROS_LENS = b"""
image_width: 640
image_height: 480
distortion_model: equidistant
camera_matrix: {rows: 3, cols: 3, data: [200., 0, 320, 0, 200, 240, 0, 0, 1]}
distortion_coefficients: {rows: 1, cols: 4, data: [0.01, -0.002, 0., 0]}
"""
KALIBR_LENSES = b"""
cam0: {camera_model: pinhole, distortion_model: equidistant, distortion_coeffs: [0, 0, 0, 0],
  intrinsics: [200, 200, 320, 240], resolution: [640, 480]}
cam1: {camera_model: pinhole, distortion_model: equidistant, distortion_coeffs: [0, 0, 0, 0],
  intrinsics: [200, 200, 320, 240], resolution: [640, 480],
  T_cn_cnm1: [[-1, 0, 0, 0], [0, 1, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1]]}
"""


@given(mutated(ROS_LENS, KALIBR_LENSES))
@examples(150)
def test_lens_files(data):
    with tried('lenses', data):
        path = written(data)
        # It remembers the last ones.
        lens_file._lenses.cache_clear()
        lens_file.is_lens_file(path)
        try:
            lens_file.with_lens_file(FisheyeConfig(file=str(path)), (640, 480))
        except ConfigError as error:
            assert is_one_line(error)


@given(st.text(max_size=80) | mutated(b'[a, 1, "b"]', b'{a: 1}').map(
    lambda data: data.decode(errors='replace')))
@examples(200)
def test_values_of_parameters(text):
    with tried('value', text):
        try:
            parse_yaml(text)
        except ConfigError as error:
            assert is_one_line(error)


@cache
def bag_folder():
    path = small_bags.sqlite(Path(folder().name) / 'bag', small_bags.image_messages(2)).parent
    return path, (path / 'metadata.yaml').read_bytes()


@given(st.deferred(lambda: mutated(bag_folder()[1])))
@examples(40)
def test_metadata_of_bags(data):
    path, _ = bag_folder()
    with tried('metadata', data):
        (path / 'metadata.yaml').write_bytes(data)
        try:
            assert len([*open_recording(path).frames()]) == 2
        except RecordingError as error:
            assert is_one_line(error)


NUMBERS = st.lists(st.one_of(
    st.floats().map(str), st.integers().map(str), st.text(max_size=3)), max_size=5).map(','.join)


@given(NUMBERS | NUMBERS.map('lat:{}'.format) | st.text(max_size=20))
@examples(200)
def test_arguments(text):
    with tried('argument', text):
        for read, known in ((mount_argument, ArgumentTypeError),
                            (clock_argument, ArgumentTypeError),
                            (frames_argument, ArgumentTypeError),
                            (lambda text: load_mask(text, 128), MaskError)):
            try:
                read(text)
            except known as error:
                assert str(error)


@given(st.sampled_from(('--view', '--smoothing', '--mask', '-p', '--flow', '--working-width')),
       NUMBERS | st.text(max_size=20))
@examples(50)
def test_command_lines(option, text):
    with tried('command_line', f'{option} {text}'):
        try:
            arguments(['in.mp4', f'{option}={text}'])
        except SystemExit as error:
            assert error.code == 2


def test_a_usage_error_is_one_line_whatever_was_typed(capsys):
    for argument in ('--view=a\nb', '-p=a:=b\nc', '--mask=lat:\n1', '--projection=\x1b[31m'):
        with pytest.raises(SystemExit):
            arguments(['in.mp4', argument])
        line, = capsys.readouterr().err.splitlines()
        assert line.isprintable()
