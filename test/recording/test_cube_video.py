# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Videos of the six faces of a cube, by their metadata or by an option."""

import json

import numpy as np
from projection_pictures import picture_of, projection_named
import pytest
from sph_stab_ros.evaluate import main as evaluate
from sph_stab_ros.geometry.trajectory import read_tum
from sph_stab_ros.recording import open_recording
from sph_stab_ros.replay import main as replay
from tiny_recordings import turning_spheres

av = pytest.importorskip('av')
videos = pytest.importorskip('tiny_videos')

WIDTH, COUNT = 1024, 10
SPHERES, R_WORLD_CAMERA = turning_spheres(COUNT, WIDTH)
PLAIN, EQUI_ANGULAR = 'cube 3x2', 'equi-angular'


def matroska_projection(kind, private=b''):
    """Return the element Projection of a Matroska track: its type and what that needs besides."""
    kind = bytes.fromhex('767181') + bytes([kind])
    private = bytes.fromhex('7672') + bytes([0x80 | len(private)]) + private
    return bytes.fromhex('7670') + bytes([0x80 | len(kind + private)]) + kind + private


def with_element(data, names, element):
    """Return elements of Matroska with one more in the first at a path of names."""
    if not names:
        return element + data
    at = 0
    while True:
        name_bytes = 9 - data[at].bit_length()
        size_bytes = 9 - data[at + name_bytes].bit_length()
        content = at + name_bytes + size_bytes
        bits = data[at + name_bytes:content].hex()
        end = content + (int(bits, 16) & (1 << 7 * size_bytes) - 1)
        if data[at:at + name_bytes].hex() == names[0]:
            inner = with_element(data[content:end], names[1:], element)
            return (data[:at + name_bytes] + b'\1' + len(inner).to_bytes(7, 'big') + inner
                    + data[end:])
        at = end


def tagged_matroska(path, element):
    """Put an element into the video track of a Matroska file; return the path."""
    # Segment, Tracks, TrackEntry, Video.
    path.write_bytes(with_element(
        path.read_bytes(), ('18538067', '1654ae6b', 'ae', 'e0'), element))
    return path


def cube(path, name=PLAIN):
    """Write a video of turning spheres as a cube map; return the path."""
    projection = projection_named(name)
    pictures = [videos.bgr_frame(picture_of(projection, image)) for image in SPHERES]
    return videos.encode(path, pictures, options={'crf': '10'})


def angles_deg(path):
    """Return how far orientations in a file are from those of the spheres."""
    return np.rad2deg((read_tum(path).rotations.inv() * R_WORLD_CAMERA).magnitude())


def write(kind, folder):
    """Write a cube map whose metadata are of a kind; return the path."""
    if kind == 'XML':
        return videos.tagged(cube(folder / 'cube.mp4'),
                             xml=videos.xml_metadata(projection='cubemap'))
    if kind == 'boxes':
        return videos.tagged(cube(folder / 'cube.mp4'), videos.cube_box())
    return tagged_matroska(cube(folder / 'cube.mkv'), matroska_projection(2, bytes(12)))


@pytest.mark.parametrize('kind', ['XML', 'boxes', 'Matroska'])
def test_metadata_choose_the_projection(tmp_path, kind):
    path, tum, out = write(kind, tmp_path), tmp_path / 'out.tum', tmp_path / 'out.mp4'
    assert replay([str(path), str(out), '--trajectory', str(tum)]) == 0
    assert angles_deg(tum).max() < 0.3
    *_, last = open_recording(out).frames()
    # The stabilised sphere is the first one, above and below too.
    assert last.image.shape == SPHERES[0].shape and last.layout is None
    assert np.abs(last.image.astype(int) - SPHERES[0]).mean() < 12
    assert evaluate([str(path), '--inject', '1', '--estimators', 'anchored',
                     '--json', str(tmp_path / 'a.json')]) == 0
    figures = json.loads((tmp_path / 'a.json').read_text())['estimators']['anchored']
    assert figures['frames'] == COUNT and figures['geodesic_deg']['max'] < 1


@pytest.mark.parametrize('tag', [
    lambda path: path,
    lambda path: videos.tagged(path, videos.cube_box()),
    lambda path: videos.tagged(path, videos.sphere_box(projection=b'ytmp'))])
def test_whoever_names_a_projection_overrules_metadata(tmp_path, tag):
    path = tag(cube(tmp_path / 'cube.mp4', EQUI_ANGULAR))
    assert replay([str(path), '--trajectory', str(tmp_path / 'out.tum'),
                   '--projection', 'equi_angular_cubemap']) == 0
    assert angles_deg(tmp_path / 'out.tum').max() < 0.3


def test_the_options_of_cubes_count_besides(tmp_path, capsys):
    """As the picture is no other than that, its size is held against what metadata say."""
    path = videos.tagged(cube(tmp_path / 'cube.mp4'), videos.cube_box())
    assert replay([str(path), '--trajectory', str(tmp_path / 'a.tum'),
                   '-p', "cubemap.turns:='222222'"]) == 0
    assert not angles_deg(tmp_path / 'a.tum').max() < 0.3
    pictures = [videos.bgr_frame(image[:300].copy()) for image in SPHERES]
    path = videos.tagged(videos.encode(tmp_path / 'no.mp4', pictures), videos.cube_box())
    assert replay([str(path), '--trajectory', str(tmp_path / 'b.tum')]) == 1
    assert 'not a cubemap: six square faces' in capsys.readouterr().err
