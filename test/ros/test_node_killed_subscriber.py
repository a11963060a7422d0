# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""A subscriber that is killed says no goodbye: the real node goes on, and forgets it soon."""

import os
from pathlib import Path
import signal
import subprocess
import sys

import pytest
from tiny_recordings import stamps_of, textured_sphere

pytest.importorskip('rclpy', reason='rclpy is not installed')
from node_harness import DOMAINS, stabilizer  # noqa: E402, I100

PROFILE = Path(__file__).resolve().parents[2] / 'config' / 'fastdds_large_images.xml'
# By default Fast DDS takes 20 s to miss anybody, by the profile 5 s.
LEASE_S = 15.
VICTIM = """
import rclpy
from sensor_msgs.msg import Image
rclpy.init()
node = rclpy.create_node('victim')
node.create_subscription(Image, 'stabilized/image', lambda msg: print('seen', flush=True), 10)
rclpy.spin(node)
"""


@pytest.mark.slow
def test_a_killed_subscriber_of_raw_pictures_is_forgotten(tmp_path, monkeypatch):
    monkeypatch.setenv('FASTRTPS_DEFAULT_PROFILES_FILE', str(PROFILE))
    domain = next(DOMAINS)
    image, stamps_ns = textured_sphere(1920), iter(stamps_of(10**5))
    with stabilizer(tmp_path, '-p', 'working_width:=256', compressed=True, domain=domain,
                    ) as peer, subprocess.Popen(
            [sys.executable, '-c', VICTIM], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
            env={**os.environ, 'ROS_DOMAIN_ID': str(domain)}) as victim:
        try:
            peer.wait_until(lambda: peer.subscribers('/stabilized/image') == ['victim'])
            os.set_blocking(victim.stdout.fileno(), False)
            while not victim.stdout.read():
                peer.stabilize(image, next(stamps_ns))
        finally:
            victim.send_signal(signal.SIGKILL)
        # Every picture is answered meanwhile.
        for _ in range(5):
            peer.stabilize(image, next(stamps_ns))
        assert peer.subscribers('/stabilized/image') == ['victim']
        peer.wait_until(lambda: not peer.subscribers('/stabilized/image'), LEASE_S)
