# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The anchored tracker in a room of known walls, with what robots meet there."""

import cv2
import numpy as np
from painted_room import errors_deg, flight, PERIOD_NS, room, tracked, WIDTH
import pytest
from scipy.spatial.transform import Rotation

from sph_stab_ros.tracking.anchored.body_mask import BodyMaskOptions, VisibleWorld
from sph_stab_ros.tracking.anchored.landmark_map import LandmarkMap
from sph_stab_ros.tracking.anchored.map_initialization import InitializationOptions
from sph_stab_ros.tracking.anchored.map_options import MapOptions
from sph_stab_ros.tracking.anchored.options import AnchoredOptions
from sph_stab_ros.tracking.anchored.tracker import AnchoredTracker
from sph_stab_ros.tracking.base import TrackingStatus
from synthetic import angle_deg, random_rotation

TRACKED = {TrackingStatus.OK, TrackingStatus.UNCERTAIN}


def black():
    return np.zeros((WIDTH // 2, WIDTH), np.uint8)


def test_a_flight_through_a_room_is_followed():
    R, p = flight(25)
    results = tracked(map(room, R, p))
    assert {result.status for result in results} == {TrackingStatus.OK}
    assert errors_deg(results, R).max() < 0.1


def test_the_same_frames_give_the_same_orientations():
    images = list(map(room, *flight(6)))
    first, second = tracked(images), tracked(images)
    for a, b in zip(first, second):
        np.testing.assert_array_equal(a.R_world_camera.as_quat(), b.R_world_camera.as_quat())


def test_however_the_camera_is_mounted_its_turns_are_the_same():
    R, p = flight(12)
    mount = random_rotation(np.random.default_rng(3), 50)
    plain = tracked(map(room, R, p))
    turned = tracked(room(R_i * mount, p_i) for R_i, p_i in zip(R, p))
    for a, b in zip(plain, turned):
        assert angle_deg(mount * b.R_world_camera * mount.inv(), a.R_world_camera) < 0.12


def test_who_returns_finds_the_orientation_he_left_with():
    R, p = flight(40, step=(0.035, 0.005, 0.02))
    there_and_back = np.r_[:40, 39:-1:-1]
    results = tracked(room(R[i], p[i]) for i in there_and_back)
    assert angle_deg(results[-1].R_world_camera, Rotation.identity()) < 0.05


def test_a_camera_that_stands_still_stands_still():
    rng = np.random.default_rng(1)
    image = room(Rotation.identity()).astype(float)
    results = tracked(np.uint8(np.clip(image + rng.normal(0, 3, image.shape), 0, 255))
                      for _ in range(8))
    assert errors_deg(results, Rotation.identity(8)).max() < 0.02


@pytest.mark.parametrize('step_deg', (5, 8))
def test_a_shake_is_followed(step_deg):
    rng = np.random.default_rng(2)
    R = [Rotation.identity()]
    for _ in range(8):
        R.append(R[0] * random_rotation(rng, step_deg / 2))
    results = tracked(map(room, R))
    assert errors_deg(results, R).max() < 0.2


def test_after_a_gap_and_a_large_turn_the_place_is_recognised():
    R, p = flight(6)
    tracker = AnchoredTracker()
    tracked(map(room, R, p), tracker)
    turned = R[-1] * Rotation.from_euler('YXZ', (115, 10, -8), degrees=True)
    results = [tracker.track(room(turned, p[-1] + 0.02), (40 + i) * PERIOD_NS) for i in range(5)]
    assert results[-1].status is TrackingStatus.OK
    assert angle_deg(results[-1].R_world_camera, turned) < 0.5


def test_black_frames_are_predicted_then_lost_then_recovered():
    R, p = flight(14)
    images = list(map(room, R, p))
    images[5:10] = 5 * [black()]
    results = tracked(images, max_prediction_s=0.1)
    assert [r.status.value for r in results] == (
        5 * ['ok'] + 3 * ['predicted'] + 2 * ['lost'] + 4 * ['ok'])
    assert errors_deg(results, R)[:8].max() < 0.2
    assert errors_deg(results, R)[10:].max() < 0.2


def test_a_black_start_is_waited_through():
    R, p = flight(4)
    results = tracked([black(), *map(room, R, p)])
    assert results[0].status is TrackingStatus.LOST
    assert errors_deg(results[1:], R).max() < 0.1


def test_corners_of_noise_are_no_landmarks():
    """Where only a pole shows anything: there is texture, there are corners, none has contrast."""
    rng = np.random.default_rng(0)
    image = np.uint8(rng.normal(100, 1, (WIDTH // 2, WIDTH)))
    image[:14] = rng.integers(0, 255, (7, 40)).repeat(2, 0).repeat(8, 1)
    tracker = AnchoredTracker()
    statuses = [result.status for result in tracked([image] * 3, tracker)]
    assert statuses == [TrackingStatus.OK, TrackingStatus.LOST, TrackingStatus.LOST]
    assert tracker.landmarks_kept == 0


def test_an_unknown_place_is_the_start_of_a_new_world():
    R, p = flight(3)
    tracker = AnchoredTracker(max_prediction_s=0.1)
    tracked(map(room, R, p), tracker)
    rng = np.random.default_rng(5)
    elsewhere = [np.uint8(rng.integers(0, 255, (10, 20)).repeat(16, 0).repeat(16, 1))
                 for _ in range(10)]
    statuses = [tracker.track(image, (3 + i) * PERIOD_NS).status
                for i, image in enumerate(elsewhere)]
    assert TrackingStatus.LOST in statuses


@pytest.mark.parametrize('seed', (
    0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (1, 2, 3))))
def test_after_a_long_gap_the_old_world_is_found_again(seed):
    """From where landmarks are not found: far away, turned by any angle, among the same walls."""
    R, p = flight(40)
    tracker = AnchoredTracker()
    tracked((room(*one, width=2 * WIDTH) for one in zip(R, p)), tracker)
    rng = np.random.default_rng(seed)
    R_far = random_rotation(rng, 150) * R
    p_far = p - p[0] + rng.uniform(-0.7, 0.7, size=3)
    results = [tracker.track(room(*one, width=2 * WIDTH), (100 + i) * PERIOD_NS)
               for i, one in enumerate(zip(R_far, p_far))]
    assert {one.status for one in results[1:]} <= TRACKED
    errors = [angle_deg(one.R_world_camera, R) for one, R in zip(results, R_far)]
    assert errors[-1] < 2
    # At once, by features, or later; that it had been lost is no secret.
    for result, error_deg in zip(results, errors):
        assert result.status is not TrackingStatus.OK or error_deg < 1
        assert result.status is TrackingStatus.LOST or (
            error_deg < 4 * np.rad2deg(np.sqrt(np.linalg.eigvalsh(result.covariance)[-1])))
    assert np.linalg.eigvalsh(results[-1].covariance)[-1] < np.deg2rad(3) ** 2


def test_large_steps_are_followed_by_features():
    """By 25 degrees and a tenth of the room from picture to picture, nothing of it expected."""
    R, p = flight(8, step_deg=(2., 24., -4.), step=(0.2, 0.03, 0.1))
    results = tracked(room(*one, width=2 * WIDTH) for one in zip(R, p - p[3]))
    assert {one.status for one in results} == {TrackingStatus.OK}
    assert errors_deg(results, R).max() < 0.5


def test_features_do_for_the_first_step_too():
    """Where landmarks are not found from one picture to the next before parallax has told."""
    never = AnchoredOptions(initialization=InitializationOptions(min_agreement=2.))
    R, p = flight(4, step_deg=(2., 24., -4.), step=(0.2, 0.03, 0.1))
    results = tracked((room(*one, width=2 * WIDTH) for one in zip(R, p)), options=never)
    assert {one.status for one in results} == {TrackingStatus.OK}
    assert errors_deg(results, R).max() < 0.5


def test_another_world_is_not_taken_for_the_old_one():
    R, p = flight(20)
    tracker = AnchoredTracker()
    tracked(map(room, R, p), tracker)
    upside_down = [room(*one)[::-1] for one in zip(R, p)]
    results = [tracker.track(image, (100 + i) * PERIOD_NS) for i, image in enumerate(upside_down)]
    assert results[0].status is TrackingStatus.LOST
    steps_deg = [angle_deg(a.R_world_camera, b.R_world_camera)
                 for a, b in zip(results[1:], results[2:])]
    assert max(steps_deg) < 2


def test_lost_twice_it_is_the_first_world_that_is_looked_for():
    R, p = flight(20)
    images = [room(*one) for one in zip(R, p)]
    tracker = AnchoredTracker()
    tracked(images, tracker)
    for i, image in enumerate(images[:6]):
        tracker.track(image[::-1].copy(), (100 + i) * PERIOD_NS)
    R_back = Rotation.from_euler('YXZ', (100, 20, 5), degrees=True) * R
    results = [tracker.track(room(*one), (200 + i) * PERIOD_NS)
               for i, one in enumerate(zip(R_back, p))]
    assert results[0].status is TrackingStatus.LOST
    assert angle_deg(results[-1].R_world_camera, R_back[-1]) < 2


def with_body(image):
    """Return the picture with a robot's body around the nadir, and three arms."""
    image = image.copy()
    rng = np.random.default_rng(9)
    body = rng.integers(0, 255, (16, 40), np.uint8).repeat(8, 0).repeat(8, 1)
    image[122:] = body[:38]
    for column in (40, 150, 260):
        image[95:125, column:column + 8] = 20
    return image


def test_the_body_of_the_robot_is_found_and_left_out():
    R, p = flight(30, step=(0.006, 0.002, 0.004))
    tracker = AnchoredTracker()
    results = tracked((with_body(room(*pose)) for pose in zip(R, p)), tracker)
    assert errors_deg(results, R).max() < 0.25
    assert tracker.body_mask[65:78].mean() > 0.5
    assert tracker.body_mask[10:40].mean() < 0.05


def test_nothing_is_looked_for_where_no_lens_shows_anything():
    R, p = flight(10)
    shown = np.zeros((WIDTH // 2, WIDTH), bool)
    shown[:, WIDTH // 4:3 * WIDTH // 4] = True
    black_beside = [np.where(shown, room(*pose), 0).astype(np.uint8) for pose in zip(R, p)]
    results = tracked(black_beside)
    assert all(result.status is TrackingStatus.OK for result in results)
    assert errors_deg(results, R).max() < 0.1
    world = VisibleWorld(None, BodyMaskOptions())
    world.update(black_beside[0], None)
    seen = cv2.resize(np.uint8(world.pixels()), (WIDTH, WIDTH // 2)) > 0
    assert not (seen & ~shown).any()
    assert seen.mean() > 0.8 * shown.mean()


def test_masked_pixels_do_not_matter():
    R, p = flight(10)
    used = np.ones((WIDTH // 2, WIDTH), bool)
    used[90:] = False
    results = tracked((with_body(room(*pose)) for pose in zip(R, p)), used=used)
    assert errors_deg(results, R).max() < 0.1


def test_somebody_who_walks_past_does_not_win():
    R, p = flight(20)
    images = list(map(room, R, p))
    rng = np.random.default_rng(4)
    person = rng.integers(0, 255, (10, 5), np.uint8).repeat(8, 0).repeat(8, 1)
    for i, image in enumerate(images):
        image[40:120, 60 + 4 * i:100 + 4 * i] = person
    assert errors_deg(tracked(images), R).max() < 0.15


@pytest.mark.parametrize('contrast, px_per_frame', ((1, 1), (0.3, 1.5), (0.3, -3)))
def test_who_walks_along_from_the_first_frame_on_does_not_win(contrast, px_per_frame):
    """Nearer than all else, with more corners than the room has, and agreed among themselves."""
    R, p = flight(14, step_deg=(0.1, 0.5, 0.))
    rng = np.random.default_rng(4)
    person = rng.integers(0, 255, (14, 14), np.uint8).repeat(8, 0).repeat(8, 1)
    images = []
    for i, image in enumerate(map(room, R, p)):
        image = np.uint8(128 + contrast * (image - 128.))
        place = np.float32(((1, 0, 80 + px_per_frame * i), (0, 1, 25)))
        cv2.warpAffine(person, place, (WIDTH, WIDTH // 2), image,
                       borderMode=cv2.BORDER_TRANSPARENT)
        images.append(image)
    errors = errors_deg(tracked(images), R)
    assert errors.max() < 0.3
    # Once parallax tells.
    assert errors[10:].max() < 0.1


def test_without_a_turn_nothing_is_said_to_stand_still():
    visible = VisibleWorld(None, BodyMaskOptions())
    for _ in range(5):
        visible.update(room(Rotation.identity()), Rotation.identity())
    assert not visible.body.mask.any()


def test_a_keyframe_that_fails_is_given_up(monkeypatch):
    tracker = AnchoredTracker()
    tried = []

    def fail(landmark_map):
        tried.append(landmark_map)
        raise np.linalg.LinAlgError
    monkeypatch.setattr(LandmarkMap, 'adjust', fail)
    for i in range(30):
        try:
            tracker.track(room(Rotation.identity(), (0.05 * i, 0, 0)), i * PERIOD_NS)
        except np.linalg.LinAlgError:
            # The same frame once more, as a node does with the next one.
            assert tracker.track(room(Rotation.identity(), (0.05 * i, 0, 0)),
                                 i * PERIOD_NS).status in TRACKED
    assert tried


def test_memory_does_not_grow():
    options = MapOptions(max_keyframes=12)
    tracker = AnchoredTracker(options=AnchoredOptions(landmark_map=options))
    kept = []
    for i in range(60):
        to_and_fro = 0.07 * (30 - abs(i - 30)) - 1
        image = room(Rotation.identity(), (to_and_fro, 0.1, 0.3 * np.sin(i / 5)), 256)
        assert tracker.track(image, i * PERIOD_NS).status is TrackingStatus.OK
        kept.append((tracker.keyframes_kept, tracker.landmarks_kept))
    keyframes, landmarks = np.transpose(kept)
    assert keyframes.max() == keyframes[-1] == 12
    assert landmarks.max() < 12 * options.max_landmarks
