# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Live sources over loopback: what is sent is what comes, and again after a break."""

from contextlib import contextmanager
from itertools import count
import logging
import os
import socket
import subprocess
import sys
import time

import numpy as np
import pytest

# Nobody reads a source without.
av = pytest.importorskip('av')
from live_sender import BY_CLOCK, painted_number, sending  # noqa: E402, I100
from rtsp_server import rtsp_server  # noqa: E402
from sph_stab_ros.config import NOT_JOINED  # noqa: E402
from sph_stab_ros.images.jpeg_file import JpegFile  # noqa: E402
from sph_stab_ros.images.video.decoder import NO_KEY  # noqa: E402
from sph_stab_ros.live.address import address_of, Kind, SourceError  # noqa: E402
from sph_stab_ros.live.capture_clock import ARRIVAL, SENDER  # noqa: E402
from sph_stab_ros.live.connection import require_pyav, RTMP_SERVER  # noqa: E402
from sph_stab_ros.live.joined import source_of  # noqa: E402
from sph_stab_ros.live.source import (  # noqa: E402
    CONNECTED, ENDED, LivePicture, LiveSource, RECONNECTING)
from tiny_videos import encode, encode_tracks, frame_of  # noqa: E402

TIMEOUT_S = 30.
# PyAV 16 does not give away what RTCP says.
RTCP_CLOCK = SENDER if int(av.__version__.partition('.')[0]) >= 17 else ARRIVAL
log = logging.getLogger('live')


class Reader:
    """Reads a source; ``pictures`` are the LivePictures, ``refused`` the ImageErrors."""

    def __init__(self, address, rear=None, join=NOT_JOINED):
        self.pictures, self.refused = [], []
        self.source = source_of(
            address, rear, self.pictures.append, log, self.refused.append, join)
        self.source.start()

    @property
    def state(self):
        return self.source.state

    @property
    def numbers(self):
        """Return the numbers painted into the pictures."""
        return [painted_number(one.source.grey()) for one in self.pictures]

    def wait_until(self, condition):
        end_s = time.monotonic() + TIMEOUT_S
        while not condition():
            assert time.monotonic() < end_s, f'waited in vain: {self.state}'
            time.sleep(0.01)

    def read(self, more):
        """Wait for so many more pictures; return them."""
        before = len(self.pictures)
        self.wait_until(lambda: len(self.pictures) >= before + more)
        return self.pictures[before:]


@contextmanager
def reading(address, options='', **others):
    """Read an address, or the text of one."""
    reader = Reader(
        address_of(address, options) if isinstance(address, str) else address, **others)
    try:
        yield reader
    finally:
        reader.source.close()


@pytest.fixture(autouse=True)
def caplog_of_all(caplog):
    """Take down what is said of connections too."""
    caplog.set_level(logging.INFO)


def free_port(kind=socket.SOCK_DGRAM):
    """Return a port that nobody has."""
    with socket.socket(socket.AF_INET, kind) as one:
        one.bind(('127.0.0.1', 0))
        return one.getsockname()[1]


def udp_urls():
    """Return where to send to, and where to read from."""
    port = free_port()
    return f'udp://127.0.0.1:{port}?pkt_size=1316', f'udp://127.0.0.1:{port}'


def check_all_came(reader):
    """Check that from the first picture on none was left out or came twice."""
    numbers = reader.numbers
    assert numbers == [n for n, _ in zip(count(numbers[0]), numbers)]


def check_stamps(reader):
    """Check that stamps go forward and are those of the last half minute."""
    stamps_ns = np.array([one.stamp_ns for one in reader.pictures])
    assert (np.diff(stamps_ns) > 0).all()
    assert (np.abs(stamps_ns / 1e9 - time.time()) < TIMEOUT_S).all()


@contextmanager
def by_udp():
    there, here = udp_urls()
    with reading(here) as reader, sending(there, 'mpegts'):
        yield reader


def rtmp_url():
    """Return where to listen for RTMP, where FFmpeg can."""
    url = f'rtmp://127.0.0.1:{free_port(socket.SOCK_STREAM)}/live/sphere'
    if av.library_versions['libavformat'] < RTMP_SERVER:
        with pytest.raises(SourceError, match='needs PyAV 17.1 or newer'):
            require_pyav(address_of(url, 'listen=1'))
        pytest.skip('the FFmpeg of this PyAV does not survive being sent RTMP')
    return url


@contextmanager
def by_rtmp():
    """Listen for a camera that sends."""
    url = rtmp_url()
    with reading(url, 'listen=1') as reader, sending(url, 'flv'):
        yield reader


@contextmanager
def by_rtsp():
    with rtsp_server() as url, reading(url) as reader:
        yield reader


@contextmanager
def by_pipe(form, codec):
    with sending('pipe:1', form, codec, stdout=subprocess.PIPE) as sender:
        address = address_of('-')._replace(url=f'pipe:{sender.stdout.fileno()}')
        with reading(address) as reader:
            yield reader


@pytest.mark.parametrize('way, codec, clock', [
    (by_udp, 'h264', ARRIVAL), (by_rtsp, 'h264', RTCP_CLOCK),
    pytest.param(by_rtmp, 'h264', ARRIVAL, marks=pytest.mark.slow),
    pytest.param(lambda: by_pipe('matroska', 'libx264'), 'h264', ARRIVAL, marks=pytest.mark.slow),
    (lambda: by_pipe('h264', 'libx264'), 'h264', ARRIVAL),
    (lambda: by_pipe('mpjpeg', 'mjpeg'), 'mjpeg', ARRIVAL),
    pytest.param(lambda: by_pipe('yuv4mpegpipe', 'rawvideo'), 'rawvideo', ARRIVAL,
                 marks=pytest.mark.slow)],
    ids=['udp', 'rtsp', 'rtmp', 'matroska', 'h264', 'mpjpeg', 'yuv4mpeg'])
def test_every_picture_comes_once_and_in_order(way, codec, clock, caplog):
    with way() as reader:
        reader.read(10)
        assert reader.state[:4] == (CONNECTED, '', codec, (256, 128))
        # A sender tells of its clock now and then.
        reader.wait_until(lambda: reader.state.clock == clock)
        check_stamps(reader)
        check_all_came(reader)
        # A stream may be joined anywhere between two key pictures.
        assert {one.reason for one in reader.refused} <= {NO_KEY}
        # What is a file for each picture stays one.
        assert {isinstance(one.source, JpegFile) for one in reader.pictures} == {codec == 'mjpeg'}
    said, = (one.getMessage() for one in caplog.records if codec in one.getMessage())
    assert said.endswith(f'{codec}, 256x128')


@pytest.mark.parametrize('join, size', [('left_right', (128, 48)), ('top_bottom', (64, 96))])
def test_two_tracks_of_a_file_are_one_picture(tmp_path, join, size):
    """Of one moment each: what one track lacks is left out of the other."""
    greys = [[frame_of([np.full((48, 64), 20 + 10 * number + 3 * track, np.uint8),
                        *np.full((2, 24, 32), 128, np.uint8)], 'yuv420p') for number in range(8)]
             for track in range(2)]
    times_ms = [40 * np.arange(8)] * 2
    del greys[1][5]
    times_ms[1] = np.delete(times_ms[1], 5)
    path = encode_tracks(tmp_path / 'a.mp4', greys, times_ms)
    reader = Reader(address_of(str(path)), join=join)
    reader.wait_until(lambda: reader.source.has_ended())
    assert reader.state.status == ENDED
    assert reader.state.size_wh == size
    assert len(reader.pictures) == reader.state.pictures == 7
    for number, picture in zip((0, 1, 2, 3, 4, 6, 7), reader.pictures):
        assert picture.source.image.shape == (*size[::-1], 3)
        grey = picture.source.grey().astype(int)
        # Luma of limited range.
        first, last = (round((value - 16) * 255 / 219) for value in (
            20 + 10 * number, 23 + 10 * number))
        assert abs(grey[0, 0] - first) <= 1 and abs(grey[-1, -1] - last) <= 1
    stamps_ns = [one.stamp_ns for one in reader.pictures]
    assert (np.diff(stamps_ns) > 0).all()


def test_a_file_without_a_second_track_says_so(tmp_path, caplog):
    path = encode_tracks(tmp_path / 'a.mp4', [[frame_of(
        [np.zeros((48, 64), np.uint8), *np.zeros((2, 24, 32), np.uint8)], 'yuv420p')]])
    reader = Reader(address_of(str(path)), join='left_right')
    reader.wait_until(lambda: reader.source.has_ended())
    assert reader.state.status == ENDED
    assert 'no second video track' in caplog.text


def of_one_moment(picture):
    """Tell whether two lenses' pictures side by side have the same number."""
    first, second = map(painted_number, np.split(picture.source.grey(), 2, axis=1))
    return first == second


@pytest.mark.skipif(RTCP_CLOCK != SENDER, reason='this PyAV does not give away what RTCP says')
def test_two_senders_are_one_picture_and_one_comes_back():
    """Of one moment each, by the clock that both senders have."""
    port = free_port(socket.SOCK_STREAM)
    rear = f'rtsp://127.0.0.1:{port}/sphere'
    with rtsp_server(first=BY_CLOCK) as front, reading(
            front, rear=address_of(rear), join='left_right') as reader:
        assert reader.source.name == f'{front} and {rear}'
        for connections in 2, 3:
            reader.wait_until(lambda: reader.state.why)
            assert reader.source.why_silent().startswith(f'{rear}: ')
            with rtsp_server(port, first=BY_CLOCK):
                before = len(reader.pictures)
                # Until then a sender's clock is not known, or stamps have not come back to it.
                reader.wait_until(lambda: any(map(of_one_moment, reader.pictures[before:])))
                assert all(map(of_one_moment, reader.read(5)))
                assert reader.state.clock == SENDER
                assert reader.state[:4] == (CONNECTED, '', 'h264', (512, 128))
                assert reader.state.connections == connections
                assert not reader.source.why_silent()
            reader.wait_until(lambda: reader.state.status == RECONNECTING)
        check_stamps(reader)


def test_pictures_of_different_moments_are_not_joined_and_that_is_said(monkeypatch):
    """Of cameras that nothing makes take their pictures at the same time."""
    first, second = address_of('udp://@:5000'), address_of('udp://@:5001')
    with pytest.raises(SourceError, match='needs join'):
        source_of(first, second, print, log, print, NOT_JOINED)
    monkeypatch.setattr(LiveSource, 'why_silent', lambda self: '')
    taken = []
    joined = source_of(first, second, taken.append, log, print, 'top_bottom')
    picture = frame_of([np.full((48, 64), 90, np.uint8),
                        *np.full((2, 24, 32), 128, np.uint8)], 'yuv420p')
    for n in range(20):
        assert not joined.state.pictures
        for which, shift_ms in enumerate((0, 15)):
            joined.add(which, LivePicture(picture, 10**18 + (33 * n + shift_ms) * 10**6, 0.))
    assert joined.why_silent() == (
        f'no picture of {joined.name} is of the same time as one of the other, within 8 ms')
    assert not taken and joined.state.left_out == 40


def test_a_file_is_played_once(tmp_path):
    """Up to its last picture, which is told apart from a break."""
    path = tmp_path / 'ride.mkv'
    with sending(str(path), 'matroska', frames=12) as sender:
        assert sender.wait(TIMEOUT_S) == 0
    with reading(str(path)) as reader:
        reader.wait_until(reader.source.has_ended)
        assert reader.numbers == [*range(12)]
        assert (reader.state.status, reader.state.why) == (ENDED, 'it has ended')
        # Not faster than it was taken.
        stamps_ns = [one.stamp_ns for one in reader.pictures]
        assert stamps_ns[-1] - stamps_ns[0] > 0.8 * 11 / 30 * 1e9


@pytest.mark.parametrize('codec', ['libvpx', 'mpeg4', 'libx264'])
def test_a_recording_that_begins_between_two_key_pictures_waits_for_one(tmp_path, codec, caplog):
    """And says so, whoever decodes."""
    whole, cut = tmp_path / 'whole.mkv', tmp_path / 'cut.mkv'
    with sending(str(whole), 'matroska', codec, frames=24) as sender:
        assert sender.wait(TIMEOUT_S) == 0
    with av.open(whole) as there, av.open(cut, 'w') as here:
        stream = here.add_stream_from_template(there.streams.video[0])
        packets = [packet for packet in there.demux() if packet.size]
        keys = [number for number, packet in enumerate(packets) if packet.is_keyframe]
        assert keys[0] == 0 and len(keys) > 1
        for packet in packets[keys[1] - 3:]:
            packet.stream = stream
            here.mux(packet)
    with reading(str(cut)) as reader:
        reader.wait_until(reader.source.has_ended)
        assert reader.numbers == [*range(keys[1], 24)]
        assert [one.reason for one in reader.refused] == 3 * [NO_KEY]
    assert caplog.text.count('pictures passed over before a key picture: 3') == 1


def test_a_pipe_ends_where_its_writer_does():
    with sending('pipe:1', 'h264', frames=8, stdout=subprocess.PIPE) as sender:
        address = address_of('-')._replace(url=f'pipe:{sender.stdout.fileno()}')
        with reading(address) as reader:
            reader.wait_until(reader.source.has_ended)
            assert reader.numbers == [*range(8)]
            assert reader.state.status == ENDED


def test_a_sender_that_is_killed_comes_back(caplog):
    """At another size, as a camera may be set meanwhile."""
    url = rtmp_url()
    with reading(url, 'listen=1') as reader:
        for times, (size_wh, first) in enumerate((((256, 128), 0), ((192, 96), 1000)), 1):
            with sending(url, 'flv', size_wh=size_wh, first=first):
                assert reader.read(5)[-1].source.size_wh == size_wh
            reader.wait_until(lambda: reader.state.status == RECONNECTING)
            assert reader.state.connections == times
        check_stamps(reader)
        # The kill is no picture's fault.
        assert not reader.refused
        numbers = reader.numbers
        assert numbers[0] == 0 and numbers[-1] >= 1000
    said = [one.getMessage() for one in caplog.records]
    assert sum('trying again' in one for one in said) == 2, said


def test_a_stream_that_changes_its_size_goes_on(tmp_path, caplog):
    """Each beginning of H.264 says how large its pictures are."""
    parts = []
    for width in 128, 256:
        planes = [np.full((width // 2 // k, width // k), 100, np.uint8) for k in (1, 2, 2)]
        parts.append(encode(tmp_path / f'{width}.h264', [
            frame_of(planes, 'yuv420p') for _ in range(5)], options={'tune': 'zerolatency'}))
    both = tmp_path / 'both.h264'
    both.write_bytes(b''.join(part.read_bytes() for part in parts))
    with reading(str(both)) as reader:
        reader.wait_until(reader.source.has_ended)
        assert [one.source.size_wh for one in reader.pictures] == 5 * [(128, 64)] + 5 * [
            (256, 128)]
    assert f'{both}: the pictures are 256x128 now' in caplog.text


@pytest.mark.slow
def test_what_is_no_video_is_told_once_and_waited_past(caplog):
    """A port on which somebody sends something else; then the camera comes."""
    there, here = udp_urls()
    port = int(here.rpartition(':')[2])
    noise = np.random.default_rng(0)
    with reading(here) as reader, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        while reader.state.status != RECONNECTING:
            other.sendto(noise.bytes(1316), ('127.0.0.1', port))
            time.sleep(0.0002)
        assert reader.state.why == 'nothing that is video comes'
        with sending(there, 'mpegts'):
            reader.read(3)
        check_all_came(reader)
    assert caplog.text.count('trying again') == 1
    assert 'Traceback' not in caplog.text


@pytest.mark.parametrize('data, why', [
    (b'', 'what comes cannot be read as video'),
    (np.random.default_rng(0).bytes(500_000), 'what comes cannot be read as video')],
    ids=['nothing', 'noise'])
def test_a_pipe_without_video_ends(tmp_path, data, why):
    path = tmp_path / 'noise'
    path.write_bytes(data)
    with open(path, 'rb') as pipe:
        with reading(address_of('-')._replace(url=f'pipe:{pipe.fileno()}')) as reader:
            reader.wait_until(reader.source.has_ended)
            assert (reader.state.status, reader.state.why) == (ENDED, why)


@pytest.mark.parametrize('text, options, why, ends', [
    ('http://127.0.0.1:{port}/', '', 'it cannot be read: Connection refused', False),
    ('rtsp://127.0.0.1:{port}/', '', 'it cannot be read: Connection refused', False),
    ('nonsense://here', '', "this FFmpeg has no protocol 'nonsense'", True),
    ('http://127.0.0.1:{port}/', 'format=nonsense', "no container format 'nonsense'", True)])
def test_what_cannot_be_opened_is_said_in_a_line(text, options, why, ends, caplog):
    text = text.format(port=free_port(socket.SOCK_STREAM))
    with reading(text, options) as reader:
        reader.wait_until(lambda: reader.state.why)
        assert reader.state.why == why
        assert reader.state.status == (ENDED if ends else RECONNECTING)
    said, = caplog.records
    assert said.getMessage() == f'{text}: {why}' + ('' if ends else '; trying again')


def test_a_device_that_is_not_there_is_waited_for():
    with reading('/dev/video981') as reader:
        reader.wait_until(lambda: reader.state.why)
        assert reader.state.why == 'it cannot be read: No such file or directory'
        assert reader.state.status == RECONNECTING


def test_pictures_of_a_device_come_with_its_clock():
    device = os.environ.get('SPH_STAB_ROS_TEST_DEVICE')
    if not device:
        pytest.skip('no V4L2 device is named in SPH_STAB_ROS_TEST_DEVICE')
    with reading(device) as reader:
        assert address_of(device).kind is Kind.DEVICE
        reader.read(10)
        check_stamps(reader)
        assert reader.state.clock == 'device'


@pytest.mark.slow
def test_datagrams_that_stop_are_waited_for(caplog):
    """Nobody tells of it: a while without any must pass."""
    there, here = udp_urls()
    with reading(here) as reader:
        for first in 0, 1000:
            with sending(there, 'mpegts', first=first):
                reader.read(10)
            reader.wait_until(lambda: reader.state.status == RECONNECTING)
            assert reader.state.why == 'nothing that is video comes'
        check_stamps(reader)
    assert caplog.text.count('nothing that is video comes; trying again') == 2


def test_without_pyav_it_is_said_what_to_install(tmp_path):
    (tmp_path / 'av.py').write_text('raise ImportError')
    script = ('from sph_stab_ros.live.address import address_of, SourceError\n'
              'from sph_stab_ros.live.source import LiveSource\n'
              'try:\n    LiveSource(address_of("-"), print, None, print)\n'
              'except SourceError as error:\n    print(error)')
    said = subprocess.run(
        [sys.executable, '-c', script], text=True, capture_output=True, check=True,
        env={**os.environ, 'PYTHONPATH': os.pathsep.join([str(tmp_path), *sys.path])})
    assert said.stdout == "a source needs PyAV: pip install 'av>=16,<19'\n"
