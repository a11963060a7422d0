# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Pictures that were read row by row come out as if they had been read at once."""

from dataclasses import replace

import cv2
import numpy as np
from projection_pictures import PICTURES, pixel_grid, projection_named
import pytest
from scipy.spatial.transform import Rotation
from sph_stab_ros.config import COLUMNS, ROWS, StabilizerConfig, TrackerConfig
from sph_stab_ros.geometry.equirect import bearing_grid, pixels_from_bearings
from sph_stab_ros.geometry.projection import Equirect
from sph_stab_ros.geometry.rolling_shutter import (
    rate_at_end, readout_shares, RollingShutter, shares_along, SHARES_WIDTH)
from sph_stab_ros.geometry.warp import equirect_warp
from synthetic import textured_sphere, unit

WIDTH = 1024
# Of a camera that turns by 100 degrees a second, read for 30 ms.
TURN = np.deg2rad((1.5, -2.2, 1.4))
SPHERE = textured_sphere(WIDTH)
# As projections are asked for.
MIN_PSNR_DB = 35.
# An error of half the size.
HALVED_DB = 6.


def read_in_turn(projection, size_wh, turn, by=ROWS, lenses=1):
    """Return a picture (h, w, 3) of SPHERE by a camera that turns meanwhile."""
    bearings, _ = projection.bearings(pixel_grid(size_wh))
    extent = size_wh[0 if by == COLUMNS else 1]
    # Each lens' at the same time.
    share = (np.arange(extent) + 0.5) / (extent / lenses) % 1 - 0.5
    turned = Rotation.from_rotvec(share[:, None] * turn).as_matrix().swapaxes(-1, -2)
    looks = (bearings[:, :, None] @ turned[None])[:, :, 0] if by == COLUMNS else bearings @ turned
    return Equirect(WIDTH).read(SPHERE, *np.moveaxis(np.float32(looks), -1, 0))


class Whole(Equirect):
    """A sphere that tells where its pixels look."""

    def bearings(self, uv):
        """Return them for all there are."""
        return bearing_grid(self.width), None


def psnr_db(a, b, where):
    """Return how alike pictures are."""
    difference = np.float32(a)[where] - np.float32(b)[where]
    return 10 * np.log10(255 ** 2 / np.mean(difference ** 2))


@pytest.mark.parametrize('name, by, lenses', [
    ('sphere', ROWS, 1), ('side by side', ROWS, 1), ('fisheye 280', ROWS, 1),
    ('stretched 16:9', ROWS, 1), ('one above the other', ROWS, 2), ('fisheye 280', COLUMNS, 1),
    ('side by side', COLUMNS, 2)])
def test_what_was_read_in_turn_comes_out_as_if_read_at_once(name, by, lenses):
    """As exactly as a picture that was."""
    projection, size_wh = (Whole(WIDTH), (WIDTH, WIDTH // 2)) if name == 'sphere' else (
        projection_named(name), PICTURES[name][0])
    warp = equirect_warp(WIDTH)
    at_once, rolled = (
        read_in_turn(projection, size_wh, turn, by, lenses) for turn in (0 * TURN, TURN))
    config = PICTURES[name][1] if name in PICTURES else StabilizerConfig()
    shares = readout_shares(projection, size_wh, replace(
        config, tracker=TrackerConfig(rolling_shutter_by=by)))
    seen = projection.seen(WIDTH)
    if seen is None:
        seen = np.ones((WIDTH // 2, WIDTH), bool)
    # What lies at the rim in the middle of the read-out may have been beyond it when it was read.
    where = cv2.erode(np.uint8(seen), np.ones((9, 9))) > 0
    expected = warp(at_once, Rotation.identity(), projection)
    plain = psnr_db(warp(rolled, Rotation.identity(), projection), expected, where)
    straight = psnr_db(warp(rolled, Rotation.identity(), RollingShutter(projection, shares, TURN)),
                       expected, where)
    assert straight > max(MIN_PSNR_DB, plain + HALVED_DB)


@pytest.mark.parametrize('name', PICTURES)
def test_a_camera_that_stands_still_is_read_as_before(name):
    """Bit by bit."""
    projection, (size_wh, config) = projection_named(name), PICTURES[name]
    rolling = RollingShutter(
        projection, readout_shares(projection, size_wh, config), np.zeros(3))
    assert rolling.border == projection.border
    assert rolling.sphere_width == projection.sphere_width
    for one, other in zip(rolling.nodes(*np.moveaxis(bearing_grid(64), -1, 0).copy()),
                          projection.nodes(*np.moveaxis(bearing_grid(64), -1, 0).copy())):
        np.testing.assert_array_equal(one, other)


def test_shares_go_from_the_first_row_to_the_last():
    """Of a sphere, as latitudes do."""
    shares = readout_shares(Equirect(WIDTH), (WIDTH, WIDTH // 2))
    assert shares.shape == (SHARES_WIDTH // 2, SHARES_WIDTH)
    bearings = unit(np.random.default_rng(0).normal(size=(200, 3)))
    row = pixels_from_bearings(bearings, WIDTH)[:, 1]
    np.testing.assert_allclose(
        shares_along(shares, bearings), (row + 0.5) / (WIDTH / 2) - 0.5,
        atol=1 / SHARES_WIDTH)


@pytest.mark.parametrize('acceleration', (0., 0.3, -2.))
def test_the_rate_at_the_end_of_intervals_is_exact_to_the_second_order(acceleration):
    """Of what accelerates evenly."""
    def angle(t):
        return np.array((0.4, -0.2, 0.1)) * t + acceleration * t ** 2 * np.array((1., 2., 3.))
    rate = rate_at_end(angle(2.) - angle(1.), angle(1.) - angle(0.))
    np.testing.assert_allclose(
        rate, np.array((0.4, -0.2, 0.1)) + 4 * acceleration * np.array((1., 2., 3.)))
