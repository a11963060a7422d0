# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The real node with a source of its own, past the middleware."""

import os
import socket
import subprocess
import sys
import time

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='rclpy is not installed')
av = pytest.importorskip('av')
from live_sender import sending  # noqa: E402, I100
from node_harness import DOMAINS, stabilizer, stamp_ns  # noqa: E402
from rtsp_server import rtsp_server  # noqa: E402
from sph_stab_ros.live.connection import RTMP_SERVER  # noqa: E402
from tiny_recordings import turning_spheres  # noqa: E402
import tiny_videos as videos  # noqa: E402

QUICK = ('-p', 'working_width:=192')
TOPICS = 'orientation', '/diagnostics'


def test_the_pictures_of_a_stream_are_stabilised_and_its_state_is_told(tmp_path):
    with rtsp_server() as url, stabilizer(
            tmp_path, *QUICK, '-p', f'source:={url}', '-p', 'source_frame:=theta',
            topics=TOPICS, camera=False) as peer:
        peer.wait_until(lambda: len(peer.received['orientation']) > 5)
        values = peer.diagnostics(lambda values: values['message'] == 'ok')
        assert values['source'] == url
        assert values['source_status'] == 'connected'
        assert values['source_codec'] == 'h264'
        assert values['source_size'] == '256x128'
        assert values['source_stamps'] in ('sender', 'arrival')
        assert values['source_connections'] == '1'
        assert float(values['source_rate_hz']) > 0
        # The stream is joined anywhere between two key pictures.
        assert values['refused'] == values.get('refused: no key picture', '0')
        for topic in '/image', '/image/compressed':
            assert not peer.subscribers(topic)
        for msg in peer.received['orientation']:
            assert abs(stamp_ns(msg) / 1e9 - time.time()) < 60


@pytest.mark.slow
def test_a_source_that_is_not_there_yet_is_waited_for_and_one_of_another_size_refused(tmp_path):
    if av.library_versions['libavformat'] < RTMP_SERVER:
        pytest.skip('the FFmpeg of this PyAV does not survive being sent RTMP')
    with socket.create_server(('127.0.0.1', 0)) as one:
        port = one.getsockname()[1]
    url = f'rtmp://127.0.0.1:{port}/live'
    with stabilizer(tmp_path, *QUICK, '-p', f'source:={url}', topics=TOPICS,
                    camera=False) as peer:
        why = 'it cannot be read: Connection refused'
        values = peer.diagnostics(lambda values: values['source_status'] == 'reconnecting')
        assert values['message'] == f'no images: {url}: {why}'
        assert peer.output().count(f'{url}: {why}; trying again') == 1
    (tmp_path / 'again').mkdir()
    with stabilizer(tmp_path / 'again', *QUICK, '-p', f'source:={url}',
                    '-p', 'source_options:=listen=1', topics=TOPICS, camera=False) as peer:
        with sending(url, 'flv', size_wh=(256, 192)):
            values = peer.diagnostics(lambda values: int(values['refused']) > 3)
            assert values['message'].startswith('images are refused')
            assert values['source_size'] == '256x192'
            assert not peer.received['orientation']
        with sending(url, 'flv'):
            peer.wait_until(lambda: peer.received['orientation'])
            peer.diagnostics(lambda values: values['message'] == 'ok')
        assert 'Traceback' not in peer.output()


def ending(*arguments, **environment):
    """Return the exit status of a node that cannot start, and why."""
    done = subprocess.run(
        [sys.executable, '-m', 'sph_stab_ros.stabilizer', '--ros-args', *arguments], text=True,
        env={**os.environ, 'ROS_DOMAIN_ID': str(next(DOMAINS)), **environment},
        capture_output=True, timeout=60)
    said = done.stderr.splitlines()
    assert sum(not one.startswith('[INFO]') for one in said) == 1, said
    return done.returncode, said[-1].removeprefix('stabilizer: cannot start: ')


@pytest.mark.parametrize('arguments, said', [
    (('source_rear:=udp://@:5000', 'join:=left_right'),
     'source_rear is of the other lens than source: name that, too'),
    (('source:=udp://@:5000', 'source_rear:=udp://@:5001'),
     'a source for the rear lens needs join:=left_right or top_bottom')])
def test_half_of_two_lenses_is_refused(arguments, said):
    parameters = [part for one in arguments for part in ('-p', one)]
    assert ending(*parameters) == (2, said)


def test_a_bag_is_refused_by_name(turning_bag, tmp_path):
    """Whether its folder is named or a file in it, which FFmpeg may take for something else."""
    file, = turning_bag.glob('*.mcap') if turning_bag.is_dir() else (turning_bag,)
    said = "'ros2 run sph_stab_ros player BAG' plays its images on a topic"
    assert ending('-p', f'source:={file}') == (2, f"source: '{file}' is a bag; {said}")
    assert ending('-p', f'source:={tmp_path}') == (
        2, f"source: '{tmp_path}' is a folder; if that is a bag, {said}")


@pytest.mark.parametrize('box, layout', [
    (videos.stereo_box(1), True), (videos.sphere_box(projection=b'mshp'), False)],
    ids=['two eyes', 'a mesh'])
def test_what_a_file_says_of_its_pictures_is_heeded(tmp_path, box, layout):
    """As by replay: one eye is used of two, and what is not read is refused by name."""
    path = videos.tagged(videos.encode(tmp_path / 'a.mp4', [
        videos.bgr_frame(np.vstack((image, image))) for image in turning_spheres(12, 128)[0]] * 20,
        options={'tune': 'zerolatency'}), box)
    with stabilizer(tmp_path, *QUICK, '-p', f'source:={path}',
                    topics=(*TOPICS, 'stabilized/image'), camera=False) as peer:
        if layout:
            peer.wait_until(lambda: peer.received['stabilized/image'])
            assert {(msg.width, msg.height) for msg in peer.received['stabilized/image']} == {
                (128, 64)}
        else:
            values = peer.diagnostics(lambda values: int(values['refused']) > 0)
            assert 'which is not read' in peer.output()
            assert int(values['refused: metadata']) > 0 and not peer.received['orientation']


def test_without_pyav_the_node_says_what_to_install(tmp_path):
    (tmp_path / 'av.py').write_text('raise ImportError')
    path = os.pathsep.join([str(tmp_path), os.environ.get('PYTHONPATH', '')])
    assert ending('-p', 'source:=udp://@:5000', PYTHONPATH=path) == (
        2, "a source needs PyAV: pip install 'av>=16,<19'")
