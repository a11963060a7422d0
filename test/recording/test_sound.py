# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The sound of videos is copied, not encoded anew, and stays with the pictures."""

import numpy as np
import pytest
from sph_stab_ros.recording import open_recording, RecordingError
from sph_stab_ros.replay import main as replay
from tiny_recordings import textured_sphere

av = pytest.importorskip('av')
videos = pytest.importorskip('tiny_videos')

SECONDS = 4
COUNT = SECONDS * videos.RATE
RATE = videos.SOUND_RATE
# A tenth of the sound's own level.
QUIET = 0.02


def video(path, codec='aac', **options):
    """Write a video of still pictures with sound; return the path."""
    picture = videos.bgr_frame(textured_sphere(128))
    return videos.encode(path, COUNT * [picture], sound=videos.chirp(SECONDS), sound_codec=codec,
                         options={'g': '25', 'bf': '2'}, **options)


def packets(path, track=0):
    """Return times and data of a track's packets."""
    with av.open(str(path)) as container:
        return [(float(p.pts * p.time_base), bytes(p))
                for p in container.demux(container.streams.audio[track]) if p.size]


def call(*args):
    """Run the command."""
    assert replay([str(one) for one in args]) == 0


@pytest.mark.parametrize('name, codec, out', [
    ('a.mp4', 'aac', 'out.mp4'), ('a.mp4', 'aac', 'out.mov'), ('a.mkv', 'aac', 'out.mp4'),
    ('a.ts', 'aac', 'out.mp4'), ('a.mkv', 'libopus', 'out.mp4'),
    ('a.mp4', 'libmp3lame', 'out.mov'), ('a.mkv', 'flac', 'out.mp4'),
    ('a.mov', 'pcm_s16le', 'out.mov'), ('a.mkv', 'ac3', 'out.mp4'),
    ('a.avi', 'libmp3lame', 'out.mp4')])
def test_all_packets_are_copied(tmp_path, name, codec, out):
    """Byte by byte, at their times, whatever the containers."""
    path = video(tmp_path / name, codec)
    call(path, tmp_path / out)
    expected, found = packets(path), packets(tmp_path / out)
    first = next(iter(open_recording(path).frames())).stamp_ns / 1e9
    whole, copied = (b''.join(data for _, data in one) for one in (expected, found))
    if name.endswith('.ts'):
        # Their headers stand in the index instead.
        assert len(found) == len(expected)
        assert all(data.endswith(inner) for (_, data), (_, inner) in zip(expected, found))
    else:
        assert copied == whole
    for at in (0, -1):
        # Matroska counts in milliseconds.
        assert found[at][0] == pytest.approx(expected[at][0] - first, abs=0.002)


@pytest.mark.parametrize('name', ['a.mp4', 'a.mkv', 'a.ts'])
@pytest.mark.parametrize('args, start_s, end_s', [
    (['--start', '1'], 1, None), (['--start', '1.02', '--end', '2.5'], 1.04, 2.52),
    (['--max-frames', '20'], 0, 0.8), (['--start', '3', '--max-frames', '5'], 3, 3.2),
    (['--end', '0.1'], 0, 0.12)])
def test_of_a_stretch_the_same_stretch_is_heard(tmp_path, name, args, start_s, end_s):
    """In step with the pictures to the sample, from the first sample on."""
    path = video(tmp_path / name)
    call(path, tmp_path / 'out.mp4', *args)
    lead_s = next(iter(open_recording(path).frames())).stamp_ns / 1e9
    with av.open(str(path)) as container:
        parts = [(frame.time, frame.to_ndarray()[0]) for frame in container.decode(audio=0)]
    expected = np.zeros(round(5 * RATE))
    for time_s, values in parts:
        begin = round((time_s - lead_s - start_s) * RATE)
        if begin + len(values) > 0 and begin < len(expected):
            expected[max(begin, 0):begin + len(values)] = values[max(-begin, 0):]
    found = videos.heard_in(tmp_path / 'out.mp4')
    # Up to a packet is heard after the last picture, and all where there is no end.
    end_s = end_s or parts[-1][0] + len(parts[-1][1]) / RATE - lead_s
    assert -0.03 < len(found) / RATE - (end_s - start_s) < 0.05
    count = min(len(found), round((end_s - start_s - 0.02) * RATE))
    off = expected[:count] - found[:count]
    if name == 'a.mkv':
        # Its times in milliseconds leave gaps of some samples.
        assert np.median(np.abs(off)) < 1e-4
    else:
        # Noise in AAC is made up by the decoder.
        assert np.median(np.abs(off)) < 1e-6 and np.abs(off).max() < QUIET


def test_sound_that_begins_later_still_does(tmp_path):
    path = video(tmp_path / 'a.mp4', sound_start_s=1.)
    call(path, tmp_path / 'out.mp4')
    expected, found = (videos.heard_in(one) for one in (path, tmp_path / 'out.mp4'))
    assert np.array_equal(expected, found) and not found[:RATE * 9 // 10].any()


def test_all_tracks_are_copied_with_views_too(tmp_path):
    path = video(tmp_path / 'a.mp4', tracks=2)
    for number, option in enumerate(('--view=0,0,0,90', '--side-by-side')):
        out = tmp_path / f'{number}.mp4'
        call(path, out, option, '--max-frames', '10')
        for track in range(2):
            whole = [data for _, data in packets(path, track)]
            copied = [data for _, data in packets(out, track)]
            assert copied == whole[:len(copied)] and len(copied) >= 0.4 * RATE / 1024


@pytest.mark.parametrize('codec, out', [
    ('libopus', 'out.mov'), ('flac', 'out.mov'), ('pcm_alaw', 'out.mp4')])
def test_what_the_file_cannot_hold_is_left_out_and_named(tmp_path, caplog, codec, out):
    """Pictures are written all the same."""
    path = video(tmp_path / ('a.mov' if codec == 'pcm_alaw' else 'a.mkv'), codec)
    call(path, tmp_path / out, '--max-frames', '5')
    record, = caplog.records
    assert record.getMessage().startswith(f'{path.name}: its sound is ')
    assert record.getMessage().endswith('files cannot hold, and is left out')
    with av.open(str(tmp_path / out)) as container:
        assert not container.streams.audio
        assert len(list(container.decode(video=0))) == 5


@pytest.mark.parametrize('unknown', (b'mp4a', b'avc1'))
def test_an_unknown_codec_is_named(tmp_path, caplog, unknown):
    """Of the sound it costs the sound; what FFmpeg cannot decode would end the process."""
    path = video(tmp_path / 'a.mp4')
    path.write_bytes(path.read_bytes().replace(unknown, b'zzzz').replace(b'esds', b'zzzz'))
    if unknown == b'mp4a':
        call(path, tmp_path / 'out.mp4')
        assert 'its sound is of an unknown codec, which mp4 files cannot hold' in caplog.text
    else:
        with pytest.raises(RecordingError, match='of a codec that FFmpeg does not know'):
            open_recording(path)


def test_without_sound_there_is_none(turning_video, tmp_path, caplog):
    call(turning_video, tmp_path / 'out.mp4')
    with av.open(str(tmp_path / 'out.mp4')) as container:
        assert not container.streams.audio
    assert not caplog.records


@pytest.mark.parametrize('name', ['a.mkv', 'a.ts'])
def test_of_damaged_sound_the_rest_is_copied(tmp_path, name):
    """And pictures in any case."""
    path = video(tmp_path / name)
    data = bytearray(path.read_bytes())
    rng = np.random.default_rng(0)
    for at in rng.integers(len(data) // 4, len(data), 40):
        data[at:at + 20] = rng.bytes(20)
    path.write_bytes(data)
    call(path, tmp_path / 'out.mp4')
    assert len(packets(tmp_path / 'out.mp4')) > 20
    with av.open(str(tmp_path / 'out.mp4')) as container:
        assert len(list(container.decode(video=0))) > 20


def test_memory_does_not_grow_with_silence(tmp_path):
    """Sound that ends early holds up no picture: all are in the file."""
    picture = videos.bgr_frame(textured_sphere(128))
    path = videos.encode(tmp_path / 'a.mp4', COUNT * [picture], sound=videos.chirp(0.5))
    call(path, tmp_path / 'out.mp4')
    with av.open(str(tmp_path / 'out.mp4')) as container:
        assert len(list(container.decode(video=0))) == COUNT
    heard = videos.heard_in(tmp_path / 'out.mp4')
    assert np.abs(heard[:len(heard) // 2]).max() > QUIET
