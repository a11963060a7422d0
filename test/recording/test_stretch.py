# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Stretches of recordings: the same pictures as when all is read, from the key picture before."""

from unittest import mock

from hypothesis import given, HealthCheck, settings, strategies as st
import numpy as np
import pytest
from sph_stab_ros.evaluate import main as evaluate
from sph_stab_ros.geometry.conventions import NS_PER_S
from sph_stab_ros.geometry.trajectory import read_tum
from sph_stab_ros.recording import open_recording, RecordingError
from sph_stab_ros.replay import main as replay
from tiny_recordings import PERIOD_NS, stamps_of

av = pytest.importorskip('av')
videos = pytest.importorskip('tiny_videos')

COUNT, GROUP = 60, 15
GROUPS = {'g': str(GROUP), 'bf': '3'}
OPEN = {**GROUPS, 'x264-params': 'open-gop=1:b-pyramid=normal'}
IRREGULAR_MS = np.cumsum(np.random.default_rng(0).integers(5, 90, COUNT))
# Containers, codecs and their options, times in ms, and how many pictures may be decoded for one.
KINDS = {
    'mp4': ('a.mp4', 'libx264', GROUPS, None, 45),
    'open groups': ('a.mp4', 'libx264', OPEN, None, 45),
    'open groups, mkv': ('a.mkv', 'libx264', OPEN, None, 45),
    'variable rate': ('a.mp4', 'libx264', GROUPS, IRREGULAR_MS, 45),
    'variable rate, mkv': ('a.mkv', 'libx264', GROUPS, IRREGULAR_MS, 45),
    'transport stream': ('a.ts', 'libx264', GROUPS, None, 45),
    'intra refresh': ('a.mp4', 'libx264', {'g': '15', 'x264-params': 'intra-refresh=1'}, None, 60),
    'one key picture': ('a.mp4', 'libx264', {'g': '1000', 'bf': '2'}, None, 61),
    'hevc, open groups': ('a.mp4', 'libx265', {
        'x265-params': 'keyint=15:open-gop=1:bframes=4:log-level=none'}, None, 45),
    'avi': ('a.avi', 'libx264', GROUPS, None, 61),
    'without times': ('a.h264', 'libx264', GROUPS, None, 61),
}


def pictures():
    """Return pictures each of which is another."""
    world = np.random.default_rng(0).integers(0, 256, (64, 128, 3)).astype(np.uint8)
    return [videos.bgr_frame(np.roll(world, 3 * number, axis=1)) for number in range(COUNT)]


@pytest.fixture(scope='module')
def files(tmp_path_factory):
    """Return the path of a video of each kind, and its pictures with their times."""
    found = {}
    for kind, (name, codec, options, pts_ms, _) in KINDS.items():
        path = tmp_path_factory.mktemp('stretch') / name
        videos.encode(path, pictures(), codec, options, pts_ms)
        found[kind] = path, read(path)
    return found


def read(path, *stretch):
    """Return the times and pictures of a recording or of a stretch of it."""
    recording = open_recording(path, None, *stretch)
    found = [(frame.time_ns, frame.grey(0).tobytes()) for frame in recording.frames()]
    assert not recording.skipped
    return found


def within(timed, start_s, end_s):
    """Return those of pictures with times that are in a stretch."""
    first_ns = timed[0][0]
    return [(ns, picture) for ns, picture in timed
            if round(start_s * NS_PER_S) <= ns - first_ns < end_s * NS_PER_S]


@pytest.mark.parametrize('kind', KINDS)
@settings(max_examples=12, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(start_s=st.floats(0, 2.35), length_s=st.floats(0.05, 3))
def test_a_stretch_has_the_pictures_that_it_has_when_all_are_read(files, kind, start_s, length_s):
    path, everything = files[kind]
    expected = within(everything, start_s, start_s + length_s)
    if expected:
        assert read(path, start_s, start_s + length_s) == expected
    else:
        with pytest.raises(RecordingError, match='no picture from'):
            read(path, start_s, start_s + length_s)


@pytest.mark.parametrize('kind', KINDS)
def test_borders_are_exact(files, kind):
    """The first picture is in, that at the end is out, to the nanosecond."""
    path, everything = files[kind]
    for start, end in ((0, 1), (7, 8), (GROUP, GROUP + 3), (GROUP - 1, GROUP + 1), (50, COUNT)):
        start_s, end_s = ((everything[at][0] - everything[0][0]) / NS_PER_S
                          if at < COUNT else 1e6 for at in (start, end))
        assert read(path, start_s, end_s) == everything[start:end]


@pytest.mark.parametrize('kind', KINDS)
def test_no_more_is_decoded_than_from_a_key_picture_on(files, kind):
    """To find the first one some are decoded as well."""
    path, everything = files[kind]
    start_s = (everything[50][0] - everything[0][0]) / NS_PER_S
    with mock.patch('sph_stab_ros.recording.video_stream.Stamp') as stamp:
        stamp.side_effect = lambda ns: mock.Mock(stamp_ns=ns, received_ns=None)
        pictures = open_recording(path, None, start_s).frames()
        next(pictures)
        decoded = stamp.call_count
        pictures.close()
    assert decoded <= KINDS[kind][-1]


def test_nothing_is_missed_by_what_is_said(files, caplog):
    """A stretch is no truncated video, wherever it was looked for."""
    for kind in ('mp4', 'intra refresh', 'transport stream'):
        for start_s in (1., 2.3):
            read(files[kind][0], start_s, start_s + 0.2)
            read(files[kind][0], start_s)
    assert not caplog.records


def test_damage_before_a_stretch_is_not_its_own(tmp_path, caplog):
    path = videos.encode(tmp_path / 'a.mp4', pictures(), options={'g': '15', 'bf': '0'})
    data = bytearray(path.read_bytes())
    start = data.index(b'mdat') + 4 + 200
    data[start:start + 2000] = bytes(2000)
    path.write_bytes(data)
    whole = open_recording(path)
    assert len(list(whole.frames())) < COUNT or caplog.records or whole.skipped
    caplog.clear()
    stretch = open_recording(path, None, 1.9)
    assert len(list(stretch.frames())) == COUNT - 48
    assert not stretch.skipped


@pytest.mark.parametrize('kind', ['mp4', 'variable rate', 'transport stream'])
def test_how_many_pictures_there_will_be_is_known_about(files, kind):
    path, everything = files[kind]
    for stretch in ((0.5, 1.), (1., 1e6), (0., 0.8)):
        expected = len(within(everything, *stretch))
        assert open_recording(path, None, *stretch).frame_count == pytest.approx(expected, abs=5)


@pytest.mark.parametrize('start, end', [(0, 12), (3, 7), (5, 12), (11, 12)])
def test_of_bags_too(turning_bag, start, end):
    """From the first picture on, whatever clock its stamp is of."""
    stamps_ns = stamps_of(12)
    recording = open_recording(turning_bag, None, start * PERIOD_NS / NS_PER_S,
                               end * PERIOD_NS / NS_PER_S)
    for _ in range(2):
        assert [f.stamp_ns for f in recording.frames()] == stamps_ns[start:end].tolist()


@pytest.mark.parametrize('command', [replay, evaluate])
def test_commands_take_a_stretch(command, turning_video, turning, tmp_path, capsys):
    """Beside --max-frames, which counts from the start."""
    args = ['--start', '0.1', '--end', '0.3']
    if command is replay:
        for more, count in (([], 6), (['--max-frames', '4'], 4)):
            assert replay([str(turning_video), '--trajectory', str(tmp_path / 'a.tum'), '--force',
                           *args, *more]) == 0
            trajectory = read_tum(tmp_path / 'a.tum')
            assert len(trajectory) == count
            assert trajectory.stamps_ns[0] / NS_PER_S == pytest.approx(0.1, abs=1e-4)
            turns = turning[1][3:3 + count]
            off = (turns[0].inv() * turns).inv() * trajectory.rotations
            assert np.rad2deg(off.magnitude()).max() < 0.3
    else:
        args = ['--start', '0.03', '--end', '0.36']
        assert evaluate([str(turning_video), '--inject', '1', '--estimators', 'anchored', *args,
                         '--json', str(tmp_path / 'a.json')]) == 0
        assert '"frames": 10' in (tmp_path / 'a.json').read_text()


@pytest.mark.parametrize('args', [
    ['--start', '-1'], ['--start', 'x'], ['--end', '0'], ['--start', '2', '--end', '1'],
    ['--start', 'nan'], ['--end', 'inf'], ['--start', '1', '--end', '1']])
@pytest.mark.parametrize('command', [replay, evaluate])
def test_a_wrong_stretch_ends_with_2_and_one_line(turning_video, capsys, command, args):
    with pytest.raises(SystemExit) as end:
        command([str(turning_video), *args])
    assert end.value.code == 2
    assert len(capsys.readouterr().err.splitlines()) == 1


def test_a_stretch_behind_the_end_is_named(turning_video, turning_bag, tmp_path, capsys):
    """And leaves nothing behind."""
    for recording in (turning_video, turning_bag):
        assert replay([str(recording), str(tmp_path / 'out.mp4'), '--start', '5']) == 1
        error, = capsys.readouterr().err.splitlines()
        assert error.endswith('has no picture from 5 s on, the last one read is at 0.367 s')
    assert not list(tmp_path.iterdir())
