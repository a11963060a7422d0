# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The turn of a camera between places far apart."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from sph_stab_ros.tracking.anchored.relocalization import (
    RelocalizationOptions, Relocalizer, turn_with_less_parallax)
from sph_stab_ros.tracking.frame_to_frame.estimators.base import BearingPairs
from sph_stab_ros.tracking.frame_to_frame.estimators.essential import fit_essential
from synthetic import angle_deg, random_rotation, unit


@pytest.mark.parametrize('max_deg', [1, 60, 179])
def test_turns_of_any_size_are_told_from_their_opposites(max_deg):
    rng = np.random.default_rng(0)
    for _ in range(10):
        points = rng.uniform(-3, 3, size=(80, 3))
        points = points[np.linalg.norm(points, axis=1) > 1.5]
        R, t = random_rotation(rng, max_deg), unit(rng.normal(size=3))
        pairs = BearingPairs(unit(points), unit(R.apply(points - t)), np.ones(len(points)))
        estimate = fit_essential(pairs)
        assert angle_deg(turn_with_less_parallax(estimate, pairs), R) < 0.1


def test_without_translation_the_turn_is_found_as_well():
    rng = np.random.default_rng(1)
    for _ in range(10):
        R, x = random_rotation(rng, 179), unit(rng.normal(size=(80, 3)))
        noise = 1e-3 * rng.normal(size=x.shape)
        pairs = BearingPairs(x, unit(R.apply(x) + noise), np.ones(len(x)))
        estimate = fit_essential(pairs)
        assert angle_deg(turn_with_less_parallax(estimate, pairs), R) < 1


def test_so_many_pictures_are_tried():
    grey, used = np.zeros((80, 160), np.uint8), np.ones((80, 160), bool)
    options = RelocalizationOptions(max_pictures=5)
    recognition = Relocalizer([], grey, Rotation.identity(), used, options)
    for _ in range(options.max_pictures - 1):
        assert recognition.is_over
        recognition = recognition.with_another(grey, Rotation.identity())
    assert recognition.with_another(grey, Rotation.identity()) is None
