# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Videos for two eyes and of a half sphere, by their metadata or by an option."""

import json
import re

import numpy as np
import pytest
from sph_stab_ros.config import ConfigError, StabilizerConfig, TrackerConfig
from sph_stab_ros.evaluate import main as evaluate
from sph_stab_ros.evaluation.stitched import Stitched
from sph_stab_ros.geometry.layout import FRONT, Layout, LEFT_HALF, Part, TOP_HALF, WHOLE
from sph_stab_ros.geometry.projection_factory import ProjectionError
from sph_stab_ros.geometry.trajectory import read_tum
from sph_stab_ros.images.frame import Frame
from sph_stab_ros.images.sphere import as_sphere, config_for
from sph_stab_ros.recording import open_recording, RecordingError
from sph_stab_ros.replay import main as replay
from sph_stab_ros.stabilization.pipeline import Stabilizer
from tiny_recordings import textured_sphere, turning_spheres

av = pytest.importorskip('av')
videos = pytest.importorskip('tiny_videos')

WIDTH, COUNT = 512, 10
SPHERES, R_WORLD_CAMERA = turning_spheres(COUNT, WIDTH)
OTHER = textured_sphere(WIDTH, seed=3)
RIGHT_HALF, BOTTOM_HALF = Part(.5, 0., 1., 1.), Part(0., .5, 1., 1.)


def halves(image):
    """Return the front half of a sphere."""
    return image[:, WIDTH // 4:-WIDTH // 4]


# How pictures of two eyes are made of a sphere; the other eye sees something that never moves.
TWO = {
    'top_bottom': lambda image: np.vstack((image, OTHER)),
    'left_right': lambda image: np.hstack((image, OTHER)),
    'vr180': lambda image: np.hstack((halves(image), halves(OTHER))),
    'half_sphere': halves}


def video(path, kind, sound=None, **options):
    """Write a video of turning spheres as pictures of a kind; return the path."""
    pictures = [videos.bgr_frame(np.ascontiguousarray(TWO[kind](image))) for image in SPHERES]
    return videos.encode(path, pictures, options={'crf': '10', **options}, sound=sound)


def angles_deg(R_a, R_b):
    """Return the angles between rotations in degrees."""
    return np.rad2deg((R_a.inv() * R_b).magnitude())


def layout(path):
    """Return the Layout that a video's metadata say."""
    return next(open_recording(path).frames()).layout


def cropped(left, width, top, height):
    """Return what version 1 says of a part of a sphere of 1000 x 500 pixels."""
    values = {'CroppedAreaLeftPixels': left, 'CroppedAreaImageWidthPixels': width,
              'CroppedAreaTopPixels': top, 'CroppedAreaImageHeightPixels': height,
              'FullPanoWidthPixels': 1000, 'FullPanoHeightPixels': 500}
    return ''.join(f'<GSpherical:{name}>{value}</GSpherical:{name}>'
                   for name, value in values.items())


V2 = {'vr180': (2, (.25, 0., .25, 0.)), 'top_bottom': (1, ()), 'left_right': (2, ()),
      'half_sphere': (0, (.25, 0., .25, 0.))}


@pytest.mark.parametrize('kind', TWO)
@pytest.mark.parametrize('version', [1, 2])
def test_metadata_of_mp4_files_are_heeded(tmp_path, kind, version):
    """Version 2 in boxes, version 1 in XML."""
    mode, bounds = V2[kind]
    path = video(tmp_path / 'a.mp4', kind, sound=videos.chirp(0.4))
    if version == 2:
        videos.tagged(path, videos.stereo_box(mode) + videos.sphere_box(*bounds))
    else:
        videos.tagged(path, xml=videos.xml_metadata(
            ('mono', 'top-bottom', 'left-right')[mode],
            cropped(250, 500, 0, 500) if bounds else ''))
    expected = Layout({0: WHOLE, 1: TOP_HALF, 2: LEFT_HALF}[mode], FRONT if bounds else WHOLE)
    assert layout(path) == expected
    sphere = as_sphere(next(open_recording(path).frames()), StabilizerConfig()).image
    shown = np.broadcast_to(expected.seen(WIDTH)[..., None], SPHERES[0].shape)
    assert sphere.shape == SPHERES[0].shape and not sphere[~shown].any()
    assert np.abs(sphere[shown].astype(int) - SPHERES[0][shown]).mean() < 8


def test_any_bounds_are_heeded(tmp_path):
    path = videos.tagged(video(tmp_path / 'a.mp4', 'half_sphere'),
                         videos.stereo_box(0) + videos.sphere_box(.1, .2, .3, .05))
    found = layout(path)
    assert found.used == WHOLE and found.shown == pytest.approx((.1, .2, .7, .95))


def test_a_whole_sphere_for_one_eye_has_no_layout(tmp_path):
    """So that nothing is copied."""
    path = video(tmp_path / 'a.mp4', 'top_bottom')
    assert layout(path) is None
    videos.tagged(path, videos.stereo_box(0) + videos.sphere_box())
    assert layout(path) is None


@pytest.mark.parametrize('mode, expected', [
    ('left_right', LEFT_HALF), ('right_left', RIGHT_HALF), ('top_bottom', TOP_HALF),
    ('bottom_top', BOTTOM_HALF), ('mono', WHOLE)])
def test_stereo_of_matroska_is_heeded(tmp_path, mode, expected):
    """The left eye's, wherever that is."""
    picture = videos.bgr_frame(np.vstack((SPHERES[0], OTHER)))
    path = tmp_path / 'a.mkv'
    with av.open(str(path), 'w') as container:
        stream = container.add_stream('libx264', rate=25)
        stream.width, stream.height = picture.width, picture.height
        stream.metadata['stereo_mode'] = mode
        container.mux(stream.encode(picture))
        container.mux(stream.encode())
    found = layout(path)
    assert (found.used if found else WHOLE) == expected


@pytest.mark.parametrize('packing, kind, expected', [
    (3, 'vr180', Layout(LEFT_HALF, FRONT)), (3, 'left_right', Layout(LEFT_HALF)),
    (4, 'top_bottom', Layout(TOP_HALF))])
def test_frame_packing_of_h264_is_heeded(tmp_path, packing, kind, expected):
    """Where nothing is said of the sphere, square pictures of an eye are half of one."""
    path = video(tmp_path / 'a.mp4', kind, **{'x264-params': f'frame-packing={packing}'})
    assert layout(path) == expected


@pytest.mark.parametrize('boxes, message', [
    (videos.stereo_box(2) + videos.sphere_box(projection=b'mshp'),
     'a mesh for each of two eyes, which is not read: .*layout:=vr180'),
    (videos.sphere_box(projection=b'ytmp'), 'a mesh, .*projection:=equi_angular_cubemap'),
    (videos.stereo_box(1) + videos.cube_box(), 'a cube map for each of two eyes, .*-p'),
    (videos.cube_box(layout=3), 'a cube map of another layout .*-p'),
    (videos.cube_box(padding=4), 'a cube map with 4 px of padding, .*-p'),
    (videos.sphere_box(projection=b'abcd'), "'abcd', .*-p"),
    (videos.sphere_box(.6, 0., .5, 0.), '')])
def test_what_is_not_read_is_refused_by_name(tmp_path, capsys, boxes, message):
    """In one line that says how it may be; FFmpeg itself refuses what makes no sense."""
    path = videos.tagged(video(tmp_path / 'a.mp4', 'half_sphere'), boxes)
    for command in ([replay, str(path), '--trajectory', str(tmp_path / 'out.tum')],
                    [evaluate, str(path), '--inject', '1']):
        assert command[0](command[1:]) == 1
        error, = capsys.readouterr().err.splitlines()
        assert re.search(f'a.mp4.*{message}', error)


def test_packings_that_are_not_read_are_refused_by_name(tmp_path):
    """Alternate pictures for the two eyes."""
    path = video(tmp_path / 'a.mp4', 'half_sphere', **{'x264-params': 'frame-packing=5'})
    frame = next(open_recording(path).frames())
    with pytest.raises(RecordingError, match='a.mp4: .*share alternate pictures'):
        config_for(frame, StabilizerConfig())


@pytest.mark.parametrize('kind', TWO)
@pytest.mark.parametrize('by_option', [False, True])
def test_the_camera_is_followed_by_one_eye(tmp_path, kind, by_option):
    """What the other eye sees never moves, so that it would be found out."""
    path = video(tmp_path / 'a.mp4', kind)
    args = ['--layout', kind] if by_option else []
    if not by_option:
        mode, bounds = V2[kind]
        videos.tagged(path, videos.stereo_box(mode) + videos.sphere_box(*bounds))
    for estimator in ('anchored', 'pts'):
        tum = tmp_path / f'{estimator}.tum'
        assert replay([str(path), '--trajectory', str(tum), '--estimator', estimator, *args]) == 0
        off_deg = angles_deg(read_tum(tum).rotations, R_WORLD_CAMERA)
        assert off_deg.max() < (0.3 if estimator == 'anchored' else 2)


def test_what_is_not_seen_stays_black_in_the_output(tmp_path):
    """The stabilised sphere shows it where the camera looked; it is a sphere for one eye."""
    path = video(tmp_path / 'a.mp4', 'vr180')
    assert replay([str(path), str(tmp_path / 'out.mp4'), '--layout', 'vr180']) == 0
    *_, last = open_recording(tmp_path / 'out.mp4').frames()
    assert last.image.shape == SPHERES[0].shape and last.layout is None
    seen = (last.image > 25).any(axis=2)
    assert 0.45 < seen.mean() < 0.55
    # Far from the poles its edges have turned by less than an eighth of a revolution.
    rows = slice(WIDTH // 6, -WIDTH // 6)
    assert not seen[rows, :WIDTH // 8].any() and not seen[rows, -WIDTH // 8:].any()
    off = np.abs(last.image.astype(int) - SPHERES[0])[rows]
    assert off[seen[rows]].mean() < 10


@pytest.mark.parametrize('boxes', [
    videos.stereo_box(2) + videos.sphere_box(.25, 0., .25, 0.),
    videos.sphere_box(projection=b'mshp'), videos.cube_box()])
def test_metadata_that_are_wrong_can_be_overruled(tmp_path, boxes):
    """A sphere that an editor has left the tags of its source."""
    pictures = [videos.bgr_frame(image) for image in SPHERES]
    path = videos.tagged(videos.encode(tmp_path / 'a.mp4', pictures), boxes)
    tum = tmp_path / 'out.tum'
    assert replay([str(path), '--trajectory', str(tum), '--layout', 'mono']) == 0
    assert angles_deg(read_tum(tum).rotations, R_WORLD_CAMERA).max() < 0.3
    # All of it is used, too.
    frame = next(open_recording(path).frames())
    assert as_sphere(frame, StabilizerConfig(layout='mono')).layout is None


def test_the_tracker_is_told_what_is_seen():
    """Also one of the user's own, but only then."""
    told = []

    class Tracker:

        def track(self, grey, stamp_ns):
            told.append(grey.shape)
            raise ZeroDivisionError

    def make(config, width, gyro_rotation, *seen):
        told.append(seen)
        return Tracker()

    for frame_layout in (None, Layout(LEFT_HALF, FRONT)):
        picture = TWO['vr180'](SPHERES[0]) if frame_layout else SPHERES[0]
        with pytest.raises(ZeroDivisionError):
            Stabilizer(make_tracker=make).process(Frame(picture, 0, layout=frame_layout))
    nothing, shape, (seen,), same_shape = told
    assert nothing == () and shape == same_shape == seen.shape
    assert np.array_equal(seen, Layout(LEFT_HALF, FRONT).seen(WIDTH))


def test_a_mask_that_leaves_nothing_is_refused_by_name():
    frame = Frame(halves(SPHERES[0]), 0, layout=Layout(WHOLE, Part(.25, 0., .75, .5)))
    config = StabilizerConfig(tracker=TrackerConfig(mask='lat:-5,90'))
    with pytest.raises(ProjectionError, match='nothing to use'):
        Stabilizer(config).process(frame)


def test_a_layout_is_one_of_those_that_there_are():
    with pytest.raises(ConfigError, match='layout is one of'):
        StabilizerConfig(layout='magic')


def test_rotations_are_injected_into_what_is_seen(tmp_path):
    """Black stays black, so that an estimator is asked for no more than there is."""
    path = videos.tagged(video(tmp_path / 'a.mp4', 'vr180'),
                         videos.stereo_box(2) + videos.sphere_box(.25, 0., .25, 0.))
    spheres = list(Stitched(open_recording(path), StabilizerConfig()).frames())
    assert {frame.size_wh for frame in spheres} == {(WIDTH, WIDTH // 2)}
    assert evaluate([str(path), '--inject', '1', '--estimators', 'anchored',
                     '--json', str(tmp_path / 'a.json')]) == 0
    figures = json.loads((tmp_path / 'a.json').read_text())['estimators']['anchored']
    assert figures['frames'] == COUNT and figures['geodesic_deg']['max'] < 2


def test_vr180_of_a_report(shared_data, tmp_path):
    """As well as the whole sphere that it was made of."""
    path = shared_data / 'reports' / 'vr180' / 'vr180_tagged_v2.mp4'
    if not path.exists():
        pytest.skip('this report is not there')
    assert layout(path) == Layout(LEFT_HALF, FRONT)
    assert replay([str(path), '--trajectory', str(tmp_path / 'out.tum')]) == 0
    expected = read_tum(shared_data / 'reports' / 'base.tum').rotations
    found = read_tum(tmp_path / 'out.tum').rotations
    assert angles_deg(found, expected).max() < 1
