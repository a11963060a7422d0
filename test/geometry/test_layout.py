# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Which part of a picture shows which part of the sphere."""

import numpy as np
import pytest
from sph_stab_ros.geometry.layout import (
    FRONT, Layout, LAYOUTS, LEFT_HALF, Part, TOP_HALF, WHOLE)
from tiny_recordings import textured_sphere

WIDTH = 256
SPHERE = textured_sphere(WIDTH)
OTHER = textured_sphere(WIDTH, seed=1)
FRONT_HALF = SPHERE[:, WIDTH // 4:-WIDTH // 4]
BLACK = np.zeros_like(SPHERE)


def squeezed(image, across=1, down=1):
    """Return an image with so many times fewer columns and rows."""
    height, width = image.shape[:2]
    return image.reshape(height // down, down, width // across, across, 3).mean(
        axis=(1, 3)).round().astype(np.uint8)


@pytest.mark.parametrize('name, picture', [
    ('top_bottom', np.vstack((SPHERE, OTHER))), ('left_right', np.hstack((SPHERE, OTHER))),
    ('vr180', np.hstack((FRONT_HALF, OTHER[:, :WIDTH // 2]))), ('half_sphere', FRONT_HALF)])
def test_the_left_eye_is_taken_and_what_it_does_not_see_is_black(name, picture):
    layout = LAYOUTS[name]
    expected = SPHERE.copy()
    if 'half' in name or '180' in name:
        expected[:, :WIDTH // 4] = expected[:, -WIDTH // 4:] = 0
    assert layout.sphere_wh(picture.shape[1::-1]) == (WIDTH, WIDTH // 2)
    sphere = layout.sphere(picture)
    assert np.array_equal(sphere, expected)
    assert np.array_equal(layout.seen(WIDTH), expected.any(axis=2))
    # A sphere stays what it is.
    assert layout.in_sphere.sphere(sphere) is sphere
    assert np.array_equal(layout.in_sphere.seen(WIDTH), layout.seen(WIDTH))


def test_grey_pictures_are_laid_out_too():
    grey = np.ascontiguousarray(FRONT_HALF[..., 0])
    sphere = LAYOUTS['half_sphere'].sphere(grey)
    assert np.array_equal(sphere[:, WIDTH // 4:-WIDTH // 4], grey) and sphere.ndim == 2


@pytest.mark.parametrize('used, across, down', [(LEFT_HALF, 2, 1), (TOP_HALF, 1, 2)])
def test_squeezed_eyes_are_spheres_as_wide_as_high_allows(used, across, down):
    """Two spheres in a picture of one: no pixels are invented."""
    small = squeezed(SPHERE, across, down)
    picture = np.concatenate((small, small), axis=1 if across == 2 else 0)
    sphere = Layout(used).sphere(picture)
    assert sphere.shape == (WIDTH // 4, WIDTH // 2, 3)
    assert np.abs(sphere.astype(int) - squeezed(SPHERE, 2, 2)).max() <= 1


@pytest.mark.parametrize('shown', [
    Part(.3, .1, .7, .8), Part(.3037, .1171, .7013, .8291), Part(0., .21, 1., .79)])
def test_any_part_comes_to_lie_where_it_is(shown):
    """A picture of a part, resampled from a fine sphere, agrees with the sphere there."""
    v, u = np.mgrid[:WIDTH // 2, :WIDTH]
    # Smooth, so that half a pixel makes a difference of at most a few grey values.
    sphere = np.uint8(np.rint(127 + 60 * np.sin(u / 20) + 60 * np.cos(v / 15)))
    height, width = 150, 300
    columns = (shown.left + (np.arange(width) + .5) / width * (shown.right - shown.left))
    rows = (shown.top + (np.arange(height) + .5) / height * (shown.bottom - shown.top))
    u, v = columns * WIDTH - .5, rows[:, None] * (WIDTH // 2) - .5
    part = np.uint8(np.rint(127 + 60 * np.sin(u / 20) + 60 * np.cos(v / 15)))
    layout = Layout(WHOLE, shown)
    found = layout.sphere(part)
    own_width = found.shape[1]
    assert found.shape == (own_width // 2, own_width)
    inner = layout.seen(own_width)
    own = WIDTH / own_width
    v, u = np.mgrid[:own_width // 2, :own_width]
    expected = 127 + 60 * np.sin((own * (u + .5) - .5) / 20) + 60 * np.cos(
        (own * (v + .5) - .5) / 15)
    # Half black at the edges, where a pixel lies on them.
    assert np.abs(found - expected)[1:-1, 1:-1][(inner[1:-1, 1:-1] & inner[:-2, 1:-1]
                                                 & inner[2:, 1:-1] & inner[1:-1, :-2]
                                                 & inner[1:-1, 2:])].max() < 2
    assert sphere.shape == (WIDTH // 2, WIDTH)
    beyond = np.array((shown.left * own_width - 1, shown.top * own_width / 2 - 1))
    assert not found[:, :max(int(beyond[0]), 0)].any()
    assert not found[:max(int(beyond[1]), 0)].any()


def test_what_is_seen_is_of_the_solid_angle_that_is_said():
    for shown in (FRONT, Part(.1, .2, .6, .9)):
        share = Layout(WHOLE, shown).seen(1000).mean()
        said = (shown.right - shown.left) * (shown.bottom - shown.top)
        assert said - 0.01 < share <= said
