# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The camera in a process of its own, heard through the middleware."""

from contextlib import contextmanager
from itertools import cycle
import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='rclpy is not installed')
pytest.importorskip('av')
from live_sender import painted_number, sending  # noqa: E402, I100
from node_harness import DOMAINS, leave, stamp_ns, TIMEOUT_S  # noqa: E402
import rclpy  # noqa: E402, I100
from rclpy.context import Context  # noqa: E402, I100
from rclpy.executors import SingleThreadedExecutor  # noqa: E402, I100
from sensor_msgs.msg import CameraInfo, CompressedImage, Image  # noqa: E402, I100
from sph_stab_ros.geometry.projection import to_grey  # noqa: E402
from sph_stab_ros.images.codec import encode_jpeg, image_from_message  # noqa: E402
from tiny_recordings import turning_spheres  # noqa: E402

pytestmark = pytest.mark.ros


def start(*args, domain=None, **streams):
    """Start the camera as a process."""
    return subprocess.Popen(
        [sys.executable, '-m', 'sph_stab_ros.camera', *map(str, args)], text=True,
        env={**os.environ, 'ROS_DOMAIN_ID': str(domain or next(DOMAINS))},
        stderr=subprocess.PIPE, **streams)


@contextmanager
def listening(types, *args, **streams):
    """Run the camera; give what is received by topic, what waits for it, and the process."""
    domain = next(DOMAINS)
    received = {topic: [] for topic in types}
    context = Context()
    rclpy.init(context=context, domain_id=domain)
    node = rclpy.create_node('listener', context=context)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    for topic, kind in types.items():
        node.create_subscription(kind, topic, received[topic].append, 100)
    process = start(*args, domain=domain, **streams)

    def wait_until(condition):
        end_s = time.monotonic() + TIMEOUT_S
        while not condition():
            assert time.monotonic() < end_s, 'waited in vain'
            executor.spin_once(timeout_sec=0.02)
    try:
        yield received, wait_until, process
    finally:
        leave(node, executor)
        if process.poll() is None:
            process.kill()
        process.wait()


def test_jpeg_goes_out_as_it_came():
    """Bytes and all, with what tells its size; the end of the pipe is the camera's."""
    images, _ = turning_spheres(20)
    files = [encode_jpeg(image, 97).tobytes() for image in images]
    types = {'theta/compressed': CompressedImage, 'camera_info': CameraInfo}
    with listening(types, '-', '--frame', 'theta', '--ros-args', '-r', 'image:=theta',
                   stdin=subprocess.PIPE) as (received, wait_until, process):
        written = cycle(files)

        def write_until_there_are_some():
            process.stdin.buffer.write(next(written))
            process.stdin.flush()
            return all(len(msgs) > 5 for msgs in received.values())
        wait_until(write_until_there_are_some)
        process.stdin.close()
        wait_until(lambda: process.poll() is not None)
        assert process.returncode == 0
    for msg in received['theta/compressed']:
        assert (msg.format, msg.header.frame_id) == ('jpeg', 'theta')
        assert msg.data.tobytes() in files
    assert (np.diff([stamp_ns(msg) for msg in received['theta/compressed']]) > 0).all()
    for msg in received['camera_info']:
        assert (msg.width, msg.height, msg.header.frame_id) == (256, 128, 'theta')
        # Not calibrated, as sensor_msgs says it.
        assert not msg.k.any()


@pytest.mark.slow
def test_video_goes_out_raw_and_as_jpeg_until_it_is_interrupted():
    types = {'image': Image, 'image/compressed': CompressedImage}
    with sending('pipe:1', 'h264', stdout=subprocess.PIPE) as sender, listening(
            types, '-', stdin=sender.stdout) as (received, wait_until, process):
        wait_until(lambda: all(len(msgs) > 3 for msgs in received.values()))
        process.send_signal(signal.SIGINT)
        _, said = process.communicate(timeout=TIMEOUT_S)
        assert process.returncode == 0
        assert 'standard input: h264, 256x128' in said and 'Traceback' not in said
    for msgs in received.values():
        numbers = [painted_number(to_grey(image_from_message(msg))) for msg in msgs]
        assert (np.diff(numbers) > 0).all()
    raw, compressed = ({stamp_ns(msg) for msg in msgs} for msgs in received.values())
    assert raw & compressed


@pytest.mark.parametrize('args, status, said', [
    (('/nope.mp4',), 2, "camera: source: there is no file '/nope.mp4', and no protocol:// begins"),
    ((__file__,), 1, 'what comes cannot be read as video')])
def test_what_cannot_be_read_is_a_line(args, status, said):
    process = start(*args)
    _, error = process.communicate(timeout=TIMEOUT_S)
    assert process.returncode == status
    assert said in error and error.count('\n') == 1
