# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The map of the anchored tracker: few keyframes, and landmarks where they are wanted."""

from dataclasses import fields, FrozenInstanceError, replace
from functools import lru_cache, partial

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sph_stab_ros.geometry.equirect import pixels_from_bearings
from sph_stab_ros.tracking.anchored.landmark_map import LandmarkMap
from sph_stab_ros.tracking.anchored.landmarks import Landmarks, Observations
from sph_stab_ros.tracking.anchored.map_options import MapOptions
from sph_stab_ros.tracking.anchored.patches import Pyramid
from sph_stab_ros.tracking.anchored.pose_estimation import Loss
from synthetic import angle_deg, random_rotation, textured_sphere, unit

WIDTH = 320
OPTIONS = MapOptions()
SIGMA_RAD = 1e-3
NOTHING = Observations.none()
EVERYWHERE = np.ones((1, 2), bool)
GREY = np.zeros((8, 16), np.uint8)


@lru_cache(maxsize=4)
def sphere(seed=0):
    return textured_sphere(WIDTH, seed=seed)


def add_keyframe(landmark_map, R=Rotation.identity(), position=(0, 0, 0), observations=NOTHING):
    landmark_map.add_keyframe(
        R, np.array(position, float), np.zeros((3, 3)), GREY, None, observations)


def look_around(landmark_map, grey, usable=EVERYWHERE):
    landmark_map.add_landmarks(grey, Pyramid(grey, OPTIONS.patches), usable)


def started(grey=None, usable=EVERYWHERE):
    """Return a LandmarkMap of one keyframe and its landmarks."""
    landmark_map = LandmarkMap(OPTIONS)
    add_keyframe(landmark_map)
    look_around(landmark_map, sphere() if grey is None else grey, usable)
    return landmark_map


def add_points(landmark_map, x, rho, ids):
    """Let the last keyframe host landmarks along x (N, 3) in its camera, at known depths."""
    n = len(ids)
    landmark_map.add(replace(
        Landmarks.new(ids[0], landmark_map.keyframes[-1].number, (x, x, x), 1., 1.,
                      np.zeros(n, int)), inverse_depth=rho))


def let_rest(landmark_map, resting):
    """Deactivate some landmarks, (N,) bool, the way that it happens: they are not seen."""
    seen, nothing = np.flatnonzero(~resting), np.empty(0, int)
    for rows in (nothing,) * OPTIONS.landmarks.max_missed:
        landmark_map.judge(rows, np.empty(0, bool), np.empty(0))
    landmark_map.wake(seen)


def let_be(landmark_map, inverse_depths):
    """Let all landmarks have agreed at such inverse depths."""
    rows = np.arange(len(landmark_map.landmarks))
    landmark_map.judge(rows, np.ones(len(rows), bool), np.broadcast_to(inverse_depths, len(rows)))


def seen_from(landmark_map, R, position):
    """Return the exact Observations of all landmarks from a pose."""
    rows = np.arange(len(landmark_map.landmarks))
    y = R.inv().apply(landmark_map.directions(rows, position))
    first = unit(np.cross(y, (0.3, 0.5, 0.8)))
    return Observations(landmark_map.landmarks.number.copy(), y,
                        np.stack((first, np.cross(y, first)), axis=1) / SIGMA_RAD)


def travelled(rng, keyframes, points=25):
    """Return a true LandmarkMap after a journey; each keyframe hosts some points, sees all."""
    landmark_map = LandmarkMap(OPTIONS)
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
    assert 100 < len(landmarks) <= OPTIONS.max_landmarks
    assert (np.diff(landmarks.number) > 0).all()
    assert (landmarks.host == 0).all() and landmarks.active.all()
    axes = np.stack((landmarks.x, landmarks.east, landmarks.south), axis=1)
    np.testing.assert_allclose(axes @ np.swapaxes(axes, 1, 2) - np.eye(3), 0, atol=1e-9)
    assert (landmarks.south[:, 1] > 0).all()
    np.testing.assert_allclose(landmarks.inverse_depth, 1)


def test_landmarks_keep_their_distance_and_away_from_the_poles():
    landmarks = started().landmarks
    assert distances_px(pixels(landmarks)).min() > OPTIONS.corners.min_distance_px - 1e-6
    assert np.abs(np.arcsin(landmarks.x[:, 1])).max() < OPTIONS.patches.max_latitude_rad


def test_new_landmarks_keep_away_from_those_that_are_looked_for():
    rng = np.random.default_rng(1)
    landmark_map = started()
    let_rest(landmark_map, rng.random(len(landmark_map.landmarks)) < 0.5)
    active = np.flatnonzero(landmark_map.landmarks.active)
    R = random_rotation(rng, 40)
    add_keyframe(landmark_map, R)
    look_around(landmark_map, textured_sphere(WIDTH, R))
    landmarks = landmark_map.landmarks
    new = landmarks.host == 1
    assert new.sum() > 30
    assert landmarks.active.sum() <= OPTIONS.max_landmarks
    assert landmarks.number[new].min() > landmarks.number[~new].max()
    there = pixels_from_bearings(R.inv().apply(landmarks.x[active]), WIDTH)
    distance = np.linalg.norm(there[:, None] - pixels(landmarks[new]), axis=2)
    # Pixels are whole.
    assert distance.min() > OPTIONS.corners.min_distance_px - 1


def test_new_landmarks_are_as_far_as_the_others_in_the_median():
    landmark_map = started()
    let_be(landmark_map, 0.4)
    let_rest(landmark_map, np.arange(len(landmark_map.landmarks)) % 2 == 0)
    add_keyframe(landmark_map)
    look_around(landmark_map, sphere())
    new = landmark_map.landmarks.host == 1
    assert new.any()
    np.testing.assert_allclose(landmark_map.landmarks.inverse_depth[new], 0.4)


def test_where_enough_are_looked_for_none_are_added():
    landmark_map = started()
    known = landmark_map.landmarks
    while len(landmark_map.landmarks) < OPTIONS.max_landmarks:
        landmark_map.add(known)
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
    landmark_map = LandmarkMap(OPTIONS)
    add_keyframe(landmark_map)
    look_around(landmark_map, grey, usable)
    assert len(landmark_map.landmarks) == 0


def test_the_map_stays_small_and_keeps_its_first_and_last_keyframes():
    rng = np.random.default_rng(2)
    landmark_map = LandmarkMap(OPTIONS)
    for i in range(OPTIONS.max_keyframes + 30):
        add_keyframe(landmark_map, position=rng.normal(size=3))
        add_points(landmark_map, unit(rng.normal(size=(2, 3))), np.ones(2), 2 * i + np.arange(2))
        landmark_map.shrink()
        ids = [one.number for one in landmark_map.keyframes]
        assert len(ids) == min(i + 1, OPTIONS.max_keyframes)
        assert ids[0] == 0
        assert ids[-OPTIONS.recent_keyframes:] == list(range(i + 1))[-OPTIONS.recent_keyframes:]
        assert ids == sorted(set(ids))
    # With the keyframes go the landmarks that they host, and no others.
    np.testing.assert_array_equal(landmark_map.landmarks.host, np.repeat(ids, 2))


def test_of_many_keyframes_one_goes_that_has_another_one_near():
    landmark_map = started()
    positions = [(float(i), 0, 0) for i in range(OPTIONS.max_keyframes)]
    positions[20] = (19.1, 0, 0)
    for position in positions:
        add_keyframe(landmark_map, position=position)
    landmark_map.shrink()
    ids = {one.number for one in landmark_map.keyframes}
    gone = set(range(OPTIONS.max_keyframes + 1)) - ids
    assert len(gone) == 1 and gone <= {20, 21}


def test_landmarks_are_found_in_the_direction_and_at_the_depth_they_are():
    rng = np.random.default_rng(3)
    landmark_map = travelled(rng, OPTIONS.max_keyframes + 4, points=3)
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
    let_rest(landmark_map, rng.random(len(landmark_map.landmarks)) >= 0.4)
    position = landmark_map.keyframes[6].position + 0.01
    rows = landmark_map.near(position, count)
    inactive = np.flatnonzero(~landmark_map.landmarks.active)
    assert len(rows) == min(count, len(inactive))
    assert (np.diff(rows) > 0).all() and np.isin(rows, inactive).all()
    _, _, origins = landmark_map.in_world(inactive)
    distance = np.linalg.norm(origins - position, axis=1)
    chosen = np.isin(inactive, rows)
    assert not chosen.any() or chosen.all() or distance[chosen].max() <= distance[~chosen].min()


def test_near_none_at_rest_there_is_nothing():
    assert len(started().near(np.zeros(3), 10)) == 0


# With few keyframes, with more than are adjusted, and with gaps among them.
@pytest.mark.parametrize('count', (
    2, 5, OPTIONS.adjusted_keyframes + 4, OPTIONS.max_keyframes + 5))
def test_disturbed_keyframes_and_landmarks_come_back(count):
    rng = np.random.default_rng(5)
    landmark_map = travelled(rng, count, points=60 if count < 10 else 8)
    keyframes = landmark_map.keyframes
    first = max(len(keyframes) - OPTIONS.adjusted_keyframes, 1)
    truth = [(one.R, one.position) for one in keyframes]
    for one in keyframes[first:]:
        one.R = random_rotation(rng, 0.5).as_matrix() @ one.R
        one.position = one.position + rng.normal(0, 0.005, 3)
    distance = np.linalg.norm(keyframes[-1].position)
    true_depths = landmark_map.landmarks.inverse_depth
    let_be(landmark_map, true_depths * np.exp(rng.normal(0, 0.05, len(true_depths))))
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


def test_nobody_but_the_map_writes_what_becomes_of_landmarks():
    landmark_map = started()
    landmarks = landmark_map.landmarks
    for one in fields(landmarks):
        with pytest.raises(ValueError):
            getattr(landmarks, one.name)[:1] = 0
        with pytest.raises(FrozenInstanceError):
            setattr(landmarks, one.name, 0)
    with pytest.raises(AttributeError):
        landmark_map.landmarks = landmarks


def test_a_landmark_has_a_say_once_it_has_agreed_for_long_and_until_it_disagrees():
    landmark_map = started()
    one, depths = np.array((3,)), np.array((0.5,))
    judge = partial(landmark_map.judge, one, inverse_depths=depths)
    for _ in range(OPTIONS.landmarks.mature_frames):
        assert not landmark_map.is_mature(one)
        judge(np.array((True,)))
    assert landmark_map.is_mature(one)
    assert landmark_map.landmarks.inverse_depth[one] == depths
    judge(np.array((False,)))
    assert not landmark_map.is_mature(one)
    for _ in range(5):
        judge(np.array((False,)))
    assert not landmark_map.landmarks.active[one]


@pytest.mark.parametrize('for_good', (True, False))
def test_what_is_not_seen_for_long_rests_until_it_is_woken(for_good):
    landmark_map = started()
    seen = np.arange(0, len(landmark_map.landmarks), 3)
    resting = np.setdiff1d(np.arange(len(landmark_map.landmarks)), seen)
    for _ in range(OPTIONS.landmarks.max_missed):
        assert landmark_map.landmarks.active.all()
        landmark_map.judge(seen, np.ones(len(seen), bool), np.ones(len(seen)), for_good)
    np.testing.assert_array_equal(np.flatnonzero(~landmark_map.landmarks.active), resting)
    landmark_map.wake(resting[:5])
    np.testing.assert_array_equal(np.flatnonzero(~landmark_map.landmarks.active), resting[5:])


def test_by_a_pose_that_may_be_wrong_nobody_is_judged_for_good():
    landmark_map = started()
    rows = np.arange(len(landmark_map.landmarks))
    agreeing = rows % 2 == 0
    for _ in range(20):
        landmark_map.judge(rows, agreeing, np.ones(len(rows)), for_good=False)
        np.testing.assert_array_equal(landmark_map.is_mature(rows), agreeing)
        assert landmark_map.landmarks.active.all()
        agreeing = ~agreeing


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
    loss, sizes = Loss(), np.linspace(0, 10, 50)
    for scale in (0.5, 1., 2.):
        assert loss.inliers(sizes, scale)[0] and not loss.inliers(sizes, scale)[-1]
        assert (np.diff(loss.inliers(sizes, scale).astype(int)) <= 0).all()
        quarter = loss.width * scale * np.sqrt(3)
        np.testing.assert_array_equal(
            loss.inliers(quarter * np.array((0.99, 1.01)), scale), (True, False))
