# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The times of recordings whose clocks are set, false or missing, and of videos made of them."""

from fractions import Fraction
import warnings

from hypothesis import given, HealthCheck, settings, strategies as st
import numpy as np
import pytest
from sph_stab_ros import replay
from sph_stab_ros.geometry.trajectory import read_tum
from sph_stab_ros.images.codec import encode_jpeg
from sph_stab_ros.recording import open_recording
from sph_stab_ros.recording.bag_writer import BagWriter
from tiny_recordings import (
    IMAGE_TOPIC, PERIOD_NS, stamps_of, START_NS, textured_sphere, write_video)

av = pytest.importorskip('av')

NS_PER_S = 10**9
COUNT = 12
JPEG = encode_jpeg(textured_sphere(128))
CLOCK_90_KHZ_NS = NS_PER_S / 90000


def write_stamped(path, stamps_ns, received_ns=None):
    """Write a bag of one picture under these header stamps; return the path."""
    with BagWriter(path) as bag:
        for stamp_ns, ns in zip(stamps_ns, stamps_of(len(stamps_ns)) if received_ns is None
                                else received_ns):
            bag.write(IMAGE_TOPIC, bag.type('sensor_msgs/msg/CompressedImage')(
                header=bag.header(int(stamp_ns), 'camera'), format='jpeg', data=JPEG), int(ns))
    return path


def stepped(by_ns, at=COUNT // 2):
    """Return stamps of a clock that is set."""
    stamps_ns = stamps_of(COUNT)
    stamps_ns[at:] += by_ns
    return stamps_ns


def false(by_ns, at=COUNT // 2):
    """Return stamps of which one is false."""
    stamps_ns = stamps_of(COUNT)
    stamps_ns[at] += by_ns
    return stamps_ns


# Stamps, those expected where they are not the same, a word of the only warning.
CASES = {
    'good': (stamps_of(COUNT), None, None),
    'from 1970': (np.concatenate((stamps_of(5) - START_NS + 5, stamps_of(COUNT)[5:])), None,
                  '53.9 years'),
    'back 3 s': (stepped(-3 * NS_PER_S), None, '-3.000 s'),
    'forward 3 s': (stepped(3 * NS_PER_S), None, '+3.000 s'),
    'to 1970': (stepped(-START_NS + 5), None, 'years'),
    'outlier': (false(5 * NS_PER_S), None, '+5.000 s'),
    'past outlier': (false(-5 * NS_PER_S), None, '-5.000 s'),
    'first false': (false(-START_NS + 5, 0), None, 'single'),
    'small outlier': (false(NS_PER_S // 5), None, '+0.200 s'),
    'equal stamps': (false(-PERIOD_NS), None, 'not later'),
    'first zero': (stamps_of(COUNT) - START_NS, stamps_of(COUNT) - START_NS, 'zero'),
    'some zero': (np.where(np.isin(np.arange(COUNT), (4, 7)), 0, stamps_of(COUNT)),
                  stamps_of(COUNT), 'zero'),
    'the first half zero': (np.where(np.arange(COUNT) < 6, 0, stamps_of(COUNT) - START_NS),
                            stamps_of(COUNT) - START_NS, 'zero'),
    'all zero': (np.zeros(COUNT, np.int64), stamps_of(COUNT), 'times of receipt'),
    'standing still': (np.full(COUNT, START_NS), None, 'not later'),
}


@pytest.mark.parametrize('name', CASES)
def test_pictures_keep_their_pace_and_stamps(tmp_path, caplog, name):
    """Stamps stay but for missing ones; pictures are a period apart; one warning says why."""
    stamps_ns, expected_ns, word = CASES[name]
    frames = list(open_recording(write_stamped(tmp_path / 'bag', stamps_ns)).frames())
    assert [frame.stamp_ns for frame in frames] == list(
        stamps_ns if expected_ns is None else expected_ns)
    assert np.ptp(np.diff([frame.time_ns for frame in frames])) <= 1
    messages = [record.getMessage() for record in caplog.records]
    assert len(messages) == (word is not None)
    assert all(word in message for message in messages)


@pytest.mark.parametrize('name', ['from 1970', 'back 3 s', 'outlier', 'first zero'])
def test_results_are_whole_whatever_the_clock_did(tmp_path, name):
    """A video at the pictures' pace, a bag and a trajectory with their stamps."""
    stamps_ns = CASES[name][0]
    bag = write_stamped(tmp_path / 'in', stamps_ns)
    for out in 'out.mp4', 'out':
        assert replay.main(
            [str(bag), str(tmp_path / out), '--trajectory', str(tmp_path / f'{out}.tum')]) == 0
    times_ns = [frame.time_ns for frame in open_recording(tmp_path / 'out.mp4').frames()]
    assert len(times_ns) == COUNT
    assert np.abs(np.diff(times_ns) - PERIOD_NS).max() <= 2 * CLOCK_90_KHZ_NS
    written = open_recording(tmp_path / 'out', 'stabilized/image/compressed')
    assert [frame.stamp_ns for frame in written.frames()] == list(stamps_ns)
    lines = (tmp_path / 'out.tum').read_text().splitlines()
    assert [round(Fraction(line.split()[0]) * NS_PER_S) for line in lines] == list(stamps_ns)
    assert len(read_tum(tmp_path / 'out.tum')) <= COUNT


def test_a_pause_of_both_clocks_stays_one(tmp_path, caplog):
    """Half a minute without a picture is no step."""
    stamps_ns = stepped(30 * NS_PER_S)
    bag = write_stamped(tmp_path / 'bag', stamps_ns, stamps_ns + 5)
    assert [frame.time_ns for frame in open_recording(bag).frames()] == list(stamps_ns)
    assert not caplog.records


@settings(max_examples=15, deadline=None,
          suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.lists(st.integers(-2**31 * NS_PER_S, 2**32 * NS_PER_S)
                | st.integers(0, 10 * NS_PER_S), min_size=1, max_size=20))
def test_no_times_stop_the_video_writer(tmp_path, stamps_ns):
    """All pictures are in the file, one after the other, and the file is small."""
    path = write_video(tmp_path / 'a.mp4', len(stamps_ns) * [textured_sphere(64)], stamps_ns)
    assert path.stat().st_size < 10**5
    with av.open(str(path)) as container:
        times_s = [frame.time for frame in container.decode(video=0)]
    assert len(times_s) == len(stamps_ns) and np.all(np.diff(times_s) > 0)
    assert times_s[0] == 0


def encode(path, codec, rate=20, bframes=0):
    """Write COUNT different pictures, the container's times being multiples of the period."""
    with av.open(str(path), 'w') as container:
        options = {'bf': str(bframes), 'g': '12'} if codec == 'libx264' else {}
        stream = container.add_stream(codec, rate=rate, options=options)
        stream.width, stream.height = 128, 64
        stream.pix_fmt = 'yuvj420p' if codec == 'mjpeg' else 'yuv420p'
        for number in range(COUNT):
            grey = np.full((64, 128, 3), 20 * number, np.uint8)
            picture = av.VideoFrame.from_ndarray(grey, format='bgr24')
            picture.pts = number
            picture.time_base = Fraction(1, rate)
            container.mux(stream.encode(picture))
        container.mux(stream.encode())
    return path


@pytest.mark.parametrize('name, codec, bframes, warning', [
    ('a.h264', 'libx264', 0, 'has no times: 20 pictures a second are assumed'),
    ('a.h264', 'libx264', 2, 'has no times: 20 pictures a second are assumed'),
    ('a.avi', 'libx264', 2, 'no times of presentation: the pictures are taken in order, at 20'),
    ('a.avi', 'libx264', 0, 'no times of presentation'),
    ('a.avi', 'mjpeg', 0, 'no times of presentation'),
    ('a.mkv', 'libx264', 2, None),
])
def test_streams_without_times_are_read_in_order_at_their_rate(
        tmp_path, caplog, name, codec, bframes, warning):
    """In the order of presentation, from zero on; what is assumed is said."""
    with warnings.catch_warnings():
        warnings.simplefilter('ignore')
        path = encode(tmp_path / name, codec, bframes=bframes)
    frames = list(open_recording(path).frames())
    assert [frame.stamp_ns for frame in frames] == [i * NS_PER_S // 20 for i in range(COUNT)]
    levels = [frame.image.mean() for frame in frames]
    assert np.all(np.diff(levels) > 10)
    messages = [record.getMessage() for record in caplog.records]
    assert len(messages) == (warning is not None)
    assert all(warning in message for message in messages)


def test_the_rate_of_raw_motion_jpeg_is_assumed(tmp_path, caplog):
    """JPEG files one after the other."""
    (tmp_path / 'a.mjpeg').write_bytes(COUNT * JPEG.tobytes())
    frames = list(open_recording(tmp_path / 'a.mjpeg').frames())
    assert [frame.stamp_ns for frame in frames] == [i * NS_PER_S // 25 for i in range(COUNT)]
    assert 'has no times: 25 pictures a second are assumed' in caplog.text


@pytest.mark.parametrize('name, first_ns', [
    ('clock/from1970', 5 * NS_PER_S), ('clock/back3s', 1_700_000_000 * NS_PER_S),
    ('clock/outlier', 1_700_000_000 * NS_PER_S), ('zerostamp/first_zero', 0),
    ('raw_h264/theta.h264', 0), ('avi_without_pts/dvr_b.avi', 0)])
def test_what_users_have_reported_is_read_at_its_pace(shared_data, caplog, name, first_ns):
    """Forty pictures at 30 Hz each, and one line."""
    path = shared_data / 'reports' / name
    if not path.exists():
        pytest.skip('this report is not there')
    frames = list(open_recording(path).frames())
    assert len(frames) == 40 and frames[0].stamp_ns == first_ns
    times_ns = np.array([frame.time_ns for frame in frames])
    assert np.abs(times_ns - times_ns[0] - np.arange(40) * NS_PER_S / 30).max() < 1000
    assert len(caplog.records) == 1
