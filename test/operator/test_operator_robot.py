# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The operator's server with a real node and a camera of raw images, seen by a bare WebSocket."""

import asyncio
from contextlib import asynccontextmanager
import json
import os
import signal
from struct import unpack_from
import subprocess
import sys
from time import monotonic

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from sph_stab_ros.config import SmoothingConfig
from sph_stab_ros.stabilization.smoothing import Smoother
from synthetic import angle_deg
from tiny_recordings import stamps_of, turning_spheres

pytest.importorskip('rclpy', reason='rclpy is not installed')
aiohttp = pytest.importorskip('aiohttp', reason='aiohttp is not installed')
from node_harness import DOMAINS, pixels, rotation, stabilizer, stamp_ns  # noqa: E402, I100
from sensor_msgs.msg import CompressedImage  # noqa: E402

TIMEOUT_S = 30.
RESEND_S = 0.5


def operator(*arguments, domain=None):
    """Start the server."""
    return subprocess.Popen(
        [sys.executable, '-m', 'sph_stab_ros.operator', *arguments], text=True,
        env={**os.environ, 'ROS_DOMAIN_ID': str(domain or next(DOMAINS))},
        stdout=subprocess.PIPE, stderr=subprocess.PIPE)


@asynccontextmanager
async def connection(url, query=''):
    """Open a WebSocket as the page does."""
    async with aiohttp.ClientSession() as session, session.ws_connect(
            f'{url}socket{query}', headers={'Origin': url.rstrip('/')}) as browser:
        yield browser


def received_pictures(url, count, send, query=''):
    """
    Return the headers and files of ``count`` pictures.

    Pictures are sent, by ``send()``, one whenever the last one is there, or did not come: the
    server may not have subscribed yet.
    """
    async def receive():
        pictures, sent_s = [], 0.
        async with connection(url, query) as browser:
            async for message in browser:
                if message.type is aiohttp.WSMsgType.BINARY:
                    length, = unpack_from('<I', message.data)
                    header = json.loads(message.data[4:4 + length])
                    await browser.send_str(json.dumps(
                        {'type': 'drawn', 'sequence': header['sequence']}))
                    if header['orientation']:
                        pictures.append((header, message.data[4 + length:]))
                    if len(pictures) == count:
                        return pictures
                elif monotonic() < sent_s + RESEND_S:
                    # A state; they come all the time.
                    continue
                send()
                sent_s = monotonic()

    return asyncio.run(asyncio.wait_for(receive(), TIMEOUT_S))


@pytest.fixture(scope='module')
def robot(tmp_path_factory):
    """Return a Peer of a node that looks at raw images, and its domain."""
    domain = next(DOMAINS)
    with stabilizer(tmp_path_factory.mktemp('robot'), domain=domain,
                    topics=('orientation', 'stabilized/image')) as peer:
        yield peer, domain


@pytest.mark.parametrize('pictures', [
    pytest.param('camera', marks=pytest.mark.slow), 'stabilizer'])
def test_pictures_and_orientations_belong_together(robot, pictures):
    peer, domain = robot
    spheres, _ = turning_spheres(60)
    # Later than those of the other test.
    stamps_ns = stamps_of(2000)[1000 * (pictures == 'stabilizer'):]
    sent = {}

    def send():
        n = len(sent)
        sent[int(stamps_ns[n])] = spheres[n % len(spheres)]
        peer.send(spheres[n % len(spheres)], stamps_ns[n])
        peer.spin_for(0.05)

    server = operator('--port', '0', '--pictures', pictures, domain=domain)
    try:
        got = received_pictures(server.stdout.readline().split()[-1], 8, send)
        # The other subscriber's may come later than the server's.
        peer.wait_until(lambda: max(int(header['stamp_ns']) for header, _ in got)
                        <= stamp_ns(peer.received['stabilized/image'][-1]))
    finally:
        server.send_signal(signal.SIGINT)
        assert server.wait(TIMEOUT_S) == 0
    orientations = {stamp_ns(msg): rotation(msg) for msg in peer.received['orientation']}
    shown = {stamp_ns(msg): pixels(msg) for msg in peer.received['stabilized/image']}
    for header, file in got:
        time_ns = int(header['stamp_ns'])
        R_world_camera = Rotation.from_quat(header['orientation']['R_world_camera'])
        R_world_virtual = Rotation.from_quat(header['orientation']['R_world_virtual'])
        assert angle_deg(R_world_camera, orientations[time_ns]) < 1e-6
        assert R_world_virtual.magnitude() == 0
        assert header['derotated'] == (pictures == 'stabilizer')
        expected = sent[time_ns] if pictures == 'camera' else shown[time_ns]
        image = cv2.imdecode(np.frombuffer(file, np.uint8), cv2.IMREAD_COLOR)
        assert np.mean(cv2.absdiff(image, expected)) < 5
    assert len({header['stamp_ns'] for header, _ in got}) == len(got)


@pytest.mark.slow
def test_the_virtual_camera_is_the_node_s_whenever_the_server_comes(tmp_path):
    """It has turned with the camera for a while; what it was turned by, the node knows."""
    domain, smoothing = next(DOMAINS), SmoothingConfig('follow', 5.)
    spheres, _ = turning_spheres(20)
    stamps_ns = iter(stamps_of(1000))
    mode = '-p', 'smoothing.mode:=follow', '-p', 'smoothing.time_constant_s:=5.0'
    with stabilizer(tmp_path, *mode, domain=domain) as peer:
        for sphere in spheres:
            peer.stabilize(sphere, next(stamps_ns))
        server = operator('--port', '0', domain=domain)
        try:
            got = received_pictures(
                server.stdout.readline().split()[-1], 4,
                lambda: peer.stabilize(spheres[-1], next(stamps_ns)))
        finally:
            server.send_signal(signal.SIGINT)
            assert server.wait(TIMEOUT_S) == 0
        smoother = Smoother()
        virtual = {stamp_ns(msg): smoother.update(smoothing, stamp_ns(msg), rotation(msg))
                   for msg in peer.received['orientation']}
    for header, _ in got:
        R_world_virtual = Rotation.from_quat(header['orientation']['R_world_virtual'])
        assert angle_deg(R_world_virtual, virtual[int(header['stamp_ns'])]) < 1e-3


def test_the_stabilizer_s_refusal_is_told(tmp_path):
    domain = next(DOMAINS)
    with stabilizer(tmp_path, domain=domain):
        server = operator('--port', '0', domain=domain)
        try:
            url = server.stdout.readline().split()[-1]
            notice = asyncio.run(asyncio.wait_for(answer_to(url, 'level'), TIMEOUT_S))
        finally:
            server.send_signal(signal.SIGINT)
            assert server.wait(TIMEOUT_S) == 0
    assert notice == {'type': 'notice', 'text': 'There is no picture yet.', 'ok': False}


async def answer_to(url, command):
    """Return the notice that answers a command, once the robot can take it."""
    is_sent = False
    async with connection(url) as browser:
        async for message in browser:
            values = json.loads(message.data)
            if values['type'] == 'notice':
                return values
            # Who asks again is told that the first request is still on its way.
            if values['robot'][f'can_{command}'] and not is_sent:
                await browser.send_str(json.dumps({'type': command}))
                is_sent = True


@pytest.mark.slow
@pytest.mark.parametrize('query', ['', '?video=h264'], ids=['files', 'video'])
def test_a_camera_of_video_is_seen(tmp_path, query):
    """As files, and by who takes video as what the camera sends, in the end."""
    encoded_video = pytest.importorskip('encoded_video')
    packets = encoded_video.encode(turning_spheres(24)[0], 'h264')
    domain, sent = next(DOMAINS), {}
    with stabilizer(tmp_path, domain=domain, compressed=True) as peer:
        def send():
            n = len(sent)
            msg = CompressedImage(format='h264')
            msg.data.frombytes(packets[n % len(packets)][1])
            sent[int(stamps_ns[n])] = packets[n % len(packets)][1]
            peer.send(msg, stamps_ns[n])
            peer.spin_for(0.05)

        stamps_ns = stamps_of(1000)
        server = operator('--port', '0', domain=domain)
        try:
            got = received_pictures(
                server.stdout.readline().split()[-1], 60, send, query)
            # The other subscriber's may come later than the server's.
            peer.wait_until(lambda: {int(header['stamp_ns']) for header, _ in got}
                            <= {stamp_ns(msg) for msg in peer.received['orientation']})
        finally:
            server.send_signal(signal.SIGINT)
            assert server.wait(TIMEOUT_S) == 0
        orientations = {stamp_ns(msg): rotation(msg) for msg in peer.received['orientation']}
    for header, data in got:
        time_ns = int(header['stamp_ns'])
        assert angle_deg(Rotation.from_quat(header['orientation']['R_world_camera']),
                         orientations[time_ns]) < 1e-6
        assert (data == sent[time_ns]) == bool(header['codec'])
        assert bool(header['chunk']) == bool(query)
    assert bool(got[-1][0]['codec']) == bool(query)


def test_parameters_that_are_the_stabilizer_s_are_told_of():
    server = operator('--port', '0', '--ros-args', '-p', 'level:=imu', '-p', 'mask:=x')
    try:
        assert server.stdout.readline()
    finally:
        server.send_signal(signal.SIGINT)
        errors = server.communicate(timeout=TIMEOUT_S)[1]
    assert ("operator: there is no parameter 'level', 'mask' here; "
            'those of the stabilizer are set at that node\n') in errors
