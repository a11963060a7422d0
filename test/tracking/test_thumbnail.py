# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Tiny spheres, aligned by their grey values."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sph_stab_ros.tracking.anchored.thumbnail import (
    align_thumbnails, difference, rotation_gradient, Thumbnail, ThumbnailOptions)
from synthetic import angle_deg, random_rotation, textured_sphere


def thumbnail(grey):
    return Thumbnail(grey, ThumbnailOptions())


@pytest.mark.parametrize('angle', (0, 1, 5, 15))
def test_rotations_are_found_from_nothing(angle):
    rng = np.random.default_rng(angle)
    for _ in range(4):
        R = random_rotation(rng, angle)
        reference, current = thumbnail(textured_sphere(256)), thumbnail(textured_sphere(256, R))
        found = align_thumbnails(reference, current, Rotation.identity())
        assert angle_deg(found, R.inv()) < 0.5


def test_brightness_and_contrast_do_not_matter():
    R = random_rotation(np.random.default_rng(1), 5)
    current = np.uint8(0.6 * textured_sphere(256, R) + 20)
    found = align_thumbnails(
        thumbnail(textured_sphere(256)), thumbnail(current), Rotation.identity())
    assert angle_deg(found, R.inv()) < 0.5


def test_the_difference_is_smallest_where_pictures_agree():
    R = random_rotation(np.random.default_rng(2), 10)
    reference, current = thumbnail(textured_sphere(256)), thumbnail(textured_sphere(256, R))
    right = difference(reference, current, R.inv())
    assert right < 0.2 < 0.5 < difference(reference, current, Rotation.identity())
    other = thumbnail(textured_sphere(256, seed=1))
    assert difference(reference, other, Rotation.identity()) > 0.5


def test_the_gradient_tells_how_a_small_turn_changes_the_picture():
    omega = np.deg2rad((0.3, -0.5, 0.4))
    before, after = (thumbnail(textured_sphere(256, R))
                     for R in (Rotation.identity(), Rotation.from_rotvec(omega)))
    change = (rotation_gradient(before.padded, before.margin_px) @ omega)[4:-4]
    happened = (after.image - before.image)[4:-4]
    assert np.corrcoef(change.ravel(), happened.ravel())[0, 1] > 0.97
    assert 0.8 < (change * happened).sum() / (change * change).sum() < 1.25
