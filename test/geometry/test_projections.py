# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Laws of every projection: where bearings lie, what is read out of it, what it does not see."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from projection_pictures import picture_of, PICTURES, pixel_grid, projection_named
import pytest
from scipy.spatial.transform import Rotation
from sph_stab_ros.config import settings_of, StabilizerConfig
from sph_stab_ros.config.parameter_file import read_parameter_files
from sph_stab_ros.geometry.equirect import bearing_grid
from sph_stab_ros.geometry.fisheye import DualFisheye, Fisheye
from sph_stab_ros.geometry.masks import share_of_sphere
from sph_stab_ros.geometry.pixel_map import NOWHERE
from sph_stab_ros.geometry.projection import TOLERANCE_PX
from sph_stab_ros.geometry.projection_factory import (
    check_projection, projection_of, ProjectionError)
from sph_stab_ros.geometry.warp import equirect_warp, perspective_view, perspective_warp
from sph_stab_ros.images.frame import Frame
from sph_stab_ros.stabilization.pipeline import Stabilizer
from sph_stab_ros.tracking import make_tracker
from synthetic import angle_deg, textured_sphere, unit

# Of these others of their kind are among the tests that take little time.
ALIKE = ('cube 6x1', 'cube 1x6', 'cube 4x3', 'cube, other order', 'equi-angular 16:9',
         'GoPro Max 3K', 'fisheye 280', 'near at the border', 'one above the other')
EACH = pytest.mark.parametrize('name', [
    pytest.param(name, marks=pytest.mark.thorough if name in ALIKE else ()) for name in PICTURES])
MAX_ROUND_TRIP_DEG = 0.02
MIN_PSNR_DB = 35.
# Along axes, across edges and into corners of cubes, around poles and the seam, and anywhere.
LOOKS = Rotation.from_euler('YX', [
    (0, 0), (45, 0), (90, 45), (180, 0), (0, 90), (0, -90), (135, 35.3), (-45, -35.3), (17, 71)],
    degrees=True)
TURNS = [Rotation.identity(), *Rotation.random(2, random_state=1)]


def angles_deg(a, b):
    """Return the angles (...) between vectors (..., 3)."""
    return np.rad2deg(2 * np.arcsin(np.linalg.norm(unit(a) - unit(b), axis=-1) / 2))


def located(projection, xyz):
    """Return the pixels (h, w, 2) of bearings (h, w, 3), and which are seen."""
    u, v, face = projection.pixels(*np.moveaxis(xyz, -1, 0))
    return np.stack((u, v), axis=-1).astype(float), face != NOWHERE


def is_inside(projection, xyz):
    """Tell which bearings (h, w, 3) are seen, and not in the outermost half pixel of a face."""
    uv, seen = located(projection, xyz)
    back, _ = projection.bearings(uv)
    return seen & (angles_deg(back, xyz) < MAX_ROUND_TRIP_DEG)


def psnr_db(a, b, used):
    """Return the peak signal-to-noise ratio of two pictures at pixels (h, w) bool."""
    error = a.astype(float)[used] - b[used]
    return 10 * np.log10(255 ** 2 / max(np.mean(error ** 2), 1e-12))


@EACH
def test_pixels_look_where_bearings_lie(name):
    projection = projection_named(name)
    uv = pixel_grid(projection.size_wh)
    xyz, shown = projection.bearings(uv)
    assert shown.mean() > 0.4
    np.testing.assert_allclose(np.linalg.norm(xyz[shown], axis=-1), 1)
    back, seen = located(projection, xyz)
    again, _ = projection.bearings(back)
    # A pixel may show what another one shows too, as where two lenses overlap.
    same = shown & (np.linalg.norm(back - uv, axis=-1) < 0.5)
    assert same.sum() > 0.8 * shown.sum()
    assert seen[same].all()
    assert angles_deg(again, xyz)[same].max() < MAX_ROUND_TRIP_DEG


@EACH
def test_bearings_come_back_but_for_half_a_pixel_at_edges(name):
    projection = projection_named(name)
    xyz = bearing_grid(512).astype(float)
    uv, seen = located(projection, xyz)
    again, shown = projection.bearings(uv)
    assert shown[seen].mean() > 0.99
    angle = angles_deg(again, xyz)[seen]
    assert np.quantile(angle, 0.95) < MAX_ROUND_TRIP_DEG
    # Around the poles of a sphere and in corners of faces pixels are not square.
    assert angle.max() < 360 / projection.sphere_width


@EACH
def test_every_pixel_is_read_from_where_it_looks(name):
    """Read from a picture that holds its own bearings."""
    projection = projection_named(name)
    own, _ = projection.bearings(pixel_grid(projection.size_wh))
    for R in TURNS:
        target = equirect_warp(1024)(np.float32(own), R, projection)
        looking = bearing_grid(1024) @ R.as_matrix().T
        # What is read beside the edge of what is seen is half black.
        inside = cv2.erode(np.uint8(is_inside(projection, looking)), np.ones((5, 5))) > 0
        miss_px = np.linalg.norm(target - looking, axis=-1)[inside] * 1024 / (2 * np.pi)
        assert inside.mean() > 0.2
        assert np.quantile(miss_px, 0.999) < 1.5 * TOLERANCE_PX
        assert miss_px.max() < 1


@pytest.fixture(scope='module')
def photo(shared_data):
    """Return a real photo of a sphere, 2048 px wide, with no more detail than a sphere of 1024."""
    path = shared_data / 'photos' / 'petra.jpg'
    small = cv2.resize(cv2.imread(str(path)), (1024, 512), interpolation=cv2.INTER_AREA)
    soft = cv2.GaussianBlur(cv2.copyMakeBorder(small, 0, 0, 16, 16, cv2.BORDER_WRAP), (0, 0), 1.2)
    wide = cv2.resize(soft, None, fx=2, fy=2, interpolation=cv2.INTER_CUBIC)
    return np.ascontiguousarray(wide[:, 32:-32])


@pytest.mark.thorough
@EACH
def test_views_are_those_of_the_sphere(name, photo):
    """Of pictures as fine as the sphere, turned and not: a picture turns with its camera."""
    projection = projection_named(name)
    size_wh, hfov_rad = (240, 180), np.deg2rad(80)
    for R_world_camera in TURNS:
        picture = picture_of(projection, photo, R_world_camera)
        sphere = equirect_warp(1024)(picture, R_world_camera.inv(), projection)
        seen = projection.seen(512)
        seen = np.ones((512, 1024), bool) if seen is None else cv2.resize(
            np.uint8(seen), (1024, 512), interpolation=cv2.INTER_NEAREST) > 0
        seen = equirect_warp(1024)(np.uint8(255 * seen), R_world_camera.inv()) == 255
        assert psnr_db(sphere, cv2.resize(photo, (1024, 512), interpolation=cv2.INTER_AREA),
                       seen) > MIN_PSNR_DB
        for R_world_view in LOOKS:
            R_camera_view = R_world_camera.inv() * R_world_view
            view = perspective_warp(hfov_rad, *size_wh)(picture, R_camera_view, projection)
            used = perspective_view(np.uint8(255 * seen), R_world_view, hfov_rad, size_wh) == 255
            if used.sum() > 1000:
                expected = perspective_view(photo, R_world_view, hfov_rad, size_wh)
                assert psnr_db(view, expected, used) > MIN_PSNR_DB


@EACH
def test_what_is_not_seen_is_black_and_the_rest_is_not(name):
    projection = projection_named(name)
    white = np.full(projection.size_wh[::-1], 255, np.uint8)
    # Where the edge is may differ by the last digits of a float.
    around = np.ones((3, 3), np.uint8)
    for R in TURNS:
        _, seen = located(projection, bearing_grid(1024) @ R.as_matrix().T)
        target = equirect_warp(1024)(white, R, projection)
        assert set(np.unique(target)) <= {0, 255}
        assert (target[cv2.erode(np.uint8(seen), around) > 0] == 255).all()
        assert not target[cv2.dilate(np.uint8(seen), around) == 0].any()


@EACH
def test_the_mask_keeps_off_the_edge_but_not_far(name):
    projection = projection_named(name)
    _, seen = located(projection, bearing_grid(1024))
    mask = projection.seen(1024)
    assert (mask is None) == seen.all()
    if mask is not None:
        assert not (mask & ~seen).any()
        assert mask.sum() > 0.95 * seen.sum()


@pytest.mark.thorough
@EACH
def test_the_stabilizer_takes_the_rotation_out_and_uses_only_what_is_seen(name):
    truth = [Rotation.identity()]
    for axis in unit(np.random.default_rng(0).normal(size=(4, 3))):
        truth.append(truth[-1] * Rotation.from_rotvec(np.deg2rad(2) * axis))
    world, projection, config = textured_sphere(1024), projection_named(name), PICTURES[name][1]
    masks = []

    def watched(*args):
        masks.append(args[3] if len(args) > 3 else None)
        return make_tracker(*args)

    stabilizer = Stabilizer(config, watched)
    for i, R in enumerate(truth):
        found = stabilizer.process(Frame(picture_of(projection, world, R), 33_333_333 * i))
        assert angle_deg(found.R_world_camera, R) < 0.2
    expected = projection.seen(640)
    assert (masks[0] is None) == (expected is None)
    if expected is not None:
        np.testing.assert_array_equal(masks[0], expected)


@pytest.mark.parametrize('name, pixels', [
    # Of the centres of faces, and of what is above and to the right in them.
    ('cube 3x2', {'r': (128, 128), 'l': (384, 128), 'u': (640, 128), 'd': (128, 384),
                  'f': (384, 384), 'b': (640, 384)}),
    ('cube 6x1', {'r': (128, 128), 'l': (384, 128), 'u': (640, 128), 'd': (896, 128),
                  'f': (1152, 128), 'b': (1408, 128)}),
    ('cube 1x6', {'r': (128, 128), 'l': (128, 384), 'u': (128, 640), 'd': (128, 896),
                  'f': (128, 1152), 'b': (128, 1408)}),
    ('cube 4x3', {'u': (384, 128), 'l': (128, 384), 'f': (384, 384), 'r': (640, 384),
                  'b': (896, 384), 'd': (384, 640)})])
def test_faces_stand_where_ffmpeg_has_them(name, pixels):
    looks = {'r': (1, 0, 0), 'l': (-1, 0, 0), 'u': (0, -1, 0), 'd': (0, 1, 0), 'f': (0, 0, 1),
             'b': (0, 0, -1)}
    projection = projection_named(name)
    for face, (u, v) in pixels.items():
        found, seen = located(projection, np.array([[looks[face]]], float))
        assert seen.all()
        np.testing.assert_allclose(found[0, 0], (u - 0.5, v - 0.5), atol=1e-4)
        # A little above the front's edge is the lower edge of what is above.
        if face == 'u':
            nodding, _ = located(projection, np.array([[(0., -1., .5)]]))
            np.testing.assert_allclose(nodding[0, 0], (u - 0.5, v + 64 - 0.5), atol=1e-4)


@pytest.mark.parametrize('bearing, pixel', [
    ((-1, 0, 0), (130, 130)), ((0, 0, 1), (390, 130)), ((1, 0, 0), (650, 130)),
    ((0, 1, 0), (130, 390)), ((0, 0, -1), (390, 390)), ((0, -1, 0), (650, 390)),
    # The lower band lies on its side: up are the right-hand things, to the right the upper ones.
    ((.5, 0, -1), (390, 315)), ((0, -.5, -1), (465, 390))])
def test_youtubes_faces_lie_in_two_bands(bearing, pixel):
    found, _ = located(projection_named('equi-angular'), np.array([[bearing]], float))
    u, v = np.subtract(pixel, 0.5)
    # tan of half the half edge is not 0.5.
    np.testing.assert_allclose(found[0, 0], (u, v), atol=2.2)


@pytest.mark.parametrize('size_wh, config, reason', [
    ((640, 640), PICTURES['cube 3x2'][1], 'six square faces'),
    ((60, 40), PICTURES['cube 3x2'][1], 'at least 128'),
    ((0, 0), PICTURES['stretched 16:9'][1], 'at least 128'),
    ((640, 480), PICTURES['fisheye 180'][1], '560x540'),
    ((1280, 720), StabilizerConfig(), '2:1')])
def test_other_pictures_are_refused(size_wh, config, reason):
    with pytest.raises(ProjectionError, match=reason):
        projection_of(size_wh, config)


@pytest.mark.parametrize('name, size_wh, kind', [
    ('theta_s', (1920, 1080), DualFisheye), ('gear360', (1280, 720), DualFisheye),
    ('gear360', (3840, 1920), DualFisheye), ('fisheye', (1080, 1080), Fisheye)])
def test_files_of_cameras_fit_their_pictures(name, size_wh, kind):
    path = Path(__file__).parents[2] / 'config' / f'{name}.yaml'
    config = settings_of(read_parameter_files([path])).config
    check_projection(config)
    projection = projection_of(size_wh, config)
    assert type(projection) is kind
    seen = projection.seen(256)
    # All around, or what a cone of half the field of view holds, but for the edge.
    expected = (1 - np.cos(np.deg2rad(config.fisheye.fov_deg / 2))) / 2
    assert (seen is None if kind is DualFisheye
            else share_of_sphere(seen) == pytest.approx(expected, abs=0.02))


def test_stretched_circles_are_read_where_the_calibration_says_so():
    """Two circles of 2:1 squeezed to 16:9, as a Samsung Gear 360's player delivers them."""
    size_wh, config = PICTURES['side by side']
    squeezed_wh = (1280, 720)
    with pytest.raises(ProjectionError, match='not as calibrated'):
        projection_of(squeezed_wh, config)
    squeezed = projection_of(squeezed_wh, replace(
        config, fisheye=replace(config.fisheye, stretched=True)))
    usual, xyz = projection_of(size_wh, config), bearing_grid(256).astype(float)
    (uv, _), (squeezed_uv, _) = located(usual, xyz), located(squeezed, xyz)
    np.testing.assert_allclose(
        (squeezed_uv + 0.5) / squeezed_wh, (uv + 0.5) / size_wh, atol=1e-6)


@pytest.mark.parametrize('size_wh', [(1921, 961), (1921, 960), (641, 320), (639, 320)])
def test_spheres_of_odd_sizes_are_spheres(size_wh):
    """Of which none is exactly twice as wide as high; all of it is seen, in its directions."""
    projection = projection_of(size_wh, StabilizerConfig())
    assert projection.seen(512) is None
    width, height = size_wh
    bearings, _ = projection.bearings(np.array([[((width - 1) / 2, (height - 1) / 2)]]))
    np.testing.assert_allclose(bearings[0, 0], (0, 0, 1), atol=1e-9)
    image = np.tile(np.arange(width) * 200 // width, (height, 1)).astype(np.uint8)
    sphere = equirect_warp(projection.sphere_width)(image, Rotation.identity(), projection)
    expected = np.arange(sphere.shape[1]) * 200 / sphere.shape[1]
    assert np.abs(sphere[:, 2:-2] - expected[2:-2]).max() < 2
