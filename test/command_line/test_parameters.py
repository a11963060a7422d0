# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The node's parameters on all command lines: the same names, values, limits and precedence."""

from dataclasses import replace
from importlib import import_module

from parameter_values import other_value
import pytest
from sph_stab_ros.command_line.parameters import TRACKER_OPTIONS
from sph_stab_ros.config import get_option, NODE_PARAMETERS, Settings

COMMANDS = {'replay': ['rec', 'out'], 'evaluate': ['rec'], 'calibrate': ['rec', '--out', 'out'],
            'player': ['rec']}


@pytest.fixture(params=COMMANDS)
def command(request):
    """Return a function that parses arguments of a command and returns what it got."""
    if request.param == 'player':
        pytest.importorskip('rclpy', reason='rclpy is not installed')
    module = import_module(f'sph_stab_ros.{request.param}')

    def parsed(*args):
        return module.arguments([*COMMANDS[request.param], *map(str, args)])[1]
    parsed.name = request.param
    return parsed


def replay(*args):
    """Return the Settings of replay."""
    return import_module('sph_stab_ros.replay').arguments(['rec', 'out', *map(str, args)])[1]


def refusal(command, capsys, *args):
    """Return the one line of a usage error."""
    with pytest.raises(SystemExit) as ended:
        command(*args)
    assert ended.value.code == 2
    line, = capsys.readouterr().err.splitlines()
    return line


def yaml(value):
    """Return a value as YAML."""
    return repr(list(value) if isinstance(value, tuple) else value)


def check(command, found, expected):
    """Check that a command got Settings; evaluate goes through estimators of its own choice."""
    if command.name != 'evaluate':
        assert found == expected
        return
    wanted = expected.config
    for config in found.values():
        tracker = replace(config.tracker, estimator=wanted.tracker.estimator)
        assert replace(config, tracker=tracker) == wanted


@pytest.mark.parametrize('name', NODE_PARAMETERS)
def test_every_parameter_is_taken_and_checked_by_every_command(command, tmp_path, capsys, name):
    value = other_value(name)
    expected = Settings().changed({name: value})
    assert expected != Settings()
    check(command, command('-p', f'{name}:={yaml(value)}'), expected)
    file = tmp_path / 'robot.yaml'
    file.write_text(f'stabilizer: {{ros__parameters: {{{name}: {yaml(value)}}}}}')
    check(command, command('--params-file', file), expected)

    wrong = '[1, 2]' if NODE_PARAMETERS[name].minimum is not None else '1.5'
    line = refusal(command, capsys, '-p', f'{name}:={wrong}')
    assert line.startswith(f'{command.name}: -p: {name} is a ')
    file.write_text(f'stabilizer: {{ros__parameters: {{{name}: {wrong}}}}}')
    line = refusal(command, capsys, '--params-file', file)
    assert line.startswith(f"{command.name}: '{file}': {name} is a ")


def test_what_there_is_not_is_named(command, tmp_path, capsys):
    file = tmp_path / 'robot.yaml'
    file.write_text('stabilizer: {ros__parameters: {estimatr: pts}}')
    assert f"'{file}': there is no parameter 'estimatr'" in refusal(
        command, capsys, '--params-file', file)
    assert "-p: there is no parameter 'view.zoom'" in refusal(
        command, capsys, '-p', 'view.zoom:=1')
    for text in ('view.width', 'view.width=3', ':=3', 'view.width:='):
        assert f"'{text}' is not NAME:=VALUE" in refusal(command, capsys, '-p', text)
    assert 'mask: not YAML' in refusal(command, capsys, '-p', 'mask:=[')
    assert 'No such file' in refusal(command, capsys, '--params-file', tmp_path / 'none')
    # The mask is read before the recording is.
    assert "-p: mask 'lat:5' is not of the form" in refusal(
        command, capsys, '-p', 'mask:=lat:5')


def test_later_wins_over_earlier_and_the_command_line_over_files(command, tmp_path):
    first, second = tmp_path / 'first.yaml', tmp_path / 'second.yaml'
    first.write_text('/**: {ros__parameters: {jpeg_quality: 1, front_yaw_deg: 1.0, flow: dis}}')
    second.write_text('/**: {ros__parameters: {jpeg_quality: 2, front_yaw_deg: 2.0}}')
    words = ('-p', 'jpeg_quality:=3', '--params-file', first, '-p', 'jpeg_quality:=4',
             '--params-file', second)
    expected = Settings().changed({'jpeg_quality': 4, 'front_yaw_deg': 2., 'flow': 'dis'})
    check(command, command(*words), expected)


@pytest.mark.parametrize('name', (*TRACKER_OPTIONS, 'projection'))
def test_a_shorthand_is_its_parameter(tmp_path, name):
    value, file = other_value(name), tmp_path / 'robot.yaml'
    file.write_text(f'/**: {{ros__parameters: {{{name}: {yaml(NODE_PARAMETERS[name].default)}}}}}')
    flag = '--' + name.replace('_', '-'), str(value)
    expected = Settings().changed({name: value})
    assert replay(*flag) == replay(*flag, '--params-file', file) == expected
    default = f'{name}:={yaml(NODE_PARAMETERS[name].default)}'
    assert replay(*flag, '-p', default) == Settings()
    assert replay('-p', default, *flag) == expected


@pytest.mark.parametrize('words, values', (
    (['--smoothing', 'follow'], {'smoothing.mode': 'follow'}),
    (['--smoothing', 'follow:3'], {'smoothing.mode': 'follow', 'smoothing.time_constant_s': 3.}),
    (['--view=-10,20,30,60'], {'view.yaw_deg': -10., 'view.pitch_deg': 20., 'view.roll_deg': 30.,
                               'view.hfov_deg': 60.}),
))
def test_a_shorthand_of_several_parameters_leaves_the_others_of_the_file(tmp_path, words, values):
    file = tmp_path / 'robot.yaml'
    others = {'smoothing.time_constant_s': 7., 'view.width': 99, 'view.yaw_deg': 5.}
    file.write_text('/**:\n  ros__parameters:\n' + ''.join(
        f'    {name}: {value}\n' for name, value in others.items()))
    assert replay(*words) == Settings().changed(values)
    assert replay('--params-file', file, *words) == Settings().changed(others | values)


def test_shorthands_say_what_they_do_not_take(capsys):
    for words, reason in (
            (['--working-width', '5'], '--working-width: working_width is 0 or at least 128'),
            (['--working-width', 'x'], "--working-width: working_width is a int, not 'x'"),
            (['--estimator', 'magic'], '--estimator: estimator is one of anchored, pts'),
            (['--smoothing', 'magic'], '--smoothing: smoothing.mode is one of lock, follow'),
            (['--view', '0,0,0,400'], '--view: view.hfov_deg must lie within 10 and 150'),
            (['--view', 'rear'], "--view: 'rear' is none of the views: view"),
            (['-p', 'views:=[front]', '--view', '0,0,0,90'],
             "--view: 'view' is none of the views: front")):
        assert refusal(replay, capsys, *words).startswith(f'replay: {reason}')


def test_only_the_calibration_of_a_file_of_it_is_taken(tmp_path, capsys):
    file = tmp_path / 'lenses.yaml'
    file.write_text('/**: {ros__parameters: {flow: dis, fisheye: {fov_deg: 200.0}}}')
    expected = Settings().changed({'projection': 'dual_fisheye', 'fisheye.fov_deg': 200.})
    assert replay('--calibration', file) == expected
    assert replay('-p', 'fisheye.fov_deg:=195.0', '--calibration', file) == expected
    found = replay('--calibration', file, '-p', 'fisheye.fov_deg:=195.0')
    assert get_option(found.config, 'fisheye.fov_deg') == 195
    file.write_text('/**: {ros__parameters: {flow: dis}}')
    assert 'has no parameters fisheye.*' in refusal(replay, capsys, '--calibration', file)


def test_evaluate_takes_the_estimator_of_the_parameters_unless_told_otherwise():
    def names(*args):
        return list(import_module('sph_stab_ros.evaluate').arguments(['rec', *args])[1])
    assert names() == ['anchored', 'pts', 'moment', 'pts_epipolar']
    assert names('-p', 'estimator:=moment') == ['moment']
    assert names('-p', 'estimator:=moment', '--estimators', 'pts,anchored') == ['pts', 'anchored']
    _, configs = import_module('sph_stab_ros.evaluate').arguments(
        ['rec', '--estimators', 'moment', '-p', 'flow:=dis'])
    assert configs['moment'].tracker.flow == 'dis'


def test_whole_numbers_do_for_fractions():
    assert replay('-p', 'view.yaw_deg:=30').views['view'].yaw_deg == 30.
