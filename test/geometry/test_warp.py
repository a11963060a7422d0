# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Laws of the inverse warp."""

import gc
import multiprocessing
import warnings

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sph_stab_ros.geometry.equirect import bearing_grid, bearings_from_pixels, pixels_from_bearings
from sph_stab_ros.geometry.projection import TOLERANCE_PX
from sph_stab_ros.geometry.warp import (
    equirect_warp, focal_length_px, InverseWarp, perspective_rays, perspective_view,
    perspective_warp, rotate_equirect, view_rotation)

ROTATIONS = [
    Rotation.identity(), *Rotation.random(4, random_state=1),
    Rotation.from_euler('X', 90, degrees=True), Rotation.from_euler('Y', 180, degrees=True)]


def smooth_sphere(width, R_world_camera=Rotation.identity()):
    """Return a colour image of a smooth world, exactly as a camera turned in it sees it."""
    x = bearing_grid(width) @ R_world_camera.as_matrix().T
    waves = [np.sin(x @ np.array(k)) for k in ((3, 1, 2), (-1, 4, 1), (2, -2, 3))]
    return np.uint8(np.rint(128 + 100 * np.stack(waves, axis=-1)))


def misses_px(warp, R, target_bearings, width):
    """
    Return by how many equatorial pixels each target pixel looks beside its bearing (h, w, 3).

    Read from a sphere ``width`` wide that holds its own bearings; beyond the centres of the
    outermost rows these are the rows'.
    """
    exact_uv = pixels_from_bearings(target_bearings @ R.as_matrix().T, width)
    exact_uv[..., 1] = exact_uv[..., 1].clip(0, width / 2 - 1)
    seen = warp(bearing_grid(width), R)
    seen /= np.linalg.norm(seen, axis=-1, keepdims=True)
    return np.linalg.norm(
        seen - bearings_from_pixels(exact_uv, width), axis=-1) * width / (2 * np.pi)


@pytest.mark.parametrize('R', ROTATIONS)
@pytest.mark.parametrize('width', (128, 638))
def test_every_pixel_is_read_from_where_it_looks(R, width):
    exact = bearing_grid(width).astype(float)
    assert misses_px(equirect_warp(width), R, exact, 640).max() < 1.5 * TOLERANCE_PX


@pytest.mark.parametrize('R', ROTATIONS)
def test_nodes_may_look_elsewhere_from_call_to_call(R):
    """As the nodes of another warp do; the one asked keeps its own."""
    warp = equirect_warp(640)
    R_other = Rotation.random(random_state=8)
    node_bearings = 3 * bearings_from_pixels(warp.nodes_px, 640) @ R_other.as_matrix().T
    sphere = smooth_sphere(640)
    np.testing.assert_allclose(
        warp(sphere, R, node_bearings=node_bearings).astype(int),
        rotate_equirect(sphere, R * R_other), atol=1)


@pytest.mark.parametrize('size_wh', ((1, 1), (5, 17), (1000, 2), (61, 45)))
def test_targets_may_have_any_size(size_wh):
    warp = InverseWarp(lambda uv: bearings_from_pixels(uv, 640), size_wh)
    sphere = smooth_sphere(640)
    expected = sphere[:size_wh[1], np.arange(size_wh[0]) % 640]
    np.testing.assert_array_equal(warp(sphere, Rotation.identity()), expected)


@pytest.mark.parametrize('size_wh', ((640, 320), (101, 499), (61, 45)))
def test_threads_make_no_difference(size_wh):
    warp = InverseWarp(lambda uv: bearings_from_pixels(uv, 640), size_wh)
    sphere, threads_before = smooth_sphere(640), cv2.getNumThreads()
    try:
        seen = []
        for threads in (1, 2, 5):
            cv2.setNumThreads(threads)
            seen.append(warp(sphere, ROTATIONS[1]))
    finally:
        cv2.setNumThreads(threads_before)
    np.testing.assert_array_equal(seen[1], seen[0])
    np.testing.assert_array_equal(seen[2], seen[0])


def test_a_forked_process_has_threads_of_its_own():
    """As a pool of processes on Linux does, after its parent has drawn something."""
    forked = multiprocessing.get_context('fork').Process(
        target=rotate_equirect, args=(smooth_sphere(640), ROTATIONS[1]), daemon=True)
    threads_before = cv2.getNumThreads()
    try:
        cv2.setNumThreads(2)
        rotate_equirect(smooth_sphere(640), ROTATIONS[1])
        with warnings.catch_warnings():
            # Of what can go wrong with others' threads.
            warnings.simplefilter('ignore', DeprecationWarning)
            # Nothing of here may be collected there: decoders would wait for their threads.
            gc.freeze()
            forked.start()
        forked.join(60)
    finally:
        gc.unfreeze()
        cv2.setNumThreads(threads_before)
        forked.kill()
    assert forked.exitcode == 0


@pytest.mark.parametrize('R', ROTATIONS)
def test_the_warp_shows_what_a_turned_camera_sees(R):
    """The seam and the poles of source and target lie anywhere in these."""
    turned = rotate_equirect(smooth_sphere(640), R)
    np.testing.assert_allclose(turned.astype(int), smooth_sphere(640, R), atol=3)


@pytest.mark.parametrize('R', ROTATIONS)
def test_the_warp_is_near_to_one_in_double_precision(R):
    turned = rotate_equirect(smooth_sphere(640), R)
    exact = smooth_sphere(640, R).astype(float)
    psnr_db = 45
    assert np.mean((turned - exact) ** 2) < 255 ** 2 / 10 ** (psnr_db / 10)


def test_derotation_takes_the_rotation_out():
    R_world_camera = Rotation.random(random_state=5)
    derotated = rotate_equirect(smooth_sphere(640, R_world_camera), R_world_camera.inv())
    np.testing.assert_allclose(derotated.astype(int), smooth_sphere(640), atol=3)


def test_identity_returns_the_image():
    image = np.random.default_rng(0).integers(0, 256, (80, 160, 3), np.uint8)
    np.testing.assert_array_equal(rotate_equirect(image, Rotation.identity()), image)


@pytest.mark.parametrize('R', ROTATIONS)
def test_nothing_is_ever_read_from_outside_the_sphere(R):
    white = np.full((100, 200), 255, np.uint8)
    assert rotate_equirect(white, R).min() == 255
    assert perspective_view(white, R, np.deg2rad(150), (90, 70)).min() == 255


@pytest.mark.parametrize('shape', ((64, 128), (64, 128, 3), (64, 128, 4)))
def test_shapes_and_types_are_kept(shape):
    image = np.zeros(shape, np.uint8)
    turned = rotate_equirect(image, ROTATIONS[1])
    assert turned.shape == shape and turned.dtype == np.uint8
    view = perspective_view(image, ROTATIONS[1], 1., (50, 30))
    assert view.shape == (30, 50, *shape[2:]) and view.dtype == np.uint8


@pytest.mark.parametrize('R', ROTATIONS)
@pytest.mark.parametrize('channels', (2, 3, 4))
@pytest.mark.parametrize('size_wh', ((322, 161), (61, 45)))
def test_channels_are_read_as_if_each_were_alone(R, channels, size_wh):
    """However many are read at a time, and up to both ends of each row."""
    image = np.random.default_rng(3).integers(0, 256, (90, 180, channels), np.uint8)
    warp = InverseWarp(lambda uv: bearings_from_pixels(uv, 322), size_wh)
    alone = [warp(np.ascontiguousarray(image[..., one]), R) for one in range(channels)]
    np.testing.assert_array_equal(warp(image, R), np.stack(alone, axis=-1))


@pytest.mark.parametrize('R', ROTATIONS)
def test_views_project_by_a_pinhole(R):
    width, height, hfov_rad = 90, 60, np.deg2rad(100)
    x, y = np.meshgrid(np.arange(width) - (width - 1) / 2, np.arange(height) - (height - 1) / 2)
    rays = np.stack((x, y, np.full_like(x, focal_length_px(hfov_rad, width))), axis=-1)
    warp = perspective_warp(hfov_rad, width, height)
    assert misses_px(warp, R, rays, 640).max() < 1.5 * TOLERANCE_PX


def test_the_field_of_view_is_the_width_of_the_image():
    edge = perspective_rays(np.array((-0.5, 24.5)), np.deg2rad(90), 100, 50)
    np.testing.assert_allclose(edge, (-1, 0, 1), atol=1e-6)


@pytest.mark.parametrize('hfov_deg', (0, 180, 200, -10))
def test_impossible_fields_of_view_are_refused(hfov_deg):
    with pytest.raises(ValueError, match='field of view'):
        perspective_view(np.zeros((64, 128), np.uint8), ROTATIONS[0], np.deg2rad(hfov_deg), (8, 8))


@pytest.mark.parametrize('angles_deg, looks_along', [
    ((90, 0, 0), (-1, 0, 0)), ((0, 90, 0), (0, -1, 0)), ((-90, 0, 0), (1, 0, 0)),
    ((90, 45, 0), (-np.sqrt(.5), -np.sqrt(.5), 0))])
def test_yaw_looks_left_and_pitch_up(angles_deg, looks_along):
    R_world_view = view_rotation(*np.deg2rad(angles_deg))
    np.testing.assert_allclose(R_world_view.apply((0, 0, 1)), looks_along, atol=1e-12)


def test_roll_turns_the_view_clockwise():
    """The right of the view then looks down."""
    np.testing.assert_allclose(
        view_rotation(roll_rad=np.pi / 2).apply((1, 0, 0)), (0, 1, 0), atol=1e-12)


def test_a_chart_reads_the_right_way_round(shared_data):
    """FRONT, LEFT and TOP of a labelled chart lie where they should, by their colours."""
    chart = cv2.imread(str(shared_data / 'photos' / 'egjs_equi_4096.jpg'))
    green, cyan, yellow = (115, 250, 115), (255, 255, 115), (115, 250, 255)
    for angles_deg, bgr in (((0, 0, 0), green), ((90, 0, 0), cyan), ((0, 90, 0), yellow)):
        view = perspective_view(chart, view_rotation(*np.deg2rad(angles_deg)), 1., (40, 40))
        assert np.abs(np.median(view, axis=(0, 1)) - bgr).max() < 20
