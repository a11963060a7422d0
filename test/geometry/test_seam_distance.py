# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What is near meets at the border of two lenses that lie apart, at the distance they are told."""

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from sph_stab_ros.config import (
    ConfigError, DUAL_FISHEYE, FisheyeConfig, LensConfig, StabilizerConfig)
from sph_stab_ros.geometry.equirect import bearing_grid
from sph_stab_ros.geometry.projection import Equirect
from sph_stab_ros.geometry.projection_factory import check_projection, projection_of
from sph_stab_ros.geometry.warp import equirect_warp
from sph_stab_ros.images.frame import Frame
from synthetic import textured_sphere

BASELINE_M, DISTANCE_M = 0.06, 0.8
SIZE_WH, FOV_DEG = (1140, 570), 210.
# Not quite opposite to each other, as no camera is.
LENSES = FisheyeConfig(
    *SIZE_WH, fov_deg=FOV_DEG, blend_deg=0., baseline_m=BASELINE_M,
    front=LensConfig(284.5, 284.5, 240., 0.01, -0.003, 1., 0.5, 0.),
    rear=LensConfig(854.5, 284.5, 240., 0.01, -0.003, 180., -1., 2.))
WIDTH = 960


def projection(seam_distance_m):
    """Return the Projection of the lenses for things so far away."""
    return projection_of(SIZE_WH, StabilizerConfig(
        projection=DUAL_FISHEYE, fisheye=replace(LENSES, seam_distance_m=seam_distance_m)))


@lru_cache(maxsize=1)
def world():
    """Return what is on the wall."""
    return textured_sphere(2048)


def picture_of_room(distance_m):
    """
    Return what two lenses, BASELINE_M apart, see of a round room, by rays out of their centres.

    The room is so large in radius around the middle between them; black beyond their circles.
    """
    uv = np.stack(np.meshgrid(*map(np.arange, SIZE_WH)), axis=-1).astype(float)
    picture = np.zeros(SIZE_WH[::-1], np.uint8)
    far = projection(0.)
    for side, lens in enumerate(far.lenses):
        rays = lens.bearings(uv)
        axis = lens.R_camera_lens.apply((0., 0., 1.))
        center_m = BASELINE_M / 2 * axis
        # Steps of Newton's along each ray to the wall.
        length_m = np.full(rays.shape[:2], distance_m)
        for _ in range(8):
            points_m = center_m + length_m[..., None] * rays
            off_m = np.linalg.norm(points_m, axis=-1) - distance_m
            slope = np.sum(points_m * rays, axis=-1) / np.linalg.norm(points_m, axis=-1)
            length_m -= off_m / slope
        points_m = center_m + length_m[..., None] * rays
        seen = Equirect(2048).read(world(), *np.float32(np.moveaxis(points_m, -1, 0)))
        circle = (rays @ axis > np.cos(np.deg2rad(FOV_DEG / 2))) & (
            (uv[..., 0] < SIZE_WH[0] / 2) == (side == 0))
        picture[circle] = seen[circle]
    return picture


def errors_by_border(picture, seam_distance_m):
    """Return by how much a sphere read from a picture errs, near the border and all over."""
    sphere = equirect_warp(WIDTH)(picture, Rotation.identity(), projection(seam_distance_m))
    error = np.abs(sphere.astype(float) - textured_sphere(WIDTH))
    near = np.abs(np.arcsin(bearing_grid(WIDTH)[..., 2])) < np.deg2rad(8)
    return error[near].mean(), error.mean()


@pytest.mark.parametrize('distance_m', (DISTANCE_M, 3.))
def test_what_is_as_far_as_said_meets_at_the_border(distance_m):
    picture = picture_of_room(distance_m)
    near, everywhere = errors_by_border(picture, distance_m)
    by_infinity, _ = errors_by_border(picture, 0.)
    by_half, _ = errors_by_border(picture, distance_m / 2)
    assert near < 2 and everywhere < 2
    assert by_infinity > 5 * near and by_half > 5 * near


def test_what_is_infinitely_far_meets_without_it():
    """And to the far world a distance of kilometres is the same."""
    far = picture_of_room(1e5)
    near, _ = errors_by_border(far, 0.)
    assert near < 2
    assert errors_by_border(far, 1e5)[0] == pytest.approx(near, abs=0.05)
    assert errors_by_border(far, DISTANCE_M)[0] > 5 * near


def test_the_two_lenses_show_a_near_thing_in_one_place():
    """Along the border each lens sees it where the other does, on the axes nothing moves."""
    told = projection(DISTANCE_M)
    border = bearing_grid(256)[np.abs(bearing_grid(256)[..., 2]) < 0.1].astype(float)
    points_m = DISTANCE_M * border[None]
    for lens, far in zip(told.lenses, projection(0.).lenses):
        center_m = BASELINE_M / 2 * lens.R_camera_lens.apply((0., 0., 1.))
        np.testing.assert_allclose(
            lens.pixels(points_m)[:2], far.pixels(points_m - center_m)[:2], atol=1e-9)
        axis = center_m[None, None] / np.linalg.norm(center_m)
        np.testing.assert_allclose(
            np.ravel(lens.pixels(axis)[:2]), np.ravel(far.pixels(axis)[:2]), atol=1e-9)


def test_the_tracker_is_given_the_world_as_it_is_far_away():
    frame = Frame(picture_of_room(1e5), 0)
    np.testing.assert_array_equal(
        projection(DISTANCE_M).grey_sphere(frame, 512), projection(0.).grey_sphere(frame, 512))


def test_nearer_than_both_lenses_see_is_refused():
    # The border would be seen by neither: 15 degrees more than half a sphere is a slope of 0.27.
    config = StabilizerConfig(projection=DUAL_FISHEYE, fisheye=replace(
        LENSES, seam_distance_m=BASELINE_M / 2 / 0.25))
    check_projection(config)
    with pytest.raises(ConfigError, match='seam_distance_m') as error:
        check_projection(replace(config, fisheye=replace(
            config.fisheye, seam_distance_m=BASELINE_M / 2 / 0.28)))
    assert '\n' not in str(error.value)
