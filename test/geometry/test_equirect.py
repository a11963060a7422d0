# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Laws of the equirectangular geometry."""

import numpy as np
import pytest

from sph_stab_ros.geometry.equirect import (
    bearing_grid, bearings_from_pixels, is_equirect, pad_sphere, pixels_from_bearings,
    row_solid_angles)

WIDTHS = (64, 130, 640)


@pytest.mark.parametrize('width', WIDTHS)
def test_pixels_survive_the_round_trip(width):
    v, u = np.mgrid[:width // 2, :width]
    uv = np.stack((u, v), axis=-1).astype(float)
    np.testing.assert_allclose(
        pixels_from_bearings(bearings_from_pixels(uv, width), width), uv, atol=1e-9)


@pytest.mark.parametrize('width', WIDTHS)
def test_bearings_survive_the_round_trip_at_seam_and_poles_too(width):
    rng = np.random.default_rng(0)
    bearings = rng.normal(size=(1000, 3))
    seam = np.column_stack((1e-9 * rng.normal(size=20), rng.normal(size=20), -np.ones(20)))
    poles = np.array(((0, 1, 0), (0, -1, 0), (1e-9, 1, -1e-9)))
    bearings = np.vstack((bearings, seam, poles))
    bearings /= np.linalg.norm(bearings, axis=1, keepdims=True)
    uv = pixels_from_bearings(bearings, width)
    np.testing.assert_allclose(bearings_from_pixels(uv, width), bearings, atol=1e-9)
    assert np.all((uv >= -0.5 - 1e-9) & (uv <= (width - 0.5, width / 2 - 0.5)))


def test_axes_are_the_optical_ones():
    width = 400
    centre_left_right_top = ((199.5, 99.5), (99.5, 99.5), (299.5, 99.5), (0, -0.5))
    np.testing.assert_allclose(
        bearings_from_pixels(np.array(centre_left_right_top), width),
        ((0, 0, 1), (-1, 0, 0), (1, 0, 0), (0, -1, 0)), atol=1e-12)


def test_columns_wrap_and_rows_run_over_the_pole():
    width = 360
    across_seam, across_pole = np.array((width + 3.25, 10)), np.array((20, -2.))
    np.testing.assert_allclose(
        bearings_from_pixels(across_seam, width),
        bearings_from_pixels(np.array((3.25, 10)), width), atol=1e-12)
    np.testing.assert_allclose(
        bearings_from_pixels(across_pole, width),
        bearings_from_pixels(np.array((20 + width / 2, 1)), width), atol=1e-12)


@pytest.mark.parametrize('width', WIDTHS)
def test_solid_angles_add_up_to_the_sphere(width):
    assert row_solid_angles(width).sum() * width == pytest.approx(4 * np.pi)
    # Each is that of the pixel: cos(lat) times the pixel's area, for small pixels.
    lat = np.pi / 2 - (np.arange(width // 2) + 0.5) * 2 * np.pi / width
    np.testing.assert_allclose(
        row_solid_angles(width), np.cos(lat) * (2 * np.pi / width) ** 2, rtol=(4 / width) ** 2)


@pytest.mark.parametrize('channels', ((), (3,)))
@pytest.mark.parametrize('margin_px', (1, 7))
def test_padding_continues_the_sphere(channels, margin_px):
    """Every padded pixel holds what lies at its bearing: an image of pixel numbers tells."""
    width, height = 64, 32
    numbers = np.arange(width * height).reshape(height, width)
    image = np.broadcast_to(numbers.reshape(height, width, *[1] * len(channels)),
                            (height, width, *channels))
    padded = pad_sphere(image, margin_px)
    v, u = np.mgrid[-margin_px:height + margin_px, -margin_px:width + margin_px]
    bearings = bearings_from_pixels(np.stack((u, v), axis=-1), width)
    expected_uv = np.rint(pixels_from_bearings(bearings, width)).astype(int)
    expected = image[expected_uv[..., 1], expected_uv[..., 0] % width]
    np.testing.assert_array_equal(padded, expected)


def test_the_grid_is_the_bearing_of_each_pixel():
    grid = bearing_grid(64)
    assert grid.shape == (32, 64, 3)
    np.testing.assert_allclose(
        grid[5, 11], bearings_from_pixels(np.array((11, 5)), 64), atol=1e-6)
    with pytest.raises(ValueError):
        grid[0, 0] = 0


@pytest.mark.parametrize('shape, expected', [
    ((320, 640), True), ((320, 640, 3), True), ((322, 640), False), ((0, 0, 3), False)])
def test_spheres_are_twice_as_wide_as_high(shape, expected):
    assert is_equirect(shape) is expected
