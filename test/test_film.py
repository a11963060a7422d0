# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What a video may be besides: encoded otherwise, directed, quick; and stills of it."""

import cv2
import pytest

from sph_stab_ros.batch.__main__ import main as batch
from sph_stab_ros.geometry.conventions import NS_PER_S
from sph_stab_ros.recording import open_recording
from sph_stab_ros.replay import main

av = pytest.importorskip('av')


def film(recording, out, *args):
    """Write a video; return its Frames."""
    assert main([str(recording), str(out), *map(str, args)]) == 0
    return list(open_recording(out).frames())


def difference(a, b):
    """Return by how much two pictures differ on average, but for what encoding changes."""
    return float(cv2.absdiff(*(cv2.blur(picture, (8, 8)) for picture in (a, b))).mean())


@pytest.mark.parametrize('codec, name, encoder', [
    ('h264', 'h264', 'libx264'), ('h265', 'hevc', 'libx265'), ('av1', 'av1', 'libsvtav1')])
def test_each_codec_shows_the_same(turning_bag, tmp_path, codec, name, encoder, capfd):
    """In the same colours, and as a sphere; a worse quality is smaller."""
    if encoder not in av.codecs_available:
        pytest.skip(f'PyAV has no {encoder}')
    usual = film(turning_bag, tmp_path / 'usual.mp4')
    good = film(turning_bag, tmp_path / 'good.mp4', '--codec', codec)
    film(turning_bag, tmp_path / 'small.mp4', '--codec', codec, '--quality', '45')
    assert capfd.readouterr().err == ''
    with av.open(str(tmp_path / 'good.mp4')) as container:
        stream = container.streams.video[0]
        # PyAV names decoders.
        assert stream.codec_context.codec.canonical_name == name
        if codec == 'h265':
            assert stream.codec_context.codec_tag == 'hvc1'
    assert b'GSpherical' in (tmp_path / 'good.mp4').read_bytes()
    assert (tmp_path / 'small.mp4').stat().st_size < (tmp_path / 'good.mp4').stat().st_size
    for a, b in zip(usual, good, strict=True):
        assert a.stamp_ns == b.stamp_ns and difference(a.image, b.image) < 4


@pytest.mark.parametrize('codec', ['h264', 'h265', 'av1'])
@pytest.mark.parametrize('count', [1, 2, 3])
def test_the_shortest_films_are_whole(turning_bag, tmp_path, codec, count):
    """Also those that are too short for an encoder to change the order of pictures."""
    shown = film(turning_bag, tmp_path / 'short.mp4', '--codec', codec, '--max-frames', count)
    usual = film(turning_bag, tmp_path / 'usual.mp4')[:count]
    for a, b in zip(shown, usual, strict=True):
        assert a.stamp_ns == b.stamp_ns and difference(a.image, b.image) < 4


def test_a_slower_preset_makes_another_file(turning_bag, tmp_path):
    """The encoder is told."""
    for preset in ('ultrafast', 'slow'):
        film(turning_bag, tmp_path / f'{preset}.mp4', '--preset', preset)
    assert (tmp_path / 'ultrafast.mp4').read_bytes() != (tmp_path / 'slow.mp4').read_bytes()


def test_a_hyperlapse_is_every_nth_picture_n_times_as_fast(turning_video, tmp_path):
    """Each as in the whole film; the trajectory is that of all."""
    whole = film(turning_video, tmp_path / 'whole.mp4', '--smoothing', 'follow')
    fast = film(turning_video, tmp_path / 'fast.mp4', '--smoothing', 'follow', '--hyperlapse', '3',
                '--trajectory', tmp_path / 'all.tum')
    assert len((tmp_path / 'all.tum').read_text().splitlines()) == len(whole) == 12
    for a, b in zip(whole[::3], fast, strict=True):
        assert b.stamp_ns == pytest.approx(a.stamp_ns / 3, abs=NS_PER_S / 90000)
        nearest = min(whole, key=lambda one, b=b: difference(one.image, b.image))
        assert nearest.stamp_ns == a.stamp_ns


def test_stills_are_pictures_of_the_film(turning_video, tmp_path):
    """So many seconds apart, by the names of their times."""
    shown = film(turning_video, tmp_path / 'film.mp4', '--smoothing', 'follow', '--stills', '0.1')
    stills = sorted((tmp_path / 'film_stills').iterdir())
    assert [path.name for path in stills] == [
        f'000000.{milliseconds}.jpg' for milliseconds in ('000', '100', '200', '300')]
    for path, frame in zip(stills, shown[::3], strict=True):
        still = cv2.imread(str(path))
        nearest = min(shown, key=lambda one, still=still: difference(one.image, still))
        assert nearest.stamp_ns == frame.stamp_ns


def test_a_directed_film_looks_where_it_is_told(turning_video, tmp_path):
    """From the front to the left, as views that look there do."""
    (tmp_path / 'film.yaml').write_text(
        '- {time_s: 0, yaw_deg: 0}\n- {time_s: 0.3, yaw_deg: 90, pitch_deg: 10}\n')
    directed = film(turning_video, tmp_path / 'directed.mp4', '--directions',
                    tmp_path / 'film.yaml')
    front = film(turning_video, tmp_path / 'front.mp4', '--view', '0,0,0,90')
    left = film(turning_video, tmp_path / 'left.mp4', '--view', '90,10,0,90')
    assert len(directed) == 12 and directed[0].image.shape == left[0].image.shape
    assert difference(directed[0].image, front[0].image) < 4
    assert difference(directed[-1].image, left[-1].image) < 4
    assert difference(directed[6].image, front[6].image) > 10
    assert difference(directed[6].image, left[6].image) > 10


@pytest.mark.parametrize('args, reason', [
    (('out', '--hyperlapse', '2'), '--hyperlapse needs an .mp4 or .mov as OUT'),
    (('--stills', '2'), '--stills needs'), (('out', '--codec', 'av1'), '--codec needs'),
    (('out.mp4', '--hyperlapse', '1'), 'within 2 and 1000'),
    (('out.mp4', '--stills', '0'), 'above 0'), (('out.mp4', '--codec', 'vp9'), 'codec'),
    (('out.mp4', '--quality', '52'), 'quality must lie within 0 and 51'),
    (('out.mp4', '--preset', 'warp'), 'preset of h264 is one of ultrafast'),
    (('out.mp4', '--codec', 'av1', '--preset', 'slow'), 'preset of av1 is one of 13'),
    (('out.mp4', '--directions', 'none.yaml'), 'none.yaml cannot be read: No such file'),
    (('out.mp4', '--directions', 'a/b', '--view', '0,0,0,90'), 'leave out --view')])
def test_a_wrong_call_ends_with_2_and_one_line(
        turning_video, tmp_path, monkeypatch, capsys, args, reason):
    """Nothing is begun."""
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as end:
        main([str(turning_video), *args])
    error = capsys.readouterr().err
    assert end.value.code == 2 and reason in error and error.count('\n') == 1
    assert not list(tmp_path.iterdir())


def test_a_video_has_no_topic_of_directions(turning_video, tmp_path, capsys):
    """It is said in one line."""
    assert main([str(turning_video), str(tmp_path / 'out.mp4'), '--directions', 'where']) == 1
    assert capsys.readouterr().err == (
        'replay: video.mp4 has no topic where of geometry_msgs/msg/QuaternionStamped\n')


def test_batch_makes_films_too(turning_bag, tmp_path, capsys):
    """What they are is a part of what results are of."""
    (tmp_path / 'film.yaml').write_text('- {time_s: 0, yaw_deg: 90}\n')
    args = [str(turning_bag), '--out', str(tmp_path / 'out'), '--hyperlapse', '4', '--directions',
            str(tmp_path / 'film.yaml')]
    assert batch(args) == 0
    shown = list(open_recording(tmp_path / 'out' / 'bag' / 'stabilized.mp4').frames())
    assert len(shown) == 3 and shown[0].image.shape == (480, 640, 3)
    (tmp_path / 'film.yaml').write_text('- {time_s: 0, yaw_deg: 91}\n')
    assert batch(args) == 1
    assert 'made with other options' in capsys.readouterr().out
