# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Laws of two fisheye circles: where bearings lie, and what is read out of them."""

from dataclasses import replace

from dual_fisheye_frames import fisheye_picture, fisheye_pixels
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from sph_stab_ros.config import DUAL_FISHEYE, FisheyeConfig, LensConfig, StabilizerConfig
from sph_stab_ros.geometry.equirect import bearing_grid
from sph_stab_ros.geometry.fisheye import dual_fisheye
from sph_stab_ros.geometry.lens_model import lens_of
from sph_stab_ros.geometry.projection import TOLERANCE_PX
from sph_stab_ros.geometry.projection_factory import ProjectionError
from sph_stab_ros.geometry.warp import (
    equirect_warp, perspective_rays, perspective_warp, view_rotation)
from sph_stab_ros.images.frame import Frame
from sph_stab_ros.images.side_by_side import side_by_side
from sph_stab_ros.stabilization.pipeline import Stabilizer
from sph_stab_ros.stabilization.stabilized_frame import StabilizationEvent
from synthetic import angle_deg, textured_sphere

THETA_S = FisheyeConfig()
# Smaller, bent otherwise, and mounted as no camera is.
ODD = FisheyeConfig(
    width=400, height=180, fov_deg=200., blend_deg=12.,
    front=LensConfig(95.2, 88.1, 70., 0.03, 0.004, 10., -7., 33.),
    rear=LensConfig(303.9, 86.4, 68., -0.03, 0., 189., 6., -75.))
BOTH = pytest.mark.parametrize('config', (THETA_S, ODD), ids=('theta_s', 'odd'))
ROTATIONS = [Rotation.identity(), *Rotation.random(3, random_state=1),
             Rotation.from_euler('Y', 90, degrees=True)]
CAMERA = StabilizerConfig(projection=DUAL_FISHEYE)


def lenses(config):
    """Return the DualFisheye of pictures as the config has them."""
    return dual_fisheye(config, (config.width, config.height))


def unit(vectors):
    """Return vectors (..., 3) at length one."""
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


@BOTH
@pytest.mark.parametrize('name', ('front', 'rear'))
def test_pixels_and_bearings_are_inverse(config, name):
    lens = lens_of(getattr(config, name))
    rng = np.random.default_rng(0)
    x = np.concatenate((unit(rng.normal(size=(500, 3))),
                        lens.R_camera_lens.as_matrix().T[None, 2]))
    u, v, theta = (one[0] for one in lens.pixels(2.5 * x[None]))
    axis = lens.R_camera_lens.apply((0, 0, 1))
    np.testing.assert_allclose(np.cos(theta), x @ axis, atol=1e-12)
    seen = theta < np.deg2rad(config.fov_deg / 2)
    assert 200 < seen.sum() < 400
    back = lens.bearings(np.stack((u, v), axis=-1))
    np.testing.assert_allclose(back[seen], x[seen], atol=1e-9)


@BOTH
def test_the_axis_is_at_the_centre_and_the_radius_at_ninety_degrees(config):
    lens = lens_of(config.rear)
    axis, side = lens.R_camera_lens.apply(((0, 0, 1), (1, 0, 0)))
    u, v, theta = (one[0] for one in lens.pixels(np.stack((axis, side))[None]))
    np.testing.assert_allclose((u[0], v[0]), lens.center_px)
    np.testing.assert_allclose((u[1] - u[0], v[1] - v[0]), (config.rear.radius_px, 0), atol=1e-9)
    np.testing.assert_allclose(theta, (0, np.pi / 2), atol=1e-12)


@pytest.mark.parametrize('pixel, bearing', [
    ((319.5, 319.5), (0, 0, 1)), ((959.5, 319.5), (0, 0, -1)),
    # Above is to the left in the front lens' circle and to the right in the rear one's.
    ((34.5, 319.5), (0, -1, 0)), ((1244.5, 319.5), (0, -1, 0)),
    # To the left is below in both.
    ((319.5, 604.5), (-1, 0, 0)), ((959.5, 604.5), (-1, 0, 0))])
def test_a_theta_s_has_its_circles_on_their_sides(pixel, bearing):
    front, rear = lenses(THETA_S).lenses
    lens = front if pixel[0] < 640 else rear
    np.testing.assert_allclose(lens.bearings(np.array(pixel)), bearing, atol=1e-9)


@BOTH
@pytest.mark.parametrize('R', ROTATIONS)
def test_every_pixel_is_read_from_where_it_looks(config, R):
    """Read from circles that hold their own bearings, whatever shares the lenses have."""
    bearings, _ = fisheye_pixels(config)
    projection = lenses(config)
    px_per_rad = projection.sphere_width / (2 * np.pi)
    width, height, hfov_rad = 90, 60, np.deg2rad(100)
    u, v = np.meshgrid(np.arange(width), np.arange(height))
    rays = perspective_rays(np.stack((u, v), axis=-1), hfov_rad, width, height)
    for warp, looking in (
            (equirect_warp(projection.sphere_width), bearing_grid(projection.sphere_width)),
            (perspective_warp(hfov_rad, width, height), rays)):
        seen = warp(np.float32(bearings), R, projection)
        misses = np.linalg.norm(unit(seen) - unit(looking @ R.as_matrix().T), axis=-1)
        assert misses.max() * px_per_rad < 1.5 * TOLERANCE_PX


@BOTH
@pytest.mark.parametrize('R', ROTATIONS)
def test_nothing_is_read_from_beyond_the_field_of_view(config, R):
    _, seen = fisheye_pixels(config)
    sphere = equirect_warp(256)(np.uint8(255 * seen), R, lenses(config))
    assert sphere.min() == 255


@pytest.mark.parametrize('blend_deg', (0., 0.1, 4., 9.))
def test_one_lens_fades_into_the_other(blend_deg):
    """The picture is the front lens' share; where it is neither 0 nor 1 is the band."""
    config = replace(THETA_S, blend_deg=blend_deg)
    picture = np.zeros((720, 1280), np.float32)
    picture[:, :640] = 1
    share = equirect_warp(1140)(picture, Rotation.identity(), lenses(config))
    angle = np.arcsin(bearing_grid(1140)[..., 2])
    blend_rad = np.deg2rad(blend_deg)
    expected = np.clip(0.5 + angle / max(blend_rad, 1e-6), 0, 1)
    clear = abs(angle) > 1e-3
    np.testing.assert_allclose(share[clear], expected[clear], atol=0.02)


def test_no_more_is_blended_than_both_lenses_see():
    config = replace(THETA_S, fov_deg=184., blend_deg=40.)
    assert lenses(config).blend_rad == pytest.approx(np.deg2rad(4))


def test_pictures_of_another_size_are_scaled():
    """As those over HDMI are; centres of pixels, not corners, have whole numbers."""
    usual, larger = lenses(THETA_S), dual_fisheye(THETA_S, (1920, 1080))
    x = unit(np.random.default_rng(0).normal(size=(1, 100, 3)))
    for lens, larger_lens in zip(usual.lenses, larger.lenses):
        for a, b in zip(lens.pixels(x)[:2], larger_lens.pixels(x)[:2]):
            np.testing.assert_allclose(b + 0.5, 1.5 * (a + 0.5))
    assert larger.sphere_width == pytest.approx(1.5 * usual.sphere_width, abs=2)


@BOTH
def test_circles_show_the_sphere_they_were_rendered_from(config):
    projection = lenses(config)
    width = projection.sphere_width
    R_world_camera = Rotation.random(random_state=3)
    picture = fisheye_picture(textured_sphere(2 * width), config, R_world_camera)
    derotated = equirect_warp(width)(picture, R_world_camera.inv(), projection)
    # Of a standard deviation of 43; twice interpolated, and in small pictures too coarse.
    assert np.abs(derotated.astype(float) - textured_sphere(width)).mean() < 1.5
    grey = projection.grey_sphere(Frame(picture, 0), width // 2)
    assert np.abs(grey.astype(float) - textured_sphere(
        width // 2, R_world_camera)).mean() < 5


@pytest.fixture(scope='module')
def film():
    """Return Frames of a camera that turns by 2° about changing axes, and R_world_camera."""
    steps = Rotation.from_rotvec(np.deg2rad(2) * unit(
        np.random.default_rng(0).normal(size=(6, 3))))
    truth = [Rotation.identity()]
    for step in steps:
        truth.append(truth[-1] * step)
    world = textured_sphere(2048)
    return [Frame(np.repeat(fisheye_picture(world, THETA_S, R)[..., None], 3, axis=-1),
                  33_333_333 * i) for i, R in enumerate(truth)], truth


def test_the_stabilizer_takes_the_rotation_out(film):
    frames, truth = film
    stabilizer = Stabilizer(CAMERA)
    stabilized = [stabilizer.process(frame) for frame in frames]
    assert max(angle_deg(one.R_world_camera, R) for one, R in zip(stabilized, truth)) < 0.1
    first, last = (one.sphere().astype(int) for one in (stabilized[0], stabilized[-1]))
    assert first.shape == (570, 1140, 3)
    still = stabilizer.process(frames[0])
    moved = replace(still, R_world_camera=truth[-1]).sphere()
    assert np.abs(first - last).mean() < 0.2 * np.abs(first - moved).mean()
    assert side_by_side(stabilized[-1], view_rotation(), 1.5).shape == (960, 1920, 3)


def test_only_pictures_like_the_calibrated_ones_are_taken(film):
    stabilizer = Stabilizer(CAMERA)
    stabilizer.process(film[0][0])
    for shape in ((720, 1300), (640, 1280, 3), (0, 0, 3)):
        with pytest.raises(ProjectionError, match='1280x720') as error:
            stabilizer.process(Frame(np.zeros(shape, np.uint8), 0))
        assert error.value.reason == 'not as calibrated'
    with pytest.raises(ProjectionError, match='128'):
        stabilizer.process(Frame(np.zeros((72, 128), np.uint8), 0))
    assert StabilizationEvent.RESIZED not in stabilizer.process(film[0][1]).events


def test_the_projection_may_change_while_running(film):
    """What was found goes on from the orientation reached."""
    frames, truth = film
    stabilizer = Stabilizer(CAMERA)
    for frame in frames[:4]:
        before = stabilizer.process(frame)
    stabilizer.reconfigure(StabilizerConfig())
    with pytest.raises(ProjectionError, match='twice as wide'):
        stabilizer.process(frames[4])
    same = replace(before, R_world_camera=Rotation.identity()).sphere()
    after = stabilizer.process(Frame(same, frames[4].stamp_ns))
    assert angle_deg(after.R_world_camera, before.R_world_camera) < 0.1
