# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""
Colours of videos, in and out: as their tags say, kept and tagged.

Beside the equations there are two witnesses: libswscale, told by PyAV what it is to convert, and
the tags that FFmpeg reads from what was written.
"""

import cv2
import numpy as np
import pytest
from sph_stab_ros.images.colour import bgr_from_yuv, Colour, MATRICES, STANDARD, to_bgr
from sph_stab_ros.recording import open_recording, video_writer
from sph_stab_ros.replay import main as replay

av = pytest.importorskip('av')
reformatter = pytest.importorskip('av.video.reformatter')
videos = pytest.importorskip('tiny_videos')

BT709, SMPTE170M, BT470BG, BT2020, LIMITED, FULL, PQ, HLG = 1, 6, 5, 9, 1, 2, 16, 18
TAGS = [(BT709, LIMITED, 1, 1), (BT709, FULL, 1, 13), (SMPTE170M, LIMITED, 6, 6),
        (BT470BG, FULL, 5, 6), (BT2020, LIMITED, 9, PQ), (BT2020, FULL, 9, HLG)]
SIZE = WIDTH, HEIGHT = 256, 128
PATCH = 16
# Colours of patches, large enough that their centres are far from the next one's chroma.
BGR = np.random.default_rng(0).integers(0, 256, (HEIGHT // PATCH, WIDTH // PATCH, 3))
# Instead of what the options say.
WITHOUT_LOSS = {**videos.LOSSLESS, 'crf': '0'}


def colour(tags):
    """Return the Colour of FFmpeg's tags."""
    matrix, value_range, primaries, transfer = tags
    return Colour(matrix, value_range == FULL, primaries, transfer)


def patches(tags, bits=8):
    """Return planes (Y, U, V), the chroma at half the size, with the patches in a Colour."""
    matrix, is_full_range, *_ = colour(tags)
    _, red, blue = MATRICES[matrix]
    b, g, r = np.moveaxis(BGR / 255., -1, 0)
    y = red * r + (1 - red - blue) * g + blue * b
    cb, cr = (b - y) / (2 * (1 - blue)), (r - y) / (2 * (1 - red))
    if is_full_range:
        values = [one * (2 ** bits - 1) + zero * 2 ** (bits - 1)
                  for one, zero in ((y, 0), (cb, 1), (cr, 1))]
    else:
        values = [(steps * one + zero) * 2 ** (bits - 8)
                  for one, steps, zero in ((y, 219, 16), (cb, 224, 128), (cr, 224, 128))]
    kind = np.uint8 if bits == 8 else np.uint16
    return [np.kron(np.clip(np.rint(one), 0, 2 ** bits - 1).astype(kind), np.ones(
        2 * (PATCH // (1 if plane == 0 else 2),), kind)) for plane, one in enumerate(values)]


def centres(plane, size=PATCH):
    """Return the values in the middle of each patch, as whole numbers that may be negative."""
    return plane[size // 2::size, size // 2::size].astype(int)


def write(path, tags, bits=8, count=1, stored=None, **options):
    """Write a video of the patches without loss, with tags; return the path."""
    picture = videos.frame_of(stored or patches(tags, bits),
                              'yuv420p' if bits == 8 else f'yuv420p{bits}le')
    return videos.encode(path, count * [picture], tags=tags, options=videos.LOSSLESS, **options)


@pytest.mark.parametrize('bits', [8, 10])
@pytest.mark.parametrize('tags', TAGS, ids=str)
def test_pictures_have_the_colours_that_the_tags_say(tmp_path, tags, bits):
    frame, = open_recording(write(tmp_path / 'a.mp4', tags, bits)).frames()
    assert frame.colour == colour(tags)
    assert np.abs(centres(frame.image) - BGR).max() <= (2 if bits == 8 else 1)


@pytest.mark.parametrize('bits', [8, 10])
@pytest.mark.parametrize('tags', TAGS, ids=str)
def test_libswscale_says_the_same(tmp_path, tags, bits):
    """Told matrix and range in so many words, with exact rounding and all chroma."""
    path = write(tmp_path / 'a.mp4', tags, bits)
    matrix, value_range, *_ = tags
    with av.open(str(path)) as container:
        picture = next(container.decode(video=0))
    witness = reformatter.VideoReformatter().reformat(
        picture, format='bgr24', src_colorspace=BT470BG if matrix == SMPTE170M else matrix,
        # That of B'G'R' is none, but some versions of PyAV do nothing where both are equal.
        dst_colorspace=BT709 if matrix == BT2020 else BT2020,
        src_color_range=value_range, dst_color_range=FULL,
        # Bilinear, accurate rounding, full chroma.
        interpolation=0x2 | 0x40000 | 0x2000).to_ndarray()
    frame, = open_recording(path).frames()
    assert np.abs(centres(frame.image) - centres(witness)).max() <= 2
    assert np.abs(frame.image.astype(int) - witness).mean() < 4


@pytest.mark.parametrize('pix_fmt, tags', [
    ('yuv444p', TAGS[0]), ('yuv422p', TAGS[1]), ('yuv444p10le', TAGS[4])])
def test_finer_chroma_is_read_as_well(tmp_path, pix_fmt, tags):
    bits = 10 if '10' in pix_fmt else 8
    luma, *chroma = patches(tags, bits)
    across, down = (2, 2) if '444' in pix_fmt else (1, 2)
    chroma = [one.repeat(across, axis=1).repeat(down, axis=0) for one in chroma]
    if '422' in pix_fmt:
        chroma = [one[:, :WIDTH // 2] for one in chroma]
    picture = videos.frame_of((luma, *chroma), pix_fmt)
    path = videos.encode(tmp_path / 'a.mkv', [picture], 'ffv1', tags=tags)
    frame, = open_recording(path).frames()
    assert np.abs(centres(frame.image) - BGR).max() <= 2


@pytest.mark.parametrize('codec, pix_fmt', [('mjpeg', 'yuvj420p'), ('ffv1', 'bgr0')])
def test_other_codecs_say_themselves_what_they_hold(tmp_path, codec, pix_fmt):
    """JPEG has BT.601 of full range, and some have no Y'CbCr at all."""
    tags = BT470BG, FULL, 2, 2
    if codec == 'mjpeg':
        picture = videos.frame_of(patches(tags), pix_fmt)
    else:
        image = np.kron(BGR, np.ones((PATCH, PATCH, 1))).astype(np.uint8)
        picture = av.VideoFrame.from_ndarray(image, format='bgr24').reformat(format=pix_fmt)
    path = videos.encode(tmp_path / 'a.mkv', [picture], codec,
                         options={'qmin': '1', 'qmax': '1'} if codec == 'mjpeg' else {})
    frame, = open_recording(path).frames()
    assert np.abs(centres(frame.image) - BGR).max() <= 4
    assert not frame.colour.assumed


@pytest.mark.parametrize('pix_fmt, bits', [('gray', 8), ('gray10le', 10), ('gray16le', 16)])
@pytest.mark.parametrize('value_range', [0, LIMITED, FULL])
def test_grey_videos_are_grey(tmp_path, pix_fmt, bits, value_range):
    """Of full range unless they are tagged, as FFmpeg has it; nothing else need be assumed."""
    levels = np.kron(BGR[..., 1], np.ones((PATCH, PATCH)))
    steps = levels / 255 * (2 ** bits - 1)
    if value_range == LIMITED:
        steps = (levels / 255 * 219 + 16) * 2 ** (bits - 8)
    plane = np.rint(steps).astype(np.uint8 if bits == 8 else np.uint16)
    path = videos.encode(tmp_path / 'a.mkv', 3 * [videos.frame_of((plane,), pix_fmt)], 'ffv1',
                         tags=(2, value_range))
    frame = next(open_recording(path).frames())
    assert frame.image.ndim == 2 and not frame.colour.assumed
    assert np.abs(frame.image - levels).max() <= 1
    assert np.array_equal(frame.grey(0), frame.image)
    assert replay([str(path), str(tmp_path / 'out.mp4')]) == 0
    again = next(open_recording(tmp_path / 'out.mp4').frames())
    assert again.colour.is_full_range == (value_range != LIMITED)
    assert np.abs(again.image.astype(int).mean(axis=2) - levels).mean() < 3


@pytest.mark.parametrize('tags', TAGS, ids=str)
def test_grey_for_tracking_is_the_luma(tmp_path, tags):
    """As cv2 would make it of R'G'B' by the same matrix, whatever was asked for before."""
    frame, loaded = (next(iter(open_recording(
        write(tmp_path / f'{number}.mp4', tags)).frames())) for number in range(2))
    loaded.load()
    _, red, blue = MATRICES[tags[0]]
    expected = BGR @ (blue, 1 - red - blue, red)
    assert np.abs(centres(frame.grey(0)) - expected).max() < 1.5
    assert np.array_equal(frame.grey(0), loaded.grey(WIDTH))


def written(path):
    """Return the tags and the planes of the first picture of a video, as FFmpeg reads them."""
    with av.open(str(path)) as container:
        picture = next(container.decode(video=0))
        codec = container.streams.video[0].codec_context
        tags = codec.colorspace, codec.color_range, codec.color_primaries, codec.color_trc
        planes = [np.frombuffer(plane, np.uint8).reshape(-1, plane.line_size)[
            :plane.height, :plane.width].astype(int) for plane in picture.planes]
    return tags, planes


@pytest.mark.parametrize('bits', [8, 10])
@pytest.mark.parametrize('tags', TAGS, ids=str)
def test_values_and_tags_are_kept(tmp_path, monkeypatch, tags, bits):
    """Within two levels, what the encoder loses left aside; of ten bits H.264 has eight."""
    monkeypatch.setitem(video_writer.ENCODERS, 'h264', ('libx264', WITHOUT_LOSS, ''))
    path = write(tmp_path / 'a.mp4', tags, bits, count=3)
    assert replay([str(path), str(tmp_path / 'out.mp4'), '--codec', 'h264']) == 0
    found, planes = written(tmp_path / 'out.mp4')
    assert found == tags
    for plane, expected in zip(planes, patches(tags)):
        size = PATCH * plane.shape[0] // HEIGHT
        assert np.abs(centres(plane, size) - centres(expected, size)).max() <= 2


def test_the_index_of_the_file_tells_the_tags_too(tmp_path):
    """Some players read nothing else: box colr, of kind nclx."""
    path = write(tmp_path / 'a.mp4', TAGS[4], 10, count=3)
    assert replay([str(path), str(tmp_path / 'out.mp4')]) == 0
    data = (tmp_path / 'out.mp4').read_bytes()
    start = data.index(b'colrnclx') + 8
    assert list(data[start:start + 7]) == [0, 9, 0, PQ, 0, BT2020, 0]


def test_what_is_assumed_is_said_and_tagged(tmp_path, capsys):
    """What the values mean that were written is no longer open."""
    untagged = 2, 0, 2, 2
    path = write(tmp_path / 'a.mp4', untagged, count=3, stored=patches(TAGS[2]))
    assert replay([str(path), str(tmp_path / 'out.mp4')]) == 0
    assert 'BT.601, limited range: no tag says so' in capsys.readouterr().out
    assert written(tmp_path / 'out.mp4')[0] == (SMPTE170M, LIMITED, 2, 2)
    assert replay([str(path), '--trajectory', str(tmp_path / 'out.tum')]) == 0
    assert 'no tag' not in capsys.readouterr().out


def test_nothing_is_said_of_what_is_tagged(tmp_path, capsys):
    path = write(tmp_path / 'a.mp4', TAGS[0], count=3)
    assert replay([str(path), str(tmp_path / 'out.mp4')]) == 0
    assert 'no tag' not in capsys.readouterr().out


def test_pictures_of_bags_are_written_as_players_expect(turning_bag, tmp_path, turning):
    assert replay([str(turning_bag), str(tmp_path / 'out.mp4')]) == 0
    tags, planes = written(tmp_path / 'out.mp4')
    assert tags == (BT709, LIMITED, 1, 1)
    chroma = [plane.repeat(2, axis=0).repeat(2, axis=1) for plane in planes[1:]]
    image = to_bgr([np.uint8(plane) for plane in (planes[0], *chroma)],
                   planes[0].shape[::-1], STANDARD)
    assert np.abs(image.astype(int) - turning[0][0]).mean() < 10


def test_colour_bars_of_a_report(shared_data, tmp_path, monkeypatch):
    """The values are equal within two levels but at the edges of bars, the tags are kept."""
    monkeypatch.setitem(video_writer.ENCODERS, 'h264', ('libx264', WITHOUT_LOSS, ''))
    path = shared_data / 'reports' / 'colour' / 'bars709.mp4'
    if not path.exists():
        pytest.skip('this report is not there')
    assert replay([str(path), str(tmp_path / 'out.mp4'), '--max-frames', '2']) == 0
    tags, planes = written(tmp_path / 'out.mp4')
    expected_tags, expected = written(path)
    assert tags == expected_tags == (BT709, LIMITED, 1, 1)
    # Bars may be darker than black, brighter than white or of a colour that no screen shows.
    yuv = np.dstack((expected[0][::2, ::2], *expected[1:], np.ones_like(expected[1])))
    bgr = yuv @ bgr_from_yuv(BT709, False).T
    shown = ((bgr > -1) & (bgr < 256)).all(axis=2).repeat(2, axis=0).repeat(2, axis=1)
    for plane, other in zip(planes, expected):
        edges = cv2.morphologyEx(other.astype(np.uint8), cv2.MORPH_GRADIENT, np.ones((9, 9))) > 8
        part = (shown if plane is planes[0] else shown[::2, ::2]) & ~edges
        assert part.mean() > 0.8 and np.abs(plane - other)[part].max() <= 2
