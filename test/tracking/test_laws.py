# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Laws that every estimator keeps, on pictures of a flight through a painted room."""

import numpy as np
from painted_room import FINE, flight, PERIOD_NS, room
import pytest
from scipy.spatial.transform import Rotation

from sph_stab_ros.config import ANCHORED, METHODS, TrackerConfig
from sph_stab_ros.images.texture import at_most
from sph_stab_ros.tracking import make_tracker, TrackingStatus
from synthetic import random_rotation

WIDTH = 960
# What a rotation between two pictures may differ by, in pixels of the coarser one.
MAX_DIFFERENCE_PX = 0.05
every_estimator = pytest.mark.parametrize('estimator', (ANCHORED, *METHODS))


@pytest.fixture(scope='module')
def images():
    """Return the spheres of a flight, of the largest width."""
    return [room(*pose, WIDTH, FINE) for pose in zip(*flight(4))]


def turns(estimator, images, width):
    """Return the Rotations from each picture to the next, as the tracker finds them."""
    tracker = make_tracker(TrackerConfig(estimator=estimator), width)
    results = [tracker.track(at_most(image, width), i * PERIOD_NS)
               for i, image in enumerate(images)]
    assert {result.status for result in results} == {TrackingStatus.OK}
    R = Rotation.concatenate([result.R_world_camera for result in results])
    return R[:-1].inv() * R[1:]


def differences_px(one, other, width):
    """Return the angles between Rotations, in pixels of spheres of a width."""
    return (one.inv() * other).magnitude() * width / (2 * np.pi)


@every_estimator
@pytest.mark.parametrize('width, finer', (
    (320, 480), pytest.param(480, 640, marks=pytest.mark.thorough),
    pytest.param(640, 960, marks=pytest.mark.slow)))
def test_the_width_of_the_picture_does_not_matter(estimator, width, finer, images):
    found, expected = turns(estimator, images, width), turns(estimator, images, finer)
    assert differences_px(found, expected, width).max() < MAX_DIFFERENCE_PX


@every_estimator
@pytest.mark.parametrize('width', (320, pytest.param(640, marks=pytest.mark.slow)))
def test_backwards_the_motion_is_the_inverse(estimator, images, width):
    there = turns(estimator, images, width)
    back = turns(estimator, images[::-1], width)[::-1]
    assert np.rad2deg(there.magnitude()).min() > 0.5
    assert differences_px(there, back.inv(), width).max() < MAX_DIFFERENCE_PX


@every_estimator
def test_however_the_camera_is_mounted_its_turns_are_the_same(estimator, images):
    mount = random_rotation(np.random.default_rng(3), 50)
    R, p = flight(len(images))
    plain = turns(estimator, images, 480)
    mounted = turns(estimator, [room(R_i * mount, p_i, WIDTH, FINE)
                                for R_i, p_i in zip(R, p)], 480)
    assert differences_px(mount * mounted * mount.inv(), plain, 480).max() < MAX_DIFFERENCE_PX
