# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Metadata of spheres put into finished files: all players' programs must still read them."""

from itertools import product
from struct import pack, unpack
from xml.etree import ElementTree

from hypothesis import given, strategies as st
import numpy as np
import pytest
from sph_stab_ros.recording.spherical_boxes import boxes, file_boxes, packed, UUID, write_spherical
from sph_stab_ros.replay import main as replay
from tiny_recordings import textured_sphere

av = pytest.importorskip('av')
videos = pytest.importorskip('tiny_videos')

CONTAINERS = (b'moov', b'trak', b'mdia', b'minf', b'stbl')
PICTURES = [textured_sphere(256, seed) for seed in range(8)]


def video(path, **options):
    """Write a video with two tracks of sound; return the path."""
    pictures = [videos.bgr_frame(image) for image in PICTURES]
    return videos.encode(path, pictures, sound=videos.chirp(len(PICTURES) / videos.RATE),
                         tracks=2, **options)


def packets(path):
    """Return streams, times and data of all packets, as FFmpeg reads them."""
    with av.open(str(path)) as container:
        return [(p.stream_index, p.pts, p.dts, p.is_keyframe, bytes(p))
                for p in container.demux() if p.size]


def said(path):
    """Return what FFmpeg tells beside the first picture, by name: its structs as bytes."""
    with av.open(str(path)) as container:
        picture = next(container.decode(video=0))
    return {one.type.name: bytes(one) for one in picture.side_data}


def content(data, *names):
    """Return the content of the first box along a path of names."""
    for name in names:
        data = next(data[box.content:box.end] for box in boxes(data) if box.name == name)
    return data


def wide_offsets(path):
    """Give a file, whose index is at its end, the offsets that files beyond 4 GB have."""
    data = path.read_bytes()
    moov = next(box for box in boxes(data) if box.name == b'moov')

    def widened(part):
        parts = []
        for box in boxes(part):
            inner = part[box.content:box.end]
            if box.name in CONTAINERS:
                inner = widened(inner)
            if box.name == b'stco':
                count, = unpack('>I', inner[4:8])
                inner = inner[:8] + pack(f'>{count}Q', *unpack(f'>{count}I', inner[8:]))
            parts.append(packed(b'co64' if box.name == b'stco' else box.name, inner))
        return b''.join(parts)
    assert moov.end == len(data)
    path.write_bytes(data[:moov.start] + widened(data[moov.start:]))


def index_first(path):
    """Move the index of a file before the media, as programs for the web do."""
    data = path.read_bytes()
    moov = next(box for box in boxes(data) if box.name == b'moov')
    start = next(box.start for box in boxes(data) if box.name == b'mdat')

    def moved(part):
        parts = []
        for box in boxes(part):
            inner = part[box.content:box.end]
            if box.name in CONTAINERS:
                inner = moved(inner)
            for name, kind in ((b'stco', 'I'), (b'co64', 'Q')):
                if box.name == name:
                    count, = unpack('>I', inner[4:8])
                    inner = inner[:8] + pack(f'>{count}{kind}', *(
                        one + moov.end - moov.start
                        for one in unpack(f'>{count}{kind}', inner[8:])))
            parts.append(packed(box.name, inner))
        return b''.join(parts)
    path.write_bytes(data[:start] + moved(data[moov.start:moov.end]) + data[start:moov.start])


@pytest.mark.parametrize('suffix, is_first, is_wide', product(
    ('.mp4', '.mov'), (False, True), (False, True)))
def test_players_read_it_and_all_that_was_there(tmp_path, suffix, is_first, is_wide):
    """Pictures and sound are the same to the byte, wherever the index stands."""
    path = video(tmp_path / f'a{suffix}')
    expected = packets(path)
    if is_wide:
        wide_offsets(path)
    if is_first:
        index_first(path)
    assert packets(path) == expected and len(expected) > 8
    assert 'SPHERICAL' not in said(path)
    write_spherical(path)
    assert packets(path) == expected
    # Equirectangular, upright, without bounds; one eye.
    assert said(path)['SPHERICAL'] == bytes(36) and said(path)['STEREO3D'][:8] == bytes(8)
    assert [one.name for one in tmp_path.iterdir()] == [path.name]


def test_large_boxes_and_what_lies_behind_the_index_stay(tmp_path):
    """Sizes of 64 bits, and the last box to the end of the file."""
    path = video(tmp_path / 'a.mp4', movflags='faststart')
    expected = packets(path)
    data = path.read_bytes()
    found = {box.name: box for box in boxes(data)}
    assert found[b'moov'].start < found[b'mdat'].start
    mdat = found[b'mdat']
    # The free box before it makes room, so that no offset changes.
    free = found[b'free']
    assert free.end == mdat.start and free.end - free.start == 8
    for size in (pack('>I4sQ', 1, b'mdat', mdat.end - mdat.start + 8), None):
        header = size or free_and_open(mdat)
        path.write_bytes(data[:free.start] + header + data[mdat.content:])
        assert packets(path) == expected
        write_spherical(path)
        assert packets(path) == expected and 'SPHERICAL' in said(path)


def free_and_open(mdat):
    """Return a free box and the header of one that goes on to the end of the file."""
    assert mdat.content - mdat.start == 8
    return packed(b'free', b'') + pack('>I4s', 0, b'mdat')


def test_version_1_is_xml_in_the_track_of_the_video(tmp_path):
    path = video(tmp_path / 'a.mp4')
    write_spherical(path)
    moov = content(path.read_bytes(), b'moov')
    tracks = [moov[box.content:box.end] for box in boxes(moov) if box.name == b'trak']
    kinds = [content(track, b'mdia', b'hdlr')[8:12] for track in tracks]
    assert kinds == [b'vide', b'soun', b'soun']
    assert [UUID in track for track in tracks] == [True, False, False]
    assert [b'sv3d' in track for track in tracks] == [True, False, False]
    data = content(tracks[0], b'uuid')
    assert data[:16] == UUID
    name = '{http://ns.google.com/videos/1.0/spherical/}'
    values = {one.tag.removeprefix(name): one.text for one in ElementTree.fromstring(data[16:])}
    assert values['Spherical'] == values['Stitched'] == 'true'
    assert values['ProjectionType'] == 'equirectangular'


def test_version_1_alone_is_understood(tmp_path):
    """As players do that know nothing else; FFmpeg reads both versions."""
    path = videos.tagged(video(tmp_path / 'a.mp4'), xml=videos.xml_metadata())
    assert b'sv3d' not in path.read_bytes() and said(path)['SPHERICAL'] == bytes(36)


def test_spheres_say_that_they_are_and_views_do_not(turning_bag, turning_video, tmp_path):
    """Whatever they were made of; a view or spheres beside views are no spheres."""
    for number, (source, suffix) in enumerate(product((turning_bag, turning_video),
                                                      ('mp4', 'mov'))):
        out = tmp_path / f'{number}.{suffix}'
        assert replay([str(source), str(out), '--max-frames', '3']) == 0
        assert said(out)['SPHERICAL'] == bytes(36)
    for option in ('--view=0,0,0,90', '--side-by-side'):
        assert replay([str(turning_bag), str(out), '--max-frames', '3', '--force', option]) == 0
        assert 'SPHERICAL' not in said(out) and UUID not in out.read_bytes()


def test_what_is_no_such_file_stays_as_it_is(tmp_path):
    """Fragments keep their own offsets."""
    video(tmp_path / 'a.mkv')
    video(tmp_path / 'b.mp4', movflags='frag_keyframe+empty_moov')
    (tmp_path / 'c.mp4').write_bytes(b'')
    cut = video(tmp_path / 'd.mp4')
    cut.write_bytes(cut.read_bytes()[:-100])
    for path in tmp_path.iterdir():
        data = path.read_bytes()
        with pytest.raises(ValueError):
            write_spherical(path)
        assert path.read_bytes() == data


@given(st.lists(st.tuples(st.sampled_from([b'moov', b'trak', b'mdia', b'stsd', b'stco', b'free']),
                          st.binary(max_size=40), st.integers(-20, 20)), max_size=5),
       st.binary(max_size=20))
def test_damaged_files_are_refused_or_read(tmp_path_factory, found, rest):
    """No other error, no endless loop."""
    path = tmp_path_factory.mktemp('damaged') / 'a.mp4'
    parts = [pack('>I4s', max(8 + len(data) + off, 0), name) + data for name, data, off in found]
    path.write_bytes(b''.join(parts) + rest)
    try:
        write_spherical(path)
    except ValueError:
        pass
    else:
        with path.open('rb') as file:
            assert {box.name for box in file_boxes(file)} >= {b'moov'}


def test_pictures_are_still_those_that_were_written(tmp_path):
    path = video(tmp_path / 'a.mp4')
    write_spherical(path)
    with av.open(str(path)) as container:
        found = [frame.to_ndarray(format='bgr24') for frame in container.decode(video=0)]
    assert len(found) == len(PICTURES)
    assert max(np.abs(a.astype(int) - b).mean() for a, b in zip(found, PICTURES)) < 15
