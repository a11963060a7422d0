# Copyright 2026 The sph_stab_ros developers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""The map of the anchored tracker: few keyframes, and landmarks where they are wanted."""

from functools import lru_cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sph_stab_ros.equirect import pixels_from_bearings
from sph_stab_ros.estimators.pose import CAUCHY
from sph_stab_ros.trackers.patches import MAX_LATITUDE_RAD, Patches, Pyramid
from sph_stab_ros.trackers.surroundings import (
    ADJUSTED_KEYFRAMES, Landmarks, Map, MAX_KEYFRAMES, MAX_LANDMARKS, MIN_DISTANCE_PX, Sightings,
    trusted)
from synthetic import angle_deg, random_rotation, textured_sphere, unit

WIDTH = 320
SIGMA_RAD = 1e-3
NOTHING = Sightings(np.empty(0, int), np.empty((0, 3)), np.empty((0, 2, 3)))
EVERYWHERE = np.ones((1, 2), bool)
GREY = np.zeros((8, 16), np.uint8)


@lru_cache(maxsize=4)
def sphere(seed=0):
    return textured_sphere(WIDTH, seed=seed)


def add_keyframe(surroundings, R=Rotation.identity(), position=(0, 0, 0), sightings=NOTHING):
    surroundings.add_keyframe(
        R, np.array(position, float), np.zeros((3, 3)), GREY, None, sightings)


def look_around(surroundings, grey, usable=EVERYWHERE):
    surroundings.add_landmarks(grey, Pyramid(grey), usable)


def started(grey=None, usable=EVERYWHERE):
    """Return a Map of one keyframe and its landmarks."""
    surroundings = Map()
    add_keyframe(surroundings)
    look_around(surroundings, sphere() if grey is None else grey, usable)
    return surroundings


def some_patches(count):
    """Return any Patches."""
    x = np.tile((0., 0., 1.), (count, 1))
    return Patches.cut(Pyramid(sphere()), x, np.roll(x, 1, axis=1), np.roll(x, 2, axis=1))


def add_points(surroundings, x, rho, ids):
    """Let the last keyframe host landmarks along x (N, 3) in its camera, at known depths."""
    n = len(ids)
    new = Landmarks(ids, np.full(n, surroundings.keyframes[-1].number), x, x, x, rho, np.ones(n),
                    np.zeros(n, int), np.zeros(n, int), np.ones(n, bool),
                    surroundings.store.put(some_patches(n)))
    known = surroundings.landmarks
    surroundings.landmarks = new if known is None else Landmarks.joined((known, new))


def seen_from(surroundings, R, position):
    """Return the exact Sightings of all landmarks from a pose."""
    rows = np.arange(len(surroundings.landmarks))
    y = R.inv().apply(surroundings.directions(rows, position))
    first = unit(np.cross(y, (0.3, 0.5, 0.8)))
    return Sightings(surroundings.landmarks.number.copy(), y,
                     np.stack((first, np.cross(y, first)), axis=1) / SIGMA_RAD)


def travelled(rng, keyframes, points=25):
    """Return a true Map after a journey, each keyframe hosts some points and sees all others."""
    surroundings = Map()
    for i in range(keyframes):
        R, position = random_rotation(rng, 5 * i), 0.1 * i * np.array((1., 0.2, 0.4))
        sightings = NOTHING if i == 0 else seen_from(surroundings, R, position)
        add_keyframe(surroundings, R, position, sightings)
        add_points(surroundings, unit(rng.normal(size=(points, 3))),
                   rng.uniform(0.3, 1, points), i * points + np.arange(points))
        surroundings.shrink()
    return surroundings


def pixels(landmarks):
    """Return where landmarks of one and the same keyframe are in its picture."""
    return pixels_from_bearings(landmarks.x, WIDTH)


def distances_px(uv):
    """Return the distances between pixels in the picture, infinite to themselves."""
    distance = np.linalg.norm(uv[:, None] - uv, axis=2)
    distance[np.diag_indices_from(distance)] = np.inf
    return distance


def test_landmarks_are_new_rising_and_at_the_corners_of_their_host():
    landmarks = started().landmarks
    assert 100 < len(landmarks) <= MAX_LANDMARKS
    assert (np.diff(landmarks.number) > 0).all()
    assert (landmarks.host == 0).all() and landmarks.active.all()
    axes = np.stack((landmarks.x, landmarks.east, landmarks.south), axis=1)
    np.testing.assert_allclose(axes @ np.swapaxes(axes, 1, 2) - np.eye(3), 0, atol=1e-9)
    assert (landmarks.south[:, 1] > 0).all()
    np.testing.assert_allclose(landmarks.inverse_depth, 1)


def test_landmarks_keep_their_distance_and_away_from_the_poles():
    landmarks = started().landmarks
    assert distances_px(pixels(landmarks)).min() > MIN_DISTANCE_PX - 1e-6
    assert np.abs(np.arcsin(landmarks.x[:, 1])).max() < MAX_LATITUDE_RAD


def test_new_landmarks_keep_away_from_those_that_are_looked_for():
    rng = np.random.default_rng(1)
    surroundings = started()
    landmarks = surroundings.landmarks
    landmarks.active[:] = rng.random(len(landmarks)) < 0.5
    active = np.flatnonzero(landmarks.active)
    R = random_rotation(rng, 40)
    add_keyframe(surroundings, R)
    look_around(surroundings, textured_sphere(WIDTH, R))
    landmarks = surroundings.landmarks
    new = landmarks.host == 1
    assert new.sum() > 30
    assert landmarks.active.sum() <= MAX_LANDMARKS
    assert landmarks.number[new].min() > landmarks.number[~new].max()
    there = pixels_from_bearings(R.inv().apply(landmarks.x[active]), WIDTH)
    distance = np.linalg.norm(there[:, None] - pixels(landmarks[new]), axis=2)
    # Pixels are whole.
    assert distance.min() > MIN_DISTANCE_PX - 1


def test_new_landmarks_are_as_far_as_the_others_in_the_median():
    surroundings = started()
    surroundings.landmarks.inverse_depth[:] = 0.4
    surroundings.landmarks.active[::2] = False
    add_keyframe(surroundings)
    look_around(surroundings, sphere())
    new = surroundings.landmarks.host == 1
    assert new.any()
    np.testing.assert_allclose(surroundings.landmarks.inverse_depth[new], 0.4)


def test_where_enough_are_looked_for_none_are_added():
    surroundings = started()
    known = surroundings.landmarks
    while len(surroundings.landmarks) < MAX_LANDMARKS:
        surroundings.landmarks = Landmarks.joined((surroundings.landmarks, known))
    before = len(surroundings.landmarks)
    add_keyframe(surroundings)
    look_around(surroundings, sphere(seed=1))
    assert len(surroundings.landmarks) == before


@pytest.mark.parametrize('shape', ((WIDTH // 2, WIDTH), (80, 160), (8, 16)))
def test_landmarks_are_where_they_may_be(shape):
    usable = np.zeros(shape, bool)
    height, width = shape
    usable[height // 4:height // 2, width // 4:width // 2] = True
    u, v = pixels(started(usable=usable).landmarks).T
    assert len(u) > 5
    assert u.min() > WIDTH / 4 - 1 and u.max() < WIDTH / 2
    assert v.min() > WIDTH / 8 - 1 and v.max() < WIDTH / 4


@pytest.mark.parametrize('grey, usable', (
    (np.full((WIDTH // 2, WIDTH), 90, np.uint8), EVERYWHERE),
    (100 + sphere() // 64, EVERYWHERE),
    (sphere(), ~EVERYWHERE)))
def test_without_texture_or_room_there_are_none(grey, usable):
    surroundings = Map()
    add_keyframe(surroundings)
    look_around(surroundings, grey, usable)
    assert surroundings.landmarks is None or len(surroundings.landmarks) == 0


def test_the_map_stays_small_and_keeps_its_first_and_last_keyframes():
    rng = np.random.default_rng(2)
    surroundings = Map()
    for i in range(MAX_KEYFRAMES + 30):
        add_keyframe(surroundings, position=rng.normal(size=3))
        add_points(surroundings, unit(rng.normal(size=(2, 3))), np.ones(2), 2 * i + np.arange(2))
        surroundings.shrink()
        ids = [one.number for one in surroundings.keyframes]
        assert len(ids) == min(i + 1, MAX_KEYFRAMES)
        assert ids[0] == 0
        assert ids[-ADJUSTED_KEYFRAMES:] == list(range(i + 1))[-ADJUSTED_KEYFRAMES:]
        assert ids == sorted(set(ids))
    # With the keyframes go the landmarks that they host, and no others.
    np.testing.assert_array_equal(surroundings.landmarks.host, np.repeat(ids, 2))


def test_of_many_keyframes_one_goes_that_has_another_one_near():
    surroundings = started()
    positions = [(float(i), 0, 0) for i in range(MAX_KEYFRAMES)]
    positions[20] = (19.1, 0, 0)
    for position in positions:
        add_keyframe(surroundings, position=position)
    surroundings.shrink()
    ids = {one.number for one in surroundings.keyframes}
    gone = set(range(MAX_KEYFRAMES + 1)) - ids
    assert len(gone) == 1 and gone <= {20, 21}


def test_landmarks_are_found_in_the_direction_and_at_the_depth_they_are():
    rng = np.random.default_rng(3)
    surroundings = travelled(rng, MAX_KEYFRAMES + 4, points=3)
    rows = rng.permutation(len(surroundings.landmarks))[:20]
    position = rng.normal(size=3)
    keyframes = {one.number: one for one in surroundings.keyframes}
    for row, direction in zip(rows, surroundings.directions(rows, position)):
        one = surroundings.landmarks[row:row + 1]
        host = keyframes[one.host[0]]
        point = host.position + host.R @ one.x[0] / one.inverse_depth[0]
        np.testing.assert_allclose(direction, unit(point - position), atol=1e-9)


@pytest.mark.parametrize('count', (0, 7, 30, 1000))
def test_near_are_those_at_rest_whose_hosts_are_nearest(count):
    rng = np.random.default_rng(4)
    surroundings = travelled(rng, 10, points=10)
    landmarks = surroundings.landmarks
    landmarks.active[:] = rng.random(len(landmarks)) < 0.4
    position = surroundings.keyframes[6].position + 0.01
    rows = surroundings.near(position, count)
    resting = np.flatnonzero(~landmarks.active)
    assert len(rows) == min(count, len(resting))
    assert (np.diff(rows) > 0).all() and np.isin(rows, resting).all()
    _, origins = surroundings.hosts(resting)
    distance = np.linalg.norm(origins - position, axis=1)
    chosen = np.isin(resting, rows)
    assert not chosen.any() or chosen.all() or distance[chosen].max() <= distance[~chosen].min()


def test_near_none_at_rest_there_is_nothing():
    assert len(started().near(np.zeros(3), 10)) == 0


# With few keyframes, with more than are adjusted, and with gaps among them.
@pytest.mark.parametrize('count', (2, 5, ADJUSTED_KEYFRAMES + 4, MAX_KEYFRAMES + 5))
def test_disturbed_keyframes_and_landmarks_come_back(count):
    rng = np.random.default_rng(5)
    surroundings = travelled(rng, count, points=60 if count < 10 else 8)
    keyframes, landmarks = surroundings.keyframes, surroundings.landmarks
    first = max(len(keyframes) - ADJUSTED_KEYFRAMES, 1)
    truth = [(one.R, one.position) for one in keyframes]
    for one in keyframes[first:]:
        one.R = random_rotation(rng, 0.5).as_matrix() @ one.R
        one.position = one.position + rng.normal(0, 0.005, 3)
    distance = np.linalg.norm(keyframes[-1].position)
    true_depths = landmarks.inverse_depth.copy()
    landmarks.inverse_depth *= np.exp(rng.normal(0, 0.05, len(landmarks)))
    surroundings.adjust()
    ratio = np.linalg.norm(keyframes[-1].position) / np.linalg.norm(truth[-1][1])
    # What is the unit of length in the beginning stays so.
    assert abs(ratio - 1) < 0.1
    if first == 1:
        assert abs(np.linalg.norm(keyframes[-1].position) / distance - 1) < 5e-3
    for i, (one, (R, position)) in enumerate(zip(keyframes, truth)):
        if i < first:
            np.testing.assert_array_equal(one.R, R)
            np.testing.assert_array_equal(one.position, position)
        assert angle_deg(Rotation.from_matrix(one.R), Rotation.from_matrix(R)) < 0.01
        np.testing.assert_allclose(one.position, ratio * position, atol=2e-3)
    assert len(surroundings.landmarks) == len(true_depths)
    hosted = surroundings.landmarks.host < keyframes[-1].number
    error = surroundings.landmarks.inverse_depth * ratio - true_depths
    assert np.median(np.abs(error[hosted])) < 2e-3


def test_landmarks_that_go_their_own_way_are_given_up():
    rng = np.random.default_rng(6)
    surroundings = travelled(rng, 6, points=40)
    truth = [one.R for one in surroundings.keyframes]
    wrong = np.arange(5, 60, 7)
    for one in surroundings.keyframes[1:]:
        moving = np.isin(one.sightings.number, wrong)
        one.sightings.y[moving] = unit(
            one.sightings.y[moving] + rng.normal(0, 0.1, (moving.sum(), 3)))
    before = surroundings.landmarks.number
    surroundings.adjust()
    np.testing.assert_array_equal(surroundings.landmarks.number, np.setdiff1d(before, wrong))
    # From now on they have no say, though they were seen.
    surroundings.adjust()
    for one, true in zip(surroundings.keyframes, truth):
        assert angle_deg(Rotation.from_matrix(one.R), Rotation.from_matrix(true)) < 1e-5


def test_trust_falls_with_size_and_rises_with_scale():
    sizes = np.linspace(0, 10, 50)
    for scale in (0.5, 1., 2.):
        assert trusted(sizes, scale)[0] and not trusted(sizes, scale)[-1]
        assert (np.diff(trusted(sizes, scale).astype(int)) <= 0).all()
        quarter = CAUCHY * scale * np.sqrt(3)
        np.testing.assert_array_equal(
            trusted(quarter * np.array((0.99, 1.01)), scale), (True, False))
