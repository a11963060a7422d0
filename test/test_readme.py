# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What the README says can be typed as it stands, and its figures are those of the evaluation."""

import ast
import os
from pathlib import Path
import re
import shutil
import signal
import subprocess
import sys
import threading

import pytest
from sph_stab_ros.recording import open_recording
from sph_stab_ros.simulation.__main__ import main as simulate
from tiny_recordings import write_video

ROOT = Path(__file__).resolve().parents[1]
README = (ROOT / 'README.md').read_text()
MAX_LINES = 150
FRAMES = 15
BLOCKS = re.findall(r'^```(\w+)\n(.*?)^```$', README, re.MULTILINE | re.DOTALL)
TRY, OFFLINE, ROBOT = [text for language, text in BLOCKS if language == 'sh']
LIBRARY, = [text for language, text in BLOCKS if language == 'python']
# Of what is run here, the sign of life.
STARTED = {'stabilizer': 'waiting for images on /theta/image_raw', 'operator': 'https://'}
# What test_package.py runs, and how it stands there.
RUN_BY_TEST_PACKAGE = {'colcon build': "[colcon, 'build'",
                       '. install/setup.bash': '. install/local_setup.sh'}


def commands(block):
    """Return the lines of a block of shell commands, without comments."""
    lines = (line.split('#')[0].strip() for line in block.splitlines())
    return [line for line in lines if line]


def robot_commands(*words):
    """Return the robot's commands that begin with words, without them."""
    return [line.split()[len(words):] for line in commands(ROBOT)
            if line.split()[:len(words)] == list(words)]


@pytest.fixture(scope='module')
def folder(tmp_path_factory):
    """Return a folder with a tiny bag, with truth, and a tiny video: those of the README."""
    folder = tmp_path_factory.mktemp('readme')
    assert simulate(['synthetic', str(folder / 'my_bag'), '--frames-limit', str(FRAMES),
                     '--every', '2', '--width', '256']) == 0
    frames = list(open_recording(folder / 'my_bag').frames())
    write_video(folder / 'ride.mp4', [frame.image for frame in frames],
                [frame.stamp_ns for frame in frames])
    (folder / '.venv').symlink_to(sys.prefix)
    return folder


def test_it_is_short():
    assert len(README.splitlines()) <= MAX_LINES


def test_no_command_is_unknown():
    for line in commands(TRY):
        assert line.startswith('make ')
    ours = ('rosdep install ', 'ros2 launch sph_stab_ros ',
            *(f'ros2 run sph_stab_ros {name} ' for name in STARTED))
    by_test_package = (ROOT / 'test/test_package.py').read_text()
    for line in commands(ROBOT):
        if line in RUN_BY_TEST_PACKAGE:
            assert RUN_BY_TEST_PACKAGE[line] in by_test_package
        else:
            assert line.startswith(('cd ', *ours)), f'no test runs: {line}'


@pytest.mark.parametrize('target', sorted({*re.findall(r'\bmake ([\w-]+)', ''.join(
    re.findall('`[^`]+`', README.replace('```', ''))) + TRY)}))
def test_make_has_the_target(target):
    done = subprocess.run(['make', '--dry-run', target], cwd=ROOT, text=True, capture_output=True,
                          timeout=60)
    assert done.returncode == 0, done.stderr


@pytest.mark.ros
def test_the_demo_runs(tmp_path):
    """What make demo calls, for some seconds."""
    for module in ('av', 'matplotlib'):
        pytest.importorskip(module)
    domains = pytest.importorskip('node_harness', reason='rclpy is not installed').DOMAINS
    assert 'make demo' in commands(TRY)
    # Within another make it would also say where it is.
    said = subprocess.run(['make', '--no-print-directory', '--dry-run', 'demo'], cwd=ROOT,
                          text=True, check=True, capture_output=True, timeout=60).stdout
    recipe = said.splitlines()[-1].split()
    python, *arguments, out = recipe
    assert python.endswith('python') and out == 'results/demo'
    done = subprocess.run(
        [sys.executable, *arguments, tmp_path / 'demo'], cwd=ROOT, text=True,
        capture_output=True, timeout=120, stdin=subprocess.DEVNULL,
        env={**os.environ, 'DEMO_SECONDS': '2', 'ROS_DOMAIN_ID': str(next(domains))})
    assert done.returncode == 0, done.stdout + done.stderr
    assert {path.name for path in (tmp_path / 'demo').iterdir()} == {
        'demo.mp4', 'orientation.png'}


def test_the_offline_block_runs(folder):
    if not (Path(sys.prefix) / 'bin/activate').exists():
        pytest.skip('the tests do not run in a virtual environment')
    pytest.importorskip('av')
    pytest.importorskip('matplotlib')
    done = subprocess.run(['bash', '-e', '-u', '-c', OFFLINE], cwd=folder, text=True,
                          capture_output=True, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
    for name in ('stable.mp4', 'out_bag', 'plots/orientation.png'):
        assert (folder / name).exists(), name
    assert len((folder / 'ride.tum').read_text().splitlines()) == FRAMES


def test_the_library_block_runs(folder):
    pytest.importorskip('av')
    done = subprocess.run([sys.executable, '-c', LIBRARY], cwd=folder, text=True,
                          capture_output=True, timeout=120)
    assert done.returncode == 0, done.stderr
    assert len(done.stdout.splitlines()) == FRAMES


def test_rosdep_knows_what_to_install(tmp_path):
    if shutil.which('rosdep') is None:
        pytest.skip('rosdep is not installed')
    (tmp_path / 'src').symlink_to(ROOT)
    for arguments in robot_commands('rosdep'):
        done = subprocess.run(['rosdep', *arguments, '--simulate'], cwd=tmp_path, text=True,
                              capture_output=True, timeout=300)
        assert done.returncode == 0, done.stdout + done.stderr


def test_launch_files_take_the_arguments():
    """By their text; test_launch.py starts them where launch is installed."""
    (file, *arguments), = robot_commands('ros2', 'launch', 'sph_stab_ros')
    declared = {node.args[0].value for node in ast.walk(ast.parse(
        (ROOT / 'launch' / file).read_text()))
        if isinstance(node, ast.Call) and getattr(node.func, 'id', '') == 'DeclareLaunchArgument'}
    assert {argument.split(':=')[0] for argument in arguments} <= declared


@pytest.mark.ros
@pytest.mark.parametrize('name', STARTED)
def test_what_ros2_runs_starts(name, tmp_path):
    """As python3 -m, without ros2; test_package.py runs what colcon installs."""
    if name == 'operator':
        pytest.importorskip('aiohttp')
        pytest.importorskip('cryptography')
    domains = pytest.importorskip('node_harness', reason='rclpy is not installed').DOMAINS
    arguments = [*robot_commands('ros2', 'run', 'sph_stab_ros', name),
                 # The launch file starts it with these.
                 ['--ros-args', '-r', 'image:=/theta/image_raw']][0]
    process = subprocess.Popen(
        [sys.executable, '-m', f'sph_stab_ros.{name}', *arguments], text=True, cwd=ROOT,
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
        env={**os.environ, 'ROS_DOMAIN_ID': str(next(domains)), 'PYTHONUNBUFFERED': '1',
             'XDG_DATA_HOME': str(tmp_path)})
    killer = threading.Timer(60, process.kill)
    killer.start()
    output = ''
    for line in process.stdout:
        output += line
        if STARTED[name] in line:
            break
    process.send_signal(signal.SIGINT)
    output += process.communicate()[0]
    killer.cancel()
    assert STARTED[name] in output and process.returncode == 0, output


def test_its_first_figures_are_those_of_the_evaluation():
    page = (ROOT / 'docs/evaluation.md').read_text()
    table = page.split('<!-- errors drone -->')[1].split('<!-- end -->')[0]
    row, = [line for line in table.splitlines() if line.startswith('| `anchored`')]
    _, geodesic, per_frame = (re.findall(r'[\d.]+', cell) for cell in row.split('|')[2:5])
    sentence = README.split('**')[1]
    assert re.findall(r'([\d.]+)°', sentence) == ['360'] * sentence.count('360°') + [
        geodesic[0], per_frame[0]]
    measured_ms, = re.findall(r'orientation out \| <= 5 ms \| ([\d.]+) ms', page)
    assert re.findall(r'(\d+) ms', sentence) == [f'{float(measured_ms):.0f}']


@pytest.mark.parametrize('page', [
    'README.md', 'CONTRIBUTING.md', 'QUALITY_DECLARATION.md', 'bags/README.md', *sorted(
        str(path.relative_to(ROOT)) for path in (ROOT / 'docs').rglob('*.md'))])
def test_links_lead_somewhere(page):
    for target in re.findall(r'\]\(([^)\s]+)\)', (ROOT / page).read_text()):
        if '://' in target:
            continue
        path, _, anchor = target.partition('#')
        file = (ROOT / page).parent / path if path else ROOT / page
        assert file.exists(), target
        if anchor:
            headings = re.findall(r'^#+ (.*)$', file.read_text(), re.MULTILINE)
            slugs = {re.sub(r'[^\w\- ]', '', heading.lower()).replace(' ', '-')
                     for heading in headings}
            assert anchor in slugs, target


def test_every_file_that_the_architecture_names_is_there():
    text = (ROOT / 'docs/architecture.md').read_text()
    rooms = [ROOT / 'sph_stab_ros', ROOT / 'sph_stab_ros/tracking/anchored',
             ROOT / 'sph_stab_ros/tracking/frame_to_frame']
    for name in re.findall(r'`([\w/]+(?:\.py|\.c|/))`', text):
        name = name.removeprefix('sph_stab_ros/')
        assert any((room / name).exists() for room in rooms), name
