# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What the pages say to type, the parsers take: each command, each option, each parameter."""

import ast
from importlib import import_module
from pathlib import Path
import re
import shlex
import shutil
from unittest import mock

import pytest
from sph_stab_ros.__main__ import COMMANDS
from sph_stab_ros.command_line import Parser
from sph_stab_ros.command_line.parameters import (
    add_parameters, given_parameters, settings_from)
from sph_stab_ros.config import NODE_PARAMETERS, VIEW, view_parameters

ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / name for name in ('README.md', 'CONTRIBUTING.md', 'bags/README.md')] + sorted(
    (ROOT / 'docs').rglob('*.md'))
BEFORE = re.compile(r'^(ros2 run sph_stab_ros |\.venv/bin/|python3 -m sph_stab_ros\.)')
PARTS = {f'benchmark.{name}': f'benchmark.{name}' for name in ('node', 'source', 'soak', 'batch')}
MODULES = {name: module for name, (module, _) in COMMANDS.items()} | PARTS
NEED_ROS = {'camera', 'demo', 'operator', 'player', *PARTS} - {'benchmark.batch'}
# Of other programs, and of tools that are no part of the package.
OTHERS_OPTIONS = {'--help', '--nthreads', '--ros-args'}
CAMERA_INFO = """image_width: 640
image_height: 640
camera_name: front
camera_matrix: {rows: 3, cols: 3, data: [200, 0, 320, 0, 200, 320, 0, 0, 1]}
distortion_model: equidistant
distortion_coefficients: {rows: 1, cols: 4, data: [0, 0, 0, 0]}
"""


def typed(page):
    """Return the lines that a page says to type, those of blocks; not what others answered."""
    text = page.read_text()
    blocks = re.findall(r'^```sh\n(.*?)^```$', text, re.MULTILINE | re.DOTALL)
    text = re.sub(r'^```.*?^```$', '', text, flags=re.MULTILINE | re.DOTALL)
    blocks += re.findall(r'(?:^    (?!\$ ).*\n)+', text, re.MULTILINE)
    return [line.strip() for block in blocks for line in block.splitlines()]


def calls():
    """Return (page, name, arguments) of each call of one of ours, pipes apart."""
    found = []
    for page in PAGES:
        for line in typed(page):
            for part in re.split(r' \| ', line):
                name, _, arguments = BEFORE.sub('', part).partition(' ')
                is_prose = arguments.startswith((' ', '=')) and not BEFORE.match(part)
                if name in MODULES and not is_prose:
                    found.append((str(page.relative_to(ROOT)), name,
                                  shlex.split(arguments, comments=True)))
    return found


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Return a folder with the files that the pages name, where the test then is."""
    (tmp_path / 'config').symlink_to(ROOT / 'config')
    for name, config in (('my_camera', 'theta_s'), ('calibration', 'theta_s'),
                         ('robot', 'stabilizer')):
        shutil.copy(ROOT / f'config/{config}.yaml', tmp_path / f'{name}.yaml')
    (tmp_path / 'camera_info.yaml').write_text(CAMERA_INFO)
    (tmp_path / 'film.yaml').write_text('- {time_s: 0, yaw_deg: 0}\n')
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize('page, name, arguments', calls())
def test_a_command_is_taken_by_its_parser(page, name, arguments, folder, capsys):
    if name in NEED_ROS:
        pytest.importorskip('rclpy', reason='rclpy is not installed')
    at = arguments.index('--ros-args') if '--ros-args' in arguments else len(arguments)
    try:
        if name != 'stabilizer':
            import_module(f'sph_stab_ros.{MODULES[name]}').arguments(arguments[:at])
        check_ros_arguments(arguments[at + 1:])
    except SystemExit:
        pytest.fail(capsys.readouterr().err)


def check_ros_arguments(arguments):
    """Exit where a parameter is none of the node's."""
    parser = Parser()
    add_parameters(parser, '')
    parser.add_argument('-r', action='append')
    settings_from(parser, given_parameters(parser, parser.parse_args(arguments)))


def test_there_are_such_commands():
    assert {name for _, name, _ in calls()} >= COMMANDS.keys() - {'demo', 'benchmark'}


class Caught(Exception):
    """Brings a parser out of whoever has made it."""


def own_options():
    """Return all options of all commands."""
    found = set()

    def catch(parser, *_):
        raise Caught(parser)
    for module in (*MODULES.values(), 'simulation.__main__'):
        if module != 'stabilizer':
            with mock.patch.object(Parser, 'parse_known_args', catch):
                with pytest.raises(Caught) as caught:
                    module = import_module(f'sph_stab_ros.{module}')
                    getattr(module, 'arguments', module.main)([])
            found |= {*caught.value.args[0]._option_string_actions}
    return found


def test_options_that_pages_name_are_options():
    pytest.importorskip('rclpy', reason='rclpy is not installed')
    known = own_options() | OTHERS_OPTIONS
    for page in PAGES:
        if page.name != 'CONTRIBUTING.md':
            for span in re.findall(r'`([^`\n]+)`', page.read_text().replace('```', '')):
                for option in re.findall(r'(?<![\w-])--[a-z][\w-]*', span):
                    assert option in known, f'{page.name}: {span}'


def launch_arguments():
    """Return the names of the arguments that the launch files declare."""
    return {node.args[0].value for path in (ROOT / 'launch').glob('*.py')
            for node in ast.walk(ast.parse(path.read_text()))
            if isinstance(node, ast.Call) and
            getattr(node.func, 'id', '') == 'DeclareLaunchArgument'}


@pytest.mark.parametrize('page', PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_parameters_that_a_page_sets_are_parameters(page):
    known = {*NODE_PARAMETERS, *view_parameters(VIEW), *launch_arguments(), 'name', 'NAME'}
    for name in re.findall(r'(?<![\w./])([A-Za-z_][\w.]*):=', page.read_text()):
        assert name in known, name


@pytest.mark.parametrize('page', PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_targets_that_a_page_names_are_targets(page):
    targets = set(re.findall(r'^([a-z-]+):.* ##', (ROOT / 'Makefile').read_text(), re.MULTILINE))
    text = page.read_text()
    named = re.findall(r'`make ([a-z-]+)', text) + [
        line.split()[1] for line in typed(page) if line.startswith('make ')]
    assert set(named) <= targets
