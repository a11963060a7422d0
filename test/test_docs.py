# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The documentation: its tutorials can be typed as they stand, and its site builds."""

import os
from pathlib import Path
import re
import subprocess
import sys

import pytest
from sph_stab_ros.__main__ import COMMANDS

ROOT = Path(__file__).resolve().parents[1]
TUTORIALS = sorted((ROOT / 'docs/tutorials').glob('*.md'))
SPHINX = ROOT / '.venv-docs/bin/python'
# Part of a recording shows as well as the whole that they run.
SHORT = {'replay': ['--max-frames', '20'], 'evaluate': ['--max-frames', '20']}


def commands(page):
    """Return the lines of a page's blocks of shell commands."""
    blocks = re.findall(r'^```sh\n(.*?)^```$', page.read_text(), re.MULTILINE | re.DOTALL)
    return [line for block in blocks for line in block.splitlines()]


def offline_commands():
    """Return each command of the tutorials that ends by itself."""
    return [line for page in TUTORIALS for line in commands(page) if line.split()[0] in SHORT]


def test_no_command_of_the_tutorials_is_unknown():
    """The rest sets up, which every test has, or starts what test_readme.py and others start."""
    for page in TUTORIALS:
        for line in commands(page):
            name = line.split()[0].removeprefix('.venv/bin/')
            assert line in ('make setup', '. .venv/bin/activate') or name in COMMANDS


@pytest.mark.parametrize('page', ['README.md', *(
    str(path.relative_to(ROOT)) for path in sorted((ROOT / 'docs').rglob('*.md')))])
def test_what_was_measured_can_be_measured_again(page):
    """Figures stand in tables that make targets fill in, or in docs/measured."""
    assert not re.search(r'measured\s+(once|by\s+hand)', (ROOT / page).read_text(), re.IGNORECASE)


@pytest.mark.parametrize('command', offline_commands())
def test_commands_of_the_tutorials_run(command, tmp_path):
    words = command.split()
    for name in ('bags', 'config'):
        (tmp_path / name).symlink_to(ROOT / name)
    if any(word.endswith('.mp4') for word in words):
        pytest.importorskip('av', reason='PyAV is not installed')
    if '--plots' in words:
        pytest.importorskip('matplotlib', reason='matplotlib is not installed')
    name, *arguments = words
    done = subprocess.run(
        [sys.executable, '-m', f'sph_stab_ros.{name}', *arguments, *SHORT[name]], text=True,
        cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, timeout=300,
        env={**os.environ, 'PYTHONPATH': str(ROOT)})
    assert done.returncode == 0, done.stdout
    for word in words[2:]:
        if word.endswith(('.mp4', '.tum', '_bag', 'plots')) and not word.startswith('-'):
            assert (tmp_path / word).exists(), done.stdout


@pytest.mark.ros
def test_the_node_of_the_tutorial_hears_the_player_of_the_tutorial(tmp_path):
    harness = pytest.importorskip('node_harness', reason='rclpy is not installed')
    page = ROOT / 'docs/tutorials/first_robot.md'
    node, player, operator = (line.split() for line in commands(page))
    assert [words[0] for words in (node, player, operator)] == [
        f'.venv/bin/{name}' for name in ('stabilizer', 'player', 'operator')]
    # None of them has another name for the pictures.
    assert '-r' not in node + player + operator
    domain = next(harness.DOMAINS)
    with harness.stabilizer(tmp_path, *node[2:], camera=False, reliable=False,
                            domain=domain) as peer:
        playing = subprocess.Popen(
            [sys.executable, '-m', 'sph_stab_ros.player', *player[1:]], cwd=ROOT,
            env={**os.environ, 'ROS_DOMAIN_ID': str(domain)})
        try:
            peer.wait_until(lambda: peer.received['orientation'])
        finally:
            playing.terminate()
            playing.wait(harness.TIMEOUT_S)


@pytest.mark.slow
def test_the_site_builds_without_warnings(tmp_path):
    if not SPHINX.exists():
        pytest.skip('there is no .venv-docs: make docs')
    done = subprocess.run(
        [SPHINX, '-m', 'sphinx', '-qW', '--keep-going', '-b', 'html', 'docs', tmp_path / 'site'],
        cwd=ROOT, text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, timeout=600,
        env={**os.environ, 'PACKAGE_PYTHON': sys.executable})
    assert done.returncode == 0, done.stdout
    assert 'view.hfov_deg' in (tmp_path / 'site/reference/parameters.html').read_text()
