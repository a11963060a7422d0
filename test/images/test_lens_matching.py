# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Two lenses of different exposure look like one: laws of rendered dual fisheye pictures."""

from dataclasses import replace

import cv2
import numpy as np
from projection_pictures import PICTURES, pixel_grid, projection_named
import pytest
from scipy.spatial.transform import Rotation
from sph_stab_ros.config import DUAL_FISHEYE, FisheyeConfig
from sph_stab_ros.geometry.equirect import bearing_grid
from sph_stab_ros.geometry.projection import Equirect
from sph_stab_ros.geometry.warp import equirect_warp
from sph_stab_ros.images.frame import Frame
from sph_stab_ros.images.lens_matching import FOLLOWING_S, LensMatcher
from sph_stab_ros.stabilization.pipeline import Stabilizer
from tiny_recordings import textured_sphere

TWO_CIRCLES = ['side by side', pytest.param('one above the other', marks=pytest.mark.thorough)]
WANTED = FisheyeConfig(match_lenses=True)
# Of rear over front, in blue, green and red: half as bright, and yellower.
GAINS = 0.55, 0.7, 0.8


@pytest.fixture(params=TWO_CIRCLES)
def projection(request):
    return projection_named(request.param)


def picture(projection, gains=(1, 1, 1), seed=0):
    """Return what two lenses show of a textured sphere, nowhere white; the rear one by gains."""
    sphere = np.uint8(20 + textured_sphere(1024, seed) * 0.8)
    bearings, seen = projection.bearings(pixel_grid(projection.size_wh))
    shown = Equirect(1024).read(sphere, *np.float32(np.moveaxis(bearings, -1, 0))).astype(float)
    front, rear = (np.linalg.norm(pixel_grid(projection.size_wh) - lens.center_px, axis=-1)
                   for lens in projection.lenses)
    shown[rear < front] *= gains
    return np.uint8(np.round(shown)) * seen[..., None].astype(np.uint8)


def matched(image, projection, matcher=None, time_ns=0, config=WANTED):
    return (matcher or LensMatcher()).matched(Frame(image, time_ns), projection, config).image


def step(image, projection):
    """
    Return how large a step of brightness there is at the border of the lenses, in shares (3,).

    Means over 5 degrees on either side, of the sphere that is read from a picture.
    """
    sphere = equirect_warp(1024)(image, Rotation.identity(), projection)
    x, y, z = cv2.split(bearing_grid(1024))
    angle_deg = np.rad2deg(np.arcsin(z / np.sqrt(x * x + y * y + z * z)))
    front, rear = (sphere[(3 < side * angle_deg) & (side * angle_deg < 8)].mean(axis=0)
                   for side in (1, -1))
    return rear / front - 1


def test_of_equal_lenses_the_picture_is_unchanged(projection):
    image = picture(projection)
    assert np.array_equal(matched(image, projection), image)


def test_unless_wanted_it_is_unchanged(projection):
    frame = Frame(picture(projection, GAINS), 0)
    assert LensMatcher().matched(frame, projection, FisheyeConfig()) is frame


def test_the_step_at_the_border_goes(projection):
    """But for what is in the scene itself, and for the slope that it becomes."""
    scene = step(picture(projection), projection)
    before = step(picture(projection, GAINS), projection) - scene
    after = step(matched(picture(projection, GAINS), projection), projection) - scene
    assert (before < -0.15).all()
    assert (np.abs(after) < np.abs(before) / 10).all()


def test_whichever_lens_is_brighter(projection):
    scene = step(picture(projection), projection)
    dark = np.uint8(picture(projection, 1 / np.array(GAINS) * 0.55))
    assert np.abs(step(matched(dark, projection), projection) - scene).max() < 0.03


def test_grey_pictures_too(projection):
    grey = cv2.cvtColor(picture(projection, (0.6, 0.6, 0.6)), cv2.COLOR_BGR2GRAY)
    found = matched(grey, projection)
    assert found.shape == grey.shape
    scene = step(cv2.merge([cv2.cvtColor(picture(projection), cv2.COLOR_BGR2GRAY)] * 3),
                 projection)
    assert np.abs(step(cv2.merge([found] * 3), projection) - scene).max() < 0.03


def test_far_from_the_border_nothing_changes(projection):
    """So nothing that is seen in the overlap can spoil the picture elsewhere."""
    image = picture(projection, GAINS)
    before, after = (equirect_warp(1024)(one, Rotation.identity(), projection)
                     for one in (image, matched(image, projection)))
    z = bearing_grid(1024)[..., 2]
    far = np.abs(z) > np.sin(np.deg2rad(61))
    assert np.array_equal(before[far], after[far]) and not np.array_equal(before, after)


def test_what_either_lens_sees_otherwise_is_not_matched(projection):
    """As near things, which lie elsewhere for each: here each sees another scene."""
    front, rear = picture(projection), picture(projection, seed=1)
    near = [np.linalg.norm(pixel_grid(projection.size_wh) - lens.center_px, axis=-1)
            for lens in projection.lenses]
    image = np.where((near[0] < near[1])[..., None], front, rear)
    changed = np.abs(matched(image, projection).astype(int) - image)
    assert changed.mean() < 2


def test_white_in_both_stays_white(projection):
    image = picture(projection, GAINS)
    white = image.copy()
    white[image.any(axis=-1)] = 255
    assert np.array_equal(matched(white, projection), white)


def test_a_change_is_followed_slowly(projection):
    """After the time constant by two thirds."""
    matcher = LensMatcher()
    same, darker = picture(projection), picture(projection, GAINS)
    matched(same, projection, matcher)
    scene, before = step(same, projection), step(darker, projection)
    at_once = step(matched(darker, projection, matcher, 1), projection)
    assert at_once == pytest.approx(before, abs=0.01)
    later = step(matched(darker, projection, matcher, round(FOLLOWING_S * 1e9)), projection)
    assert np.log((1 + later) / (1 + scene)) == pytest.approx(
        np.exp(-1) * np.log((1 + before) / (1 + scene)), abs=0.03)


def test_pictures_that_tell_nothing_are_left(projection):
    black = np.zeros((*projection.size_wh[::-1], 3), np.uint8)
    assert np.array_equal(matched(black, projection), black)


@pytest.mark.parametrize('name', TWO_CIRCLES)
def test_the_stabilizer_shows_it(name):
    size_wh, config = PICTURES[name]
    config = replace(config, projection=DUAL_FISHEYE,
                     fisheye=replace(config.fisheye, match_lenses=True))
    projection = projection_named(name)
    image = picture(projection, GAINS)
    shown = Stabilizer(config).process(Frame(image, 0)).sphere()
    expected = equirect_warp(projection.sphere_width)(
        matched(image, projection), Rotation.identity(), projection)
    assert np.array_equal(shown, expected) and image.shape[1::-1] == size_wh
