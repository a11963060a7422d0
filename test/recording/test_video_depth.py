# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""
Ten bits, in and out: what is finer than eight bits stays, and PQ and HLG with it.

The witness of what a picture shows is libswscale, told by PyAV what it is to convert, in 16 bits.
"""

import numpy as np
import pytest
from sph_stab_ros.images.colour import Colour, MATRICES
from sph_stab_ros.recording import open_recording, video_writer
from sph_stab_ros.replay import main as replay

av = pytest.importorskip('av')
reformatter = pytest.importorskip('av.video.reformatter')
videos = pytest.importorskip('tiny_videos')

LIMITED, FULL, PQ, HLG = 1, 2, 16, 18
# Matrix, range, primaries and transfer characteristic.
TAGS = [(1, LIMITED, 1, 1), (6, FULL, 6, 6), (9, LIMITED, 9, PQ), (9, FULL, 9, HLG)]
WIDTH, HEIGHT = 512, 256
# When so few pictures are decoded, x265 leaves open where it might change their order.
INPUTS = {'libx264': videos.LOSSLESS,
          'libx265': {'x265-params': 'lossless=1:log-level=error:bframes=0'},
          'libsvtav1': {'crf': '1', 'preset': '10'}}
# What the encoder loses is left aside: it is told so instead of the options.
WITHOUT_LOSS = {'libx265': {'x265-params': 'lossless=1:log-level=error'},
                'libsvtav1': {'crf': '1'}}


def ramps(is_full_range):
    """Return planes (Y, Cb, Cr) of ten bits, each in steps of one level; colours that exist."""
    across, down = np.linspace(0, 1, WIDTH), np.linspace(0, 1, HEIGHT)
    first, last = (200, 800) if is_full_range else (230, 760)
    luma = np.tile(first + (last - first) * across, (HEIGHT, 1))
    blue = np.tile(512 + 60 * (down[::2, None] - 0.5), (1, WIDTH // 2))
    red = np.tile(512 + 60 * (across[None, ::2] - 0.5), (HEIGHT // 2, 1))
    return [np.rint(plane).astype(np.uint16) for plane in (luma, blue, red)]


def recorded(path, tags, codec='libx265', count=2):
    """Write a video of ten bits with tags; return its path."""
    picture = videos.frame_of(ramps(tags[1] == FULL), 'yuv420p10le')
    return videos.encode(path, count * [picture], codec, tags=tags, options=INPUTS[codec])


def first_picture(path):
    """Return the first picture of a video and its tags, as FFmpeg reads them."""
    with av.open(str(path)) as container:
        picture = next(container.decode(video=0))
        codec = container.streams.video[0].codec_context
        return picture, (codec.colorspace, codec.color_range, codec.color_primaries,
                         codec.color_trc)


def planes_of(picture):
    """Return the planes of a picture of words."""
    return [np.frombuffer(plane, np.uint16).reshape(-1, plane.line_size // 2)[
        :plane.height, :plane.width].astype(int) for plane in picture.planes]


def inner(plane):
    """Return a plane but for its edges, where chroma is of one side only."""
    return plane[4:-4, 4:-4]


@pytest.mark.parametrize('tags', TAGS, ids=str)
@pytest.mark.parametrize('source', INPUTS)
@pytest.mark.parametrize('args, codec, encoder', [
    ((), 'hevc', 'libx265'), (('--codec', 'h265'), 'hevc', 'libx265'),
    (('--codec', 'av1'), 'av1', 'libsvtav1')], ids=['auto', 'h265', 'av1'])
def test_ten_bits_stay_ten_bits(tmp_path, monkeypatch, source, args, codec, encoder, tags):
    """Values within two levels of ten bits, half of one of eight; tags as they were."""
    if source != 'libx265' and args:
        pytest.skip('how pictures are written does not depend on what they were')
    name = args[-1] if args else 'h265'
    *_, tag = video_writer.ENCODERS[name]
    monkeypatch.setitem(video_writer.ENCODERS, name, (encoder, WITHOUT_LOSS[encoder], tag))
    path = recorded(tmp_path / 'in.mkv', tags, source)
    assert replay([str(path), str(tmp_path / 'out.mp4'), *args]) == 0
    (before, _), (after, found) = map(first_picture, (path, tmp_path / 'out.mp4'))
    with av.open(str(tmp_path / 'out.mp4')) as container:
        assert container.streams.video[0].codec_context.codec.canonical_name == codec
    assert after.format.name == 'yuv420p10le' and found == tags
    for a, b in zip(planes_of(before), planes_of(after), strict=True):
        assert np.abs(inner(a - b)).max() <= 2 and abs(inner(a - b).mean()) < 0.3


@pytest.mark.parametrize('tags', TAGS, ids=str)
def test_libswscale_says_the_same_in_sixteen_bits(tmp_path, tags):
    """Told matrix and range in so many words, with exact rounding and all chroma."""
    path = recorded(tmp_path / 'in.mkv', tags)
    picture, _ = first_picture(path)
    matrix, value_range, *_ = tags
    witness = reformatter.VideoReformatter().reformat(
        picture, format='gbrp16le', src_colorspace=5 if matrix == 6 else matrix,
        # That of B'G'R' is none, but some versions of PyAV do nothing where both are equal.
        dst_colorspace=1 if matrix == 9 else 9, src_color_range=value_range, dst_color_range=FULL,
        # Bilinear, accurate rounding, full chroma.
        interpolation=0x2 | 0x40000 | 0x2000)
    green, blue, red = planes_of(witness)
    # Its white is that of eight or of ten bits, shifted.
    white = 1023 << 6 if value_range == FULL else 255 << 8
    expected = np.stack((blue, green, red), axis=-1) * 65535 / white
    found = next(open_recording(path).frames()).deep_image
    assert found.dtype == np.uint16
    error = inner(found - expected) / 64
    # In levels of ten bits; it has the chroma elsewhere between two pixels.
    assert np.abs(error).max() < 2 and abs(error.mean()) < 0.3


@pytest.mark.parametrize('tags', TAGS, ids=str)
def test_the_equations_say_the_same(tmp_path, tags):
    """Those of H.273, of luma and chroma where the ramps cross."""
    matrix, value_range, *_ = tags
    colour = Colour(matrix, value_range == FULL)
    path = recorded(tmp_path / 'in.mkv', tags)
    found = next(open_recording(path).frames()).deep_image / 65535
    b, g, r = np.moveaxis(found, -1, 0)
    _, red, blue = MATRICES[matrix]
    luma = red * r + (1 - red - blue) * g + blue * b
    steps, black = (1023, 0) if colour.is_full_range else (876, 64)
    assert np.abs(steps * luma + black - ramps(colour.is_full_range)[0]).max() < 0.6


def test_steps_finer_than_eight_bits_are_seen(tmp_path, monkeypatch):
    """In a turned sphere too: a ramp has all its levels, not a quarter of them."""
    monkeypatch.setitem(
        video_writer.ENCODERS, 'h265', ('libx265', WITHOUT_LOSS['libx265'], 'hvc1'))
    path = recorded(tmp_path / 'in.mkv', TAGS[2])
    levels = {}
    for name, args in (('sphere', ()), ('view', ('--view', '20,10,5,80')),
                       ('marked', ('--view', '20,10,5,80', '-p', 'front_marker:=views')),
                       ('sides', ('--side-by-side',))):
        assert replay([str(path), str(tmp_path / f'{name}.mp4'), *args]) == 0
        luma = planes_of(first_picture(tmp_path / f'{name}.mp4')[0])[0]
        row = luma[luma.shape[0] // 2]
        levels[name] = len(np.unique(row)), np.ptp(row)
    for name, (count, span) in levels.items():
        assert count > 0.6 * min(span, len(row)), (name, count, span)


def test_pictures_of_eight_bits_stay_of_eight(tmp_path):
    """In H.264, as ever."""
    picture = videos.frame_of([np.uint8(plane // 4) for plane in ramps(False)], 'yuv420p')
    path = videos.encode(tmp_path / 'in.mkv', 2 * [picture], options=videos.LOSSLESS, tags=TAGS[0])
    assert next(open_recording(path).frames()).deep_image is None
    assert replay([str(path), str(tmp_path / 'out.mp4')]) == 0
    assert first_picture(tmp_path / 'out.mp4')[0].format.name == 'yuv420p'


def test_h264_has_eight_bits_and_says_so(tmp_path, capfd):
    """As its players have."""
    path = recorded(tmp_path / 'in.mkv', TAGS[0], count=4)
    assert replay([str(path), str(tmp_path / 'out.mp4'), '--codec', 'h264']) == 0
    assert capfd.readouterr().err.count('H.264 is written with eight bits') == 1
    assert first_picture(tmp_path / 'out.mp4')[0].format.name == 'yuv420p'


def test_one_eye_of_two_keeps_its_ten_bits(tmp_path):
    """Whatever part of the picture is used."""
    path = recorded(tmp_path / 'in.mkv', TAGS[0])
    assert replay([str(path), str(tmp_path / 'out.mp4'), '--layout', 'left_right']) == 0
    assert first_picture(tmp_path / 'out.mp4')[0].format.name == 'yuv420p10le'


def test_stills_have_eight_bits(tmp_path):
    """JPEG has no more."""
    path = recorded(tmp_path / 'in.mkv', TAGS[0])
    assert replay([str(path), str(tmp_path / 'out.mp4'), '--stills', '1']) == 0
    still, = (tmp_path / 'out_stills').iterdir()
    assert still.read_bytes().startswith(b'\xff\xd8')
