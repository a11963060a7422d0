# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What pictures look like: what is no sphere is found out, and no sphere is taken for it."""

from pathlib import Path

import cv2
from dual_fisheye_frames import fisheye_picture
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sph_stab_ros.config import DUAL_FISHEYE, FisheyeConfig, LensConfig, StabilizerConfig
from sph_stab_ros.geometry.equirect import bearing_grid
from sph_stab_ros.geometry.warp import rotate_equirect
from sph_stab_ros.images.appearance import Appearance, reduced, Seen, seen_in
from sph_stab_ros.images.appearance_watch import AGREEING, FIRST, PictureWatch, SELDOM
from sph_stab_ros.images.frame import Frame
from sph_stab_ros.recording import open_recording
from synthetic import textured_sphere

BAGS = Path(__file__).resolve().parents[2] / 'bags'
# Two lenses whose circles fill a picture of 2:1, and two one above the other.
SQUARE = {'radius_px': 150., 'k1': 0., 'k2': 0., 'roll_deg': 0.}
SIDE_BY_SIDE = FisheyeConfig(
    width=640, height=320,
    front=LensConfig(center_u_px=159.5, center_v_px=159.5, **SQUARE),
    rear=LensConfig(center_u_px=479.5, center_v_px=159.5, yaw_deg=180., **SQUARE))


@pytest.fixture(scope='module')
def worlds():
    """Return spheres (320, 640) as cameras that stand in other ways see them."""
    world = np.uint8(40 + 0.6 * textured_sphere(640))
    return [rotate_equirect(world, R) for R in Rotation.random(4, random_state=0)]


def scaled(picture, width, height):
    return cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA)


def framed(picture, width, height):
    """Return a picture in the midst of a black one."""
    canvas = np.zeros((height, width), np.uint8)
    v, u = (height - len(picture)) // 2, (width - picture.shape[1]) // 2
    canvas[v:v + len(picture), u:u + picture.shape[1]] = picture
    return canvas


def fisheyes(sphere):
    return fisheye_picture(sphere, SIDE_BY_SIDE)


def without_corners(sphere):
    """Return two pictures of lenses that are filled to the corners."""
    u, v = np.meshgrid(*[np.arange(-159.5, 160) / 160] * 2)
    lens = np.stack((u, v, np.hypot(u, v) / np.tan(np.hypot(u, v) * np.pi / 2)), axis=-1)
    bearings = np.hstack((lens, lens * (-1, 1, -1)))
    lon, lat = np.arctan2(bearings[..., 0], bearings[..., 2]), np.arcsin(
        -bearings[..., 1] / np.linalg.norm(bearings, axis=-1))
    return cv2.remap(sphere, np.float32((lon / np.pi + 1) * 320 - 0.5),
                     np.float32((0.5 - lat / np.pi) * 320 - 0.5), cv2.INTER_LINEAR,
                     borderMode=cv2.BORDER_WRAP)


def eyes(sphere):
    """Return what two eyes see: what is below is near and lies elsewhere."""
    near = np.roll(sphere, 8, axis=1)
    below = np.linspace(-3, 3, len(sphere))[:, None] > 0
    return sphere, np.where(below, near, sphere)


def half(sphere):
    return sphere[:, 160:480]


OTHERS = {
    'circles side by side': (fisheyes, Appearance.TWO_FISHEYES, 1),
    'circles above each other': (lambda s: np.vstack(np.hsplit(fisheyes(s), 2)),
                                 Appearance.TWO_FISHEYES, 1),
    'a Theta S': (lambda s: fisheye_picture(s, FisheyeConfig()), Appearance.TWO_FISHEYES, 1),
    'circles squeezed to 16:9': (lambda s: scaled(fisheyes(s), 640, 360),
                                 Appearance.TWO_FISHEYES, 8 / 9),
    'lenses without circles': (without_corners, Appearance.TWO_FISHEYES, 1),
    'one circle': (lambda s: np.hsplit(fisheyes(s), 2)[0], Appearance.FISHEYE, 1),
    'one circle in 16:9': (lambda s: framed(np.hsplit(fisheyes(s), 2)[0], 570, 320),
                           Appearance.FISHEYE, 1),
    'one circle in 2:1': (lambda s: framed(np.hsplit(fisheyes(s), 2)[0], 640, 320),
                          Appearance.FISHEYE, 1),
    'eyes above each other': (lambda s: np.vstack(eyes(s)), Appearance.TOP_BOTTOM, 1),
    'eyes above each other in 2:1': (lambda s: scaled(np.vstack(eyes(s)), 640, 320),
                                     Appearance.TOP_BOTTOM, 1),
    'eyes side by side': (lambda s: np.hstack(eyes(s)), Appearance.LEFT_RIGHT, 1),
    'eyes side by side in 2:1': (lambda s: scaled(np.hstack(eyes(s)), 640, 320),
                                 Appearance.LEFT_RIGHT, 1),
    'VR180': (lambda s: np.hstack([half(eye) for eye in eyes(s)]), Appearance.VR180, 1),
    'a letterbox': (lambda s: framed(s, 640, 360), Appearance.BORDERS, 1),
    'borders all around': (lambda s: framed(scaled(s, 600, 300), 640, 320), Appearance.BORDERS, 1),
    'a sphere squeezed to 16:9': (lambda s: scaled(s, 640, 360), Appearance.SQUEEZED, 8 / 9),
    'half a sphere': (half, Appearance.HALF_SPHERE, 1),
}


@pytest.mark.parametrize('kind', OTHERS)
def test_what_is_no_sphere_is_found_out(worlds, kind):
    change, appearance, squeezed = OTHERS[kind]
    for world in worlds:
        seen = seen_in(reduced(change(world)))
        assert seen is not None and seen.appearance is appearance
        assert seen.squeezed == pytest.approx(squeezed, abs=0.04)


def dark(sphere):
    return sphere // 5


def noisy(sphere):
    rng = np.random.default_rng(0)
    return np.uint8(np.clip(sphere + rng.normal(0, 12, sphere.shape), 0, 255))


def seen_within(angles_deg):
    """Return what blackens a sphere beyond angles (lon, lat), as cameras see that lack a lens."""
    def change(sphere):
        x, y, z = np.moveaxis(bearing_grid(sphere.shape[1]), -1, 0)
        lon_deg, lat_deg = np.rad2deg((np.arctan2(x, z), np.arcsin(y)))
        return np.where((abs(lon_deg) < angles_deg[0]) & (abs(lat_deg) < angles_deg[1]),
                        sphere, 0)
    return change


def one_lens(sphere):
    """Return what a lens of 160 degrees sees of a sphere, the rest black."""
    return np.where(bearing_grid(sphere.shape[1])[..., 2] > np.cos(np.deg2rad(80)), sphere, 0)


SPHERES = {
    'as it is': lambda s: s, 'dark': dark, 'noisy': noisy, 'without poles': seen_within((181, 60)),
    'without a rear': seen_within((90, 91)), 'a window': seen_within((72, 47)),
    'one lens': one_lens, 'small': lambda s: scaled(s, 128, 64), 'flat': lambda s: 0 * s + 90,
    'black': lambda s: 0 * s,
}


@pytest.mark.parametrize('kind', SPHERES)
def test_a_sphere_is_taken_for_nothing_else(worlds, kind):
    for world in worlds:
        assert seen_in(reduced(SPHERES[kind](world))) is None


def footage(shared_data):
    """Yield the names of real and simulated spheres, and each tenth of their pictures."""
    for bag in ('drone', 'pioneer', 'handheld'):
        yield bag, recorded(BAGS / bag)
    for name in ('car_overpass/car_overpass.mp4', 'handheld_theta/handheld_theta.mp4',
                 'tripod/cave.mp4', 'company/handheld_a', 'company/pioneer_a',
                 'company/pioneer_b', 'reports/timelapse/timelapse.mp4'):
        if (shared_data / name).exists():
            yield name, recorded(shared_data / name)
    for path in sorted((shared_data / 'photos').glob('*.jpg')):
        yield path.name, [cv2.imread(str(path))]


def recorded(path):
    for number, frame in enumerate(open_recording(path).frames()):
        if number % 10 == 0:
            yield frame.image


@pytest.mark.slow
def test_no_sphere_in_footage_is_taken_for_anything_else(shared_data):
    """However its camera is held."""
    for name, pictures in footage(shared_data):
        for number, picture in enumerate(pictures):
            small = reduced(picture)
            for R in (None, *Rotation.random(4, random_state=number)):
                turned = small if R is None else rotate_equirect(small, R)
                assert seen_in(turned) is None, (name, number)


@pytest.mark.parametrize('name, expected', [
    ('reports/dual_fisheye_as_equirect/VID_00_001.insv', Seen(Appearance.TWO_FISHEYES)),
    ('gear360_road/fallback.mp4', Seen(Appearance.TWO_FISHEYES, 8 / 9)),
    ('reports/vr180/vr180_tagged_v2.mp4', Seen(Appearance.VR180)),
    ('reports/colour/bars709.mp4', None),
    ('tripod/cave.mp4', None),
])
def test_footage_of_the_field(shared_data, name, expected):
    pytest.importorskip('av')
    if not (shared_data / name).exists():
        pytest.skip(f'no {name} beside the checkout')
    for _, frame in zip(range(3), open_recording(shared_data / name).frames()):
        seen = seen_in(reduced(frame.image))
        assert (seen and seen.appearance) is (expected and expected.appearance)
        assert seen is None or seen.squeezed == pytest.approx(expected.squeezed, abs=0.01)


def hints(watch, pictures):
    return [watch.look(Frame(picture, number)) for number, picture in enumerate(pictures)]


def test_it_is_said_once_after_some_pictures(worlds):
    circles = fisheyes(worlds[0])
    watch = PictureWatch()
    said = hints(watch, [circles] * (FIRST + AGREEING * SELDOM))
    assert [number for number, hint in enumerate(said) if hint] == [AGREEING - 1]
    assert 'projection:=dual_fisheye' in watch.hint
    # Another lens is put on: what was said is not true any more.
    assert not any(hints(watch, [worlds[0]] * (AGREEING * SELDOM)))
    assert watch.hint == ''


def test_a_picture_between_others_is_not_believed(worlds):
    circles = fisheyes(worlds[0])
    assert not any(hints(PictureWatch(), [circles, circles, worlds[0], circles, circles]))


def test_circles_are_what_they_are_said_to_be(worlds):
    circles, said = fisheyes(worlds[0]), StabilizerConfig(projection=DUAL_FISHEYE)
    assert not any(hints(PictureWatch(said), [circles] * 3))
    squeezed = [scaled(circles, 640, 360)] * 3
    assert not any(hints(PictureWatch(said), squeezed))
    assert 'with -p fisheye.stretched:=true' in hints(PictureWatch(), squeezed)[-1]


@pytest.mark.parametrize('kind, layout', [
    ('eyes above each other', 'top_bottom'), ('eyes side by side in 2:1', 'left_right'),
    ('VR180', 'vr180'), ('half a sphere', 'half_sphere')])
def test_the_option_that_is_named_reads_them(worlds, kind, layout):
    change, *_ = OTHERS[kind]
    hint = hints(PictureWatch(), [change(worlds[0])] * 3)[-1]
    assert hint.endswith(f'-p layout:={layout} reads them')
    assert not any(hints(PictureWatch(StabilizerConfig(layout=layout)), [change(worlds[0])] * 3))


@pytest.mark.parametrize('kind, advice', [
    ('one circle', '-p projection:=fisheye reads them'), ('a letterbox', 'crop the borders'),
    ('a sphere squeezed to 16:9', '-p projection:=stretched_equirect reads them'),
])
def test_the_line_says_what_to_do(worlds, kind, advice):
    change, *_ = OTHERS[kind]
    assert advice in hints(PictureWatch(), [change(worlds[0])] * 3)[-1]


def test_pictures_of_no_size_are_not_guessed_at():
    for size in ((1, 1), (2, 1), (8, 15)):
        assert not any(hints(PictureWatch(), [np.full((*size, 3), 90, np.uint8)] * 3))
