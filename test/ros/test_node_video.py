# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The real node and compressed video: begun anywhere, messages lost, pictures in between."""

import signal

import cv2
from encoded_video import encode
import numpy as np
import pytest
from tiny_recordings import PERIOD_NS, START_NS, turning_spheres

pytest.importorskip('rclpy', reason='rclpy is not installed')
pytest.importorskip('av')
from node_harness import pixels, stabilizer, stamp_ns  # noqa: E402, I100
from rclpy.time import Time  # noqa: E402
from sensor_msgs.msg import CompressedImage  # noqa: E402
from sph_stab_ros.images.codec import fill_message  # noqa: E402
from sph_stab_ros.ros.messages import message_type  # noqa: E402
from sph_stab_ros.ros.topics import TRANSPORTS  # noqa: E402
from sph_stab_ros.config import IMAGE_TRANSPORTS, StabilizerConfig  # noqa: E402, I100
from sph_stab_ros.images.frame import Frame  # noqa: E402
from sph_stab_ros.stabilization.pipeline import Stabilizer  # noqa: E402

WIDTH = 256
KEY_PERIOD, COUNT = 8, 24
QUICK = ('-p', 'working_width:=192')


@pytest.fixture(scope='module')
def spheres():
    """Return the spheres that a turning camera sees."""
    return turning_spheres(COUNT, WIDTH)[0]


def send(peer, packet, codec='h264'):
    """Publish a packet as a CompressedImage with the stamp of its picture."""
    index, data = packet
    msg = fill_message(CompressedImage(format=codec), {'data': np.frombuffer(data, np.uint8)})
    peer.send(msg, stamp_of(index))


def stamp_of(index):
    return START_NS + index * PERIOD_NS


def heard(peer, topic='orientation'):
    """Return the indices of the pictures of which there are messages."""
    return [(stamp_ns(msg) - START_NS) // PERIOD_NS for msg in peer.received[topic]]


def send_shown(peer, packets, codec='h264'):
    """Publish packets, each when there is an orientation for the one before."""
    for packet in packets:
        send(peer, packet, codec)
        peer.wait_until(lambda: heard(peer)[-1:] == [packet[0]])


def send_refused(peer, packets, codec='h264'):
    """Publish packets of which nothing comes; return what is said of them."""
    before = int(peer.diagnostics(lambda values: True)['refused'])
    for packet in packets:
        send(peer, packet, codec)
    return peer.diagnostics(lambda values: int(values['refused']) == before + len(packets))


def test_transports_are_those_that_can_be_chosen():
    assert TRANSPORTS.keys() == {*IMAGE_TRANSPORTS}


@pytest.mark.parametrize('name', ['h264', 'h265', 'av1'])
def test_begun_anywhere_the_node_waits_for_a_key_picture_and_says_so(tmp_path, spheres, name):
    packets = encode(spheres, name)
    first = KEY_PERIOD - 3
    with stabilizer(tmp_path, *QUICK, topics=('orientation', '/diagnostics'),
                    compressed=True) as peer:
        values = send_refused(peer, packets[first:KEY_PERIOD], name)
        assert values['refused: no key picture'] == '3'
        assert values['message'] == 'images are refused: no key picture'
        assert not heard(peer)
        send_shown(peer, packets[KEY_PERIOD:], name)
        assert heard(peer) == [*range(KEY_PERIOD, COUNT)]
        peer.diagnostics(lambda values: values['message'] == 'ok')
        assert peer.output().count('pictures passed over before a key picture: 3') == 1


@pytest.mark.parametrize('transport', ['ffmpeg', 'foxglove'])
def test_other_transports_are_listened_to_where_their_messages_are_installed(
        tmp_path, spheres, transport):
    ending, name = TRANSPORTS[transport]
    package, _, _ = name.partition('/')
    pytest.importorskip(package, reason=f'{package} is not installed')
    msg_type = message_type(name)
    with stabilizer(tmp_path, *QUICK, '-p', f'image_transport:={transport}',
                    topics=('orientation', '/diagnostics'), camera=False) as peer:
        camera = peer.advertise(msg_type, f'image{ending}')
        peer.wait_until(camera.get_subscription_count)
        for index, data in encode(spheres, 'h264'):
            msg = fill_message(msg_type(), {'data': np.frombuffer(data, np.uint8)})
            stamp = Time(nanoseconds=stamp_of(index)).to_msg()
            if transport == 'ffmpeg':
                msg.header.stamp, msg.header.frame_id, msg.encoding = stamp, 'camera', 'libx264'
            else:
                msg.timestamp, msg.frame_id, msg.format = stamp, 'camera', 'h264'
            camera.publish(msg)
            peer.wait_until(lambda: heard(peer)[-1:] == [index])
        assert heard(peer) == [*range(COUNT)]


def test_pictures_are_those_of_the_stream_and_stabilized(tmp_path, spheres):
    """As from the spheres themselves, but for what two lossy codings take away."""
    local = Stabilizer(StabilizerConfig())
    expected = [local.process(Frame(sphere, stamp_of(index))).sphere()
                for index, sphere in enumerate(spheres)]
    with stabilizer(tmp_path, topics=('orientation', 'stabilized/image/compressed'),
                    compressed=True) as peer:
        for packet in encode(spheres, 'h264'):
            send(peer, packet)
            peer.wait_until(lambda: heard(peer, 'stabilized/image/compressed')[-1:] == [packet[0]])
        shown = [pixels(msg) for msg in peer.received['stabilized/image/compressed']]
    assert len(shown) == COUNT
    for one, other in zip(shown, expected):
        assert np.corrcoef(cv2.blur(one, (3, 3)).ravel(),
                           cv2.blur(other, (3, 3)).ravel())[0, 1] > 0.98


def test_behind_a_lost_message_nothing_is_shown_up_to_the_next_key_picture(tmp_path, spheres):
    packets, lost = encode(spheres, 'h264'), 3
    with stabilizer(tmp_path, *QUICK, topics=('orientation', '/diagnostics'),
                    compressed=True) as peer:
        send_shown(peer, packets[:lost])
        values = send_refused(peer, packets[lost + 1:KEY_PERIOD])
        assert values['refused: missing picture'] == '1'
        assert values['refused: no key picture'] == '3'
        assert values['message'].startswith('images are refused: ')
        assert heard(peer) == [*range(lost)]
        send_shown(peer, packets[KEY_PERIOD:])
        assert heard(peer) == [*range(lost), *range(KEY_PERIOD, COUNT)]
        assert peer.output().count('pictures passed over before a key picture: 4') == 1


def test_pictures_in_between_come_in_their_order(tmp_path, spheres):
    """They are sent behind those that they need, each with its own stamp."""
    packets = encode(spheres, 'h264 B')
    sent = [index for index, _ in packets]
    assert sent != sorted(sent)
    with stabilizer(tmp_path, *QUICK, topics=('orientation', '/diagnostics'),
                    compressed=True) as peer:
        for packet in packets:
            send(peer, packet)
            peer.spin_for(0.1)
        peer.wait_until(lambda: len(heard(peer)) >= COUNT - 4)
        assert heard(peer) == [*range(len(heard(peer)))]
        values = peer.diagnostics(lambda values: True)
        assert values['refused'] == '0' and 'notice: stamp_not_increasing' not in values


def test_what_a_full_queue_has_lost_is_waited_for(tmp_path, spheres):
    """The node stands still for longer than the middleware keeps messages for it."""
    # There is no key picture among those that are lost, but behind them.
    long = encode([spheres[index % COUNT] for index in range(130)], 'h264', key_period=120)
    with stabilizer(tmp_path, *QUICK, topics=('orientation', '/diagnostics'),
                    compressed=True) as peer:
        send_shown(peer, long[:5])
        peer.process.send_signal(signal.SIGSTOP)
        try:
            for packet in long[5:100]:
                send(peer, packet)
        finally:
            peer.process.send_signal(signal.SIGCONT)
        peer.diagnostics(lambda values: 'refused: missing picture' in values)
        send_refused(peer, long[100:120])
        send_shown(peer, long[120:])
        assert not [index for index in heard(peer) if 100 <= index < 120]
        assert peer.output().count('pictures passed over before a key picture: ') == 1


def test_without_pyav_the_node_says_what_to_install(tmp_path, spheres, monkeypatch):
    (tmp_path / 'av.py').write_text('raise ImportError')
    monkeypatch.setenv('PYTHONPATH', str(tmp_path), prepend=':')
    packets = encode(spheres[:2], 'h264')
    with stabilizer(tmp_path, *QUICK, topics=('orientation', '/diagnostics'),
                    compressed=True) as peer:
        values = send_refused(peer, packets)
        assert values['refused: no decoder of H.264'] == '2'
        said = "H.264 in messages needs PyAV: pip install 'av>=16,<19'"
        assert peer.output().count(said) == 1
        # What needs no decoder goes on.
        peer.stabilize(spheres[0], stamp_of(2))
