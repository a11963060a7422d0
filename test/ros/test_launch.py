# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The launch files start what they say, where launch is installed."""

from contextlib import contextmanager
import os
from pathlib import Path
import signal
import subprocess
import sys
import time

import pytest

# Not launch itself: the folder of that name could be taken for it.
pytest.importorskip('launch_ros', reason='launch comes with a ROS installation only')

from geometry_msgs.msg import QuaternionStamped  # noqa: E402, I100
from launch import LaunchContext  # noqa: E402, I100
from launch.launch_description_sources import (  # noqa: E402, I100
    PythonLaunchDescriptionSource)
from node_harness import DOMAINS, leave, TIMEOUT_S  # noqa: E402
import rclpy  # noqa: E402, I100
from rclpy.context import Context  # noqa: E402, I100
from rclpy.executors import SingleThreadedExecutor  # noqa: E402, I100
from rclpy.parameter import parameter_value_to_python  # noqa: E402, I100
from rclpy.parameter_client import AsyncParameterClient  # noqa: E402, I100

ROOT = Path(__file__).resolve().parents[2]
STABILIZER, DEMO = 'stabilizer.launch.py', 'demo.launch.py'
# As ros2 launch does.
LAUNCH = """
import sys
from launch import LaunchDescription, LaunchService
from launch.actions import IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource
service = LaunchService(noninteractive=True)
service.include_launch_description(LaunchDescription([IncludeLaunchDescription(
    PythonLaunchDescriptionSource(sys.argv[1]),
    launch_arguments=[one.split(':=') for one in sys.argv[2:]])]))
sys.exit(service.run())
"""


@pytest.fixture(scope='module')
def prefix(tmp_path_factory):
    """Install what the launch files look for, and return where."""
    prefix = tmp_path_factory.mktemp('prefix')
    packages = prefix / 'share/ament_index/resource_index/packages'
    executables, share = prefix / 'lib/sph_stab_ros', prefix / 'share/sph_stab_ros'
    for folder in (packages, executables, share):
        folder.mkdir(parents=True)
    (packages / 'sph_stab_ros').touch()
    for folder in ('config', 'launch'):
        (share / folder).symlink_to(ROOT / folder)
    for name in ('player', 'stabilizer'):
        script = executables / name
        script.write_text(
            f'#!/bin/sh\nexec {sys.executable} -m sph_stab_ros.{name} "$@"\n')
        script.chmod(0o755)
    return prefix


class Launched:
    """A launch file that runs, and a node in its domain that looks at it."""

    def __init__(self, process, log, node, executor):
        self._process, self._log, self.node, self._executor = process, log, node, executor

    def wait_until(self, condition):
        """Serve the middleware until a condition holds."""
        end_s = time.monotonic() + TIMEOUT_S
        while not condition():
            assert time.monotonic() < end_s and self._process.poll() is None, self.output()
            self._executor.spin_once(timeout_sec=0.05)

    def output(self):
        """Return what was written so far."""
        return self._log.read_text()

    def end(self):
        """Press Ctrl-C and return the exit status."""
        self._process.send_signal(signal.SIGINT)
        return self.ended()

    def ended(self):
        """Return the exit status once it has ended."""
        return self._process.wait(TIMEOUT_S)


@contextmanager
def launched(prefix, tmp_path, name, *arguments):
    """Run a launch file; give a Launched."""
    domain = next(DOMAINS)
    log = tmp_path / 'launch.log'
    paths = os.pathsep.join((str(prefix), os.environ['AMENT_PREFIX_PATH']))
    with open(log, 'w') as log_file:
        process = subprocess.Popen(
            [sys.executable, '-c', LAUNCH, str(ROOT / 'launch' / name), *arguments],
            env={**os.environ, 'AMENT_PREFIX_PATH': paths, 'ROS_DOMAIN_ID': str(domain),
                 'ROS_LOG_DIR': str(tmp_path)}, stdout=log_file, stderr=log_file)
    context = Context()
    rclpy.init(context=context, domain_id=domain)
    node = rclpy.create_node('looker', context=context)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    try:
        yield Launched(process, log, node, executor)
    finally:
        if process.poll() is None:
            process.send_signal(signal.SIGINT)
        process.wait(TIMEOUT_S)
        leave(node, executor)


@pytest.mark.parametrize('name', (STABILIZER, DEMO))
def test_arguments_are_described(name, prefix, monkeypatch):
    monkeypatch.setenv('AMENT_PREFIX_PATH', str(prefix))
    description = PythonLaunchDescriptionSource(
        str(ROOT / 'launch' / name)).get_launch_description(LaunchContext())
    arguments = {one.name: one.description for one in description.get_launch_arguments()}
    assert {'params_file', 'namespace', 'use_sim_time', 'image_transport', 'projection',
            'image', 'imu'} <= arguments.keys()
    assert all(text and text != 'no description given' for text in arguments.values())


def test_arguments_reach_the_node(prefix, tmp_path):
    params = tmp_path / 'params.yaml'
    params.write_text('/**:\n  ros__parameters:\n    image_transport: raw\n    jpeg_quality: 33\n'
                      '    level: imu\n')
    with launched(prefix, tmp_path, STABILIZER, f'params_file:={params}', 'namespace:=robot',
                  'image:=/theta/image_raw', 'image_transport:=compressed',
                  'projection:=dual_fisheye', 'imu:=/base/imu', 'use_sim_time:=true') as it:
        for topic in ('/theta/image_raw/compressed', '/base/imu'):
            it.wait_until(lambda: it.node.count_subscribers(topic))
        asked = AsyncParameterClient(it.node, '/robot/stabilizer')
        it.wait_until(asked.services_are_ready)
        future = asked.get_parameters(
            ['jpeg_quality', 'image_transport', 'projection', 'use_sim_time'])
        it.wait_until(future.done)
        values = [parameter_value_to_python(one) for one in future.result().values]
        assert values == [33, 'compressed', 'dual_fisheye', True]
        assert it.end() == 0
        assert 'has died' not in it.output()


def test_the_demo_plays_a_recording_through_the_node(prefix, tmp_path, turning_bag):
    with launched(prefix, tmp_path, DEMO, f'recording:={turning_bag}', 'namespace:=demo') as it:
        received = []
        it.node.create_subscription(
            QuaternionStamped, '/demo/orientation', received.append, 10)
        # More than the recording has: it begins anew.
        it.wait_until(lambda: len(received) > 15)
        assert it.end() == 0
        assert it.output().count('has finished cleanly') == 2, it.output()


def test_the_demo_ends_with_its_recording(prefix, tmp_path, turning_bag):
    with launched(prefix, tmp_path, DEMO, f'recording:={turning_bag}', 'loop:=false',
                  'namespace:=demo') as it:
        assert it.ended() == 0
        assert it.output().count('has finished cleanly') == 2, it.output()


def test_a_parameter_file_that_is_missing_is_named(prefix, tmp_path):
    with launched(prefix, tmp_path, STABILIZER, 'params_file:=/no/such.yaml') as it:
        assert it.ended() == 1
        assert 'there is no file /no/such.yaml' in it.output()
        assert 'process started' not in it.output()
