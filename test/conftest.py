# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Markers by folder; fixtures: real footage where present, tiny recordings made on the spot."""

import os
from pathlib import Path

import pytest
from tiny_recordings import turning_spheres, write_bag, write_video

try:
    from hypothesis import HealthCheck, settings
except ImportError:
    pass
else:
    # The same examples every time, however slow the machine is.
    settings.register_profile('repeatable', deadline=None, derandomize=True)
    # Of ``make fuzz``, which keeps what fails itself.
    settings.register_profile('fuzz', deadline=None, max_examples=400, database=None,
                              suppress_health_check=list(HealthCheck))
    settings.load_profile('repeatable')

# SVT-AV1 tells of all that it does, unless it is told not to before its first use in a process.
os.environ.setdefault('SVT_LOG', '1')

TEST = Path(__file__).resolve().parent
# What each marks, by files and folders; other tests bear their marks themselves.
MARKED = {
    'browser': ('operator/test_operator_renderers.py',),
    'ros': ('ros', 'operator/test_operator_command_line.py',
            'operator/test_operator_link_status.py', 'operator/test_operator_robot.py'),
    'thorough': (
        # Whole commands, many runs, films.
        'batch', 'benchmark', 'command_line/test_interruption.py',
        'command_line/test_names_and_texts.py', 'command_line/test_out_of_memory.py',
        'evaluation', 'fuzz', 'live', 'recording/test_cube_video.py',
        'recording/test_damaged_bags.py', 'recording/test_sound.py',
        'recording/test_stereo_video.py', 'simulation', 'test_calibrate.py', 'test_evaluate.py',
        'test_examples.py', 'test_film.py', 'test_replay.py', 'test_replay_parameters.py',
        'test_replay_telemetry.py', 'tracking/test_accuracy.py', 'tracking/test_consistency.py',
        # The whole repository.
        'test_architecture.py', 'test_docs.py', 'test_package.py', 'test_readme.py',
        'test_style.py', 'test_types.py'),
}


# Before pytest-xdist looks for groups.
@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items):
    """Mark what starts processes of ROS or a browser, and what is about the whole repository."""
    for item in items:
        for marker, paths in MARKED.items():
            if any(item.path.is_relative_to(TEST / path) for path in paths):
                item.add_marker(marker)
        # By its fixture: whoever adds a file of such tests need not think of it.
        if 'browser' in item.fixturenames:
            item.add_marker(pytest.mark.browser)
        # These wait for processes of theirs, one at a time each: of the node, of the page and of
        # other programs.
        if item.get_closest_marker('ros') or item.get_closest_marker('browser'):
            item.add_marker(pytest.mark.xdist_group(next(
                (one for one in ('ros', 'operator') if item.path.is_relative_to(TEST / one)),
                'programs')))


@pytest.fixture(scope='session')
def shared_data():
    """Return the folder with real footage beside the checkout, or skip."""
    folder = Path(__file__).resolve().parents[2] / 'shared' / 'data'
    if not folder.is_dir():
        pytest.skip('no real footage beside the checkout')
    return folder


@pytest.fixture(scope='session')
def turning():
    """Return twelve spheres of a turning camera, and its R_world_camera."""
    return turning_spheres(12)


@pytest.fixture(scope='session')
def turning_bag(tmp_path_factory, turning):
    """Return a rosbag2 folder with the spheres of ``turning``."""
    return write_bag(tmp_path_factory.mktemp('turning') / 'bag', turning[0])


@pytest.fixture(scope='session')
def turning_video(tmp_path_factory, turning):
    """Return an MP4 file with the spheres of ``turning``."""
    pytest.importorskip('av')
    return write_video(tmp_path_factory.mktemp('turning') / 'video.mp4', turning[0])
