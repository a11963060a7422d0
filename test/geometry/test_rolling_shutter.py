# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Pictures that were read row by row come out as if they had been read at once."""

import numpy as np
from projection_pictures import PICTURES, pixel_grid, projection_named
import pytest
from scipy.spatial.transform import Rotation
from sph_stab_ros.geometry.equirect import bearing_grid, pixels_from_bearings
from sph_stab_ros.geometry.projection import Equirect
from sph_stab_ros.geometry.rolling_shutter import (
    rate_at_end, RollingShutter, row_shares, shares_along, SHARES_WIDTH)
from sph_stab_ros.geometry.warp import equirect_warp
from synthetic import textured_sphere, unit

WIDTH = 1024
# Of a camera that turns by 100 degrees a second, read for 30 ms.
TURN = np.deg2rad((1.5, -2.2, 1.4))
SPHERE = textured_sphere(WIDTH)
# As projections are asked for.
MIN_PSNR_DB = 35.


def read_row_by_row(projection, size_wh, turn):
    """Return a picture (h, w, 3) of SPHERE by a camera that turns meanwhile."""
    bearings, _ = projection.bearings(pixel_grid(size_wh))
    share = (np.arange(size_wh[1]) + 0.5) / size_wh[1] - 0.5
    turned = Rotation.from_rotvec(share[:, None] * turn).as_matrix()
    looks = bearings @ turned.swapaxes(-1, -2)
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


@pytest.mark.parametrize('name', ['sphere', 'side by side', 'fisheye 280', 'stretched 16:9'])
def test_what_was_read_row_by_row_comes_out_as_if_read_at_once(name):
    """As exactly as a picture that was."""
    projection, size_wh = (Whole(WIDTH), (WIDTH, WIDTH // 2)) if name == 'sphere' else (
        projection_named(name), PICTURES[name][0])
    warp = equirect_warp(WIDTH)
    at_once, rolled = (read_row_by_row(projection, size_wh, turn) for turn in (0 * TURN, TURN))
    shares = row_shares(projection, size_wh[1])
    seen = projection.seen(WIDTH)
    where = np.ones((WIDTH // 2, WIDTH), bool) if seen is None else seen
    expected = warp(at_once, Rotation.identity(), projection)
    plain = psnr_db(warp(rolled, Rotation.identity(), projection), expected, where)
    straight = psnr_db(warp(rolled, Rotation.identity(), RollingShutter(projection, shares, TURN)),
                       expected, where)
    assert straight > MIN_PSNR_DB > plain


@pytest.mark.parametrize('name', PICTURES)
def test_a_camera_that_stands_still_is_read_as_before(name):
    """Bit by bit."""
    projection, (_, height) = projection_named(name), PICTURES[name][0]
    rolling = RollingShutter(projection, row_shares(projection, height), np.zeros(3))
    assert rolling.border == projection.border
    assert rolling.sphere_width == projection.sphere_width
    for one, other in zip(rolling.nodes(*np.moveaxis(bearing_grid(64), -1, 0).copy()),
                          projection.nodes(*np.moveaxis(bearing_grid(64), -1, 0).copy())):
        np.testing.assert_array_equal(one, other)


def test_shares_go_from_the_first_row_to_the_last():
    """Of a sphere, as latitudes do."""
    shares = row_shares(Equirect(WIDTH), WIDTH // 2)
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
