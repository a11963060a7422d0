# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The map of the anchored tracker: few keyframes, and landmarks where they are wanted."""

from functools import lru_cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sph_stab_ros.geometry.equirect import pixels_from_bearings
from sph_stab_ros.tracking.anchored.landmark_map import (
    ADJUSTED_KEYFRAMES, LandmarkMap, MAX_KEYFRAMES, MAX_LANDMARKS, MIN_DISTANCE_PX,
    RECENT_KEYFRAMES)
from sph_stab_ros.tracking.anchored.landmarks import inlier_mask, Landmarks, Observations
from sph_stab_ros.tracking.anchored.patches import MAX_LATITUDE_RAD, Patches, Pyramid
from sph_stab_ros.tracking.anchored.pose_estimation import CAUCHY
from synthetic import angle_deg, random_rotation, textured_sphere, unit

WIDTH = 320
SIGMA_RAD = 1e-3
NOTHING = Observations(np.empty(0, int), np.empty((0, 3)), np.empty((0, 2, 3)))
EVERYWHERE = np.ones((1, 2), bool)
GREY = np.zeros((8, 16), np.uint8)


@lru_cache(maxsize=4)
def sphere(seed=0):
    return textured_sphere(WIDTH, seed=seed)


def add_keyframe(landmark_map, R=Rotation.identity(), position=(0, 0, 0), observations=NOTHING):
    landmark_map.add_keyframe(
        R, np.array(position, float), np.zeros((3, 3)), GREY, None, observations)


def look_around(landmark_map, grey, usable=EVERYWHERE):
    landmark_map.add_landmarks(grey, Pyramid(grey), usable)


def started(grey=None, usable=EVERYWHERE):
    """Return a LandmarkMap of one keyframe and its landmarks."""
    landmark_map = LandmarkMap()
    add_keyframe(landmark_map)
    look_around(landmark_map, sphere() if grey is None else grey, usable)
    return landmark_map


def some_patches(count):
    """Return any Patches."""
    x = np.tile((0., 0., 1.), (count, 1))
    return Patches.cut(Pyramid(sphere()), x, np.roll(x, 1, axis=1), np.roll(x, 2, axis=1))


def add_points(landmark_map, x, rho, ids):
    """Let the last keyframe host landmarks along x (N, 3) in its camera, at known depths."""
    n = len(ids)
    new = Landmarks(ids, np.full(n, landmark_map.keyframes[-1].number), x, x, x, rho, np.ones(n),
                    np.zeros(n, int), np.zeros(n, int), np.ones(n, bool),
                    landmark_map.store.put(some_patches(n)))
    known = landmark_map.landmarks
    landmark_map.landmarks = new if known is None else Landmarks.joined((known, new))


def seen_from(landmark_map, R, position):
    """Return the exact Observations of all landmarks from a pose."""
    rows = np.arange(len(landmark_map.landmarks))
    y = R.inv().apply(landmark_map.directions(rows, position))
    first = unit(np.cross(y, (0.3, 0.5, 0.8)))
    return Observations(landmark_map.landmarks.number.copy(), y,
                        np.stack((first, np.cross(y, first)), axis=1) / SIGMA_RAD)


def travelled(rng, keyframes, points=25):
    """Return a true LandmarkMap after a journey; each keyframe hosts some points, sees all."""
    landmark_map = LandmarkMap()
    for i in range(keyframes):
        R, position = random_rotation(rng, 5 * i), 0.1 * i * np.array((1., 0.2, 0.4))
        observations = NOTHING if i == 0 else seen_from(landmark_map, R, position)
        add_keyframe(landmark_map, R, position, observations)
        add_points(landmark_map, unit(rng.normal(size=(points, 3))),
                   rng.uniform(0.3, 1, points), i * points + np.arange(points))
        landmark_map.shrink()
    return landmark_map


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
    landmark_map = started()
    landmarks = landmark_map.landmarks
    landmarks.active[:] = rng.random(len(landmarks)) < 0.5
    active = np.flatnonzero(landmarks.active)
    R = random_rotation(rng, 40)
    add_keyframe(landmark_map, R)
    look_around(landmark_map, textured_sphere(WIDTH, R))
    landmarks = landmark_map.landmarks
    new = landmarks.host == 1
    assert new.sum() > 30
    assert landmarks.active.sum() <= MAX_LANDMARKS
    assert landmarks.number[new].min() > landmarks.number[~new].max()
    there = pixels_from_bearings(R.inv().apply(landmarks.x[active]), WIDTH)
    distance = np.linalg.norm(there[:, None] - pixels(landmarks[new]), axis=2)
    # Pixels are whole.
    assert distance.min() > MIN_DISTANCE_PX - 1


def test_new_landmarks_are_as_far_as_the_others_in_the_median():
    landmark_map = started()
    landmark_map.landmarks.inverse_depth[:] = 0.4
    landmark_map.landmarks.active[::2] = False
    add_keyframe(landmark_map)
    look_around(landmark_map, sphere())
    new = landmark_map.landmarks.host == 1
    assert new.any()
    np.testing.assert_allclose(landmark_map.landmarks.inverse_depth[new], 0.4)


def test_where_enough_are_looked_for_none_are_added():
    landmark_map = started()
    known = landmark_map.landmarks
    while len(landmark_map.landmarks) < MAX_LANDMARKS:
        landmark_map.landmarks = Landmarks.joined((landmark_map.landmarks, known))
    before = len(landmark_map.landmarks)
    add_keyframe(landmark_map)
    look_around(landmark_map, sphere(seed=1))
    assert len(landmark_map.landmarks) == before


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
    landmark_map = LandmarkMap()
    add_keyframe(landmark_map)
    look_around(landmark_map, grey, usable)
    assert landmark_map.landmarks is None or len(landmark_map.landmarks) == 0


def test_the_map_stays_small_and_keeps_its_first_and_last_keyframes():
    rng = np.random.default_rng(2)
    landmark_map = LandmarkMap()
    for i in range(MAX_KEYFRAMES + 30):
        add_keyframe(landmark_map, position=rng.normal(size=3))
        add_points(landmark_map, unit(rng.normal(size=(2, 3))), np.ones(2), 2 * i + np.arange(2))
        landmark_map.shrink()
        ids = [one.number for one in landmark_map.keyframes]
        assert len(ids) == min(i + 1, MAX_KEYFRAMES)
        assert ids[0] == 0
        assert ids[-RECENT_KEYFRAMES:] == list(range(i + 1))[-RECENT_KEYFRAMES:]
        assert ids == sorted(set(ids))
    # With the keyframes go the landmarks that they host, and no others.
    np.testing.assert_array_equal(landmark_map.landmarks.host, np.repeat(ids, 2))


def test_of_many_keyframes_one_goes_that_has_another_one_near():
    landmark_map = started()
    positions = [(float(i), 0, 0) for i in range(MAX_KEYFRAMES)]
    positions[20] = (19.1, 0, 0)
    for position in positions:
        add_keyframe(landmark_map, position=position)
    landmark_map.shrink()
    ids = {one.number for one in landmark_map.keyframes}
    gone = set(range(MAX_KEYFRAMES + 1)) - ids
    assert len(gone) == 1 and gone <= {20, 21}


def test_landmarks_are_found_in_the_direction_and_at_the_depth_they_are():
    rng = np.random.default_rng(3)
    landmark_map = travelled(rng, MAX_KEYFRAMES + 4, points=3)
    rows = rng.permutation(len(landmark_map.landmarks))[:20]
    position = rng.normal(size=3)
    keyframes = {one.number: one for one in landmark_map.keyframes}
    for row, direction in zip(rows, landmark_map.directions(rows, position)):
        one = landmark_map.landmarks[row:row + 1]
        host = keyframes[one.host[0]]
        point = host.position + host.R @ one.x[0] / one.inverse_depth[0]
        np.testing.assert_allclose(direction, unit(point - position), atol=1e-9)


@pytest.mark.parametrize('count', (0, 7, 30, 1000))
def test_near_are_those_at_rest_whose_hosts_are_nearest(count):
    rng = np.random.default_rng(4)
    landmark_map = travelled(rng, 10, points=10)
    landmarks = landmark_map.landmarks
    landmarks.active[:] = rng.random(len(landmarks)) < 0.4
    position = landmark_map.keyframes[6].position + 0.01
    rows = landmark_map.near(position, count)
    inactive = np.flatnonzero(~landmarks.active)
    assert len(rows) == min(count, len(inactive))
    assert (np.diff(rows) > 0).all() and np.isin(rows, inactive).all()
    _, origins = landmark_map.hosts(inactive)
    distance = np.linalg.norm(origins - position, axis=1)
    chosen = np.isin(inactive, rows)
    assert not chosen.any() or chosen.all() or distance[chosen].max() <= distance[~chosen].min()


def test_near_none_at_rest_there_is_nothing():
    assert len(started().near(np.zeros(3), 10)) == 0


# With few keyframes, with more than are adjusted, and with gaps among them.
@pytest.mark.parametrize('count', (2, 5, ADJUSTED_KEYFRAMES + 4, MAX_KEYFRAMES + 5))
def test_disturbed_keyframes_and_landmarks_come_back(count):
    rng = np.random.default_rng(5)
    landmark_map = travelled(rng, count, points=60 if count < 10 else 8)
    keyframes, landmarks = landmark_map.keyframes, landmark_map.landmarks
    first = max(len(keyframes) - ADJUSTED_KEYFRAMES, 1)
    truth = [(one.R, one.position) for one in keyframes]
    for one in keyframes[first:]:
        one.R = random_rotation(rng, 0.5).as_matrix() @ one.R
        one.position = one.position + rng.normal(0, 0.005, 3)
    distance = np.linalg.norm(keyframes[-1].position)
    true_depths = landmarks.inverse_depth.copy()
    landmarks.inverse_depth *= np.exp(rng.normal(0, 0.05, len(landmarks)))
    landmark_map.adjust()
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
    assert len(landmark_map.landmarks) == len(true_depths)
    hosted = landmark_map.landmarks.host < keyframes[-1].number
    error = landmark_map.landmarks.inverse_depth * ratio - true_depths
    assert np.median(np.abs(error[hosted])) < 2e-3


def test_landmarks_that_go_their_own_way_are_given_up():
    rng = np.random.default_rng(6)
    landmark_map = travelled(rng, 6, points=40)
    truth = [one.R for one in landmark_map.keyframes]
    wrong = np.arange(5, 60, 7)
    for one in landmark_map.keyframes[1:]:
        moving = np.isin(one.observations.number, wrong)
        one.observations.y[moving] = unit(
            one.observations.y[moving] + rng.normal(0, 0.1, (moving.sum(), 3)))
    before = landmark_map.landmarks.number
    landmark_map.adjust()
    np.testing.assert_array_equal(landmark_map.landmarks.number, np.setdiff1d(before, wrong))
    # From now on they have no say, though they were seen.
    landmark_map.adjust()
    for one, true in zip(landmark_map.keyframes, truth):
        assert angle_deg(Rotation.from_matrix(one.R), Rotation.from_matrix(true)) < 1e-5


def test_trust_falls_with_size_and_rises_with_scale():
    sizes = np.linspace(0, 10, 50)
    for scale in (0.5, 1., 2.):
        assert inlier_mask(sizes, scale)[0] and not inlier_mask(sizes, scale)[-1]
        assert (np.diff(inlier_mask(sizes, scale).astype(int)) <= 0).all()
        quarter = CAUCHY * scale * np.sqrt(3)
        np.testing.assert_array_equal(
            inlier_mask(quarter * np.array((0.99, 1.01)), scale), (True, False))
