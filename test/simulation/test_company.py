# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Simulated flights in company: where the walkers are, what of them is seen, and the truth."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sph_stab_ros.geometry.conventions import R_BODY_CAMERA
from sph_stab_ros.geometry.equirect import bearing_grid
from sph_stab_ros.simulation import company
from sph_stab_ros.simulation.renderer import render

from test_simulation import difference, read, simulate

every_kind = pytest.mark.parametrize('kind', [company.pioneer, company.handheld])
every_seed = pytest.mark.parametrize('seed', [*range(12), 97, 1000])
WIDTH = 192


def feet(flight, seed):
    """Return times (T,), and paths (N, T, 2) on the floor as seen from the camera's foot."""
    t_s = np.arange(0, flight.duration_s, 0.01)
    paths = np.array([walk(t_s)[:, :2] for walk in company.walks(flight, seed)])
    return t_s, paths, flight.p_mocap_camera(t_s)[:, :2]


@every_seed
@every_kind
def test_two_to_four_walk_near_the_camera_from_the_first_frame_on(kind, seed):
    _, paths, camera = feet(kind(seed), seed)
    assert 2 <= len(paths) <= 4
    distance = np.linalg.norm(paths - camera, axis=2)
    assert distance.min() >= company.NEAREST_M
    assert np.median(distance, axis=1).max() < company.FARTHEST_M
    assert distance[:, 0].min() < 1.2
    for a in range(len(paths)):
        for b in range(a):
            assert np.linalg.norm(paths[a] - paths[b], axis=1).min() >= company.APART_M


@every_seed
@every_kind
def test_one_moves_along_and_one_stands_still_and_starts_again(kind, seed):
    t_s, paths, camera = feet(kind(seed), seed)
    speed = np.linalg.norm(np.diff(paths, axis=1), axis=2) / np.diff(t_s)
    assert speed.max() <= company.FASTEST_M_S
    # What moves along gets about as far as the camera does, step by step.
    along, camera_way = paths[0] - paths[0, 0], camera - camera[0]
    assert (np.linalg.norm(along - camera_way, axis=1) < 2.1).all()
    assert speed[0].min() > 0.01
    stands = speed[1] < 0.005
    assert stands.sum() * 0.01 > 0.4
    assert speed[1][np.flatnonzero(stands)[-1]:].max() > 0.2


@every_seed
@every_kind
def test_two_cross_before_the_camera(kind, seed):
    _, paths, camera = feet(kind(seed), seed)
    first, second = (np.arctan2(*(path - camera).T[::-1]) for path in paths[:2])
    angle = np.angle(np.exp(1j * (first - second)))
    in_front = np.abs(angle) < 1
    sides = np.sign(angle[in_front])
    assert {-1, 1} <= set(sides)


@every_kind
def test_walkers_stay_off_furniture_and_within_the_walls(kind):
    for seed in range(4):
        flight = kind(seed)
        t_s, paths, _ = feet(flight, seed)
        room = company.room(flight, seed, texels_per_m=10)
        furniture = [box for box in room.boxes
                     if (box.centre_m(0.0) == box.centre_m(flight.duration_s)).all()]
        assert len(furniture) >= 12
        assert (np.abs(paths) < np.array(flight.room_size_m[:2]) / 2 - 0.3).all()
        for box in furniture:
            gap = np.abs(paths - box.centre_m(0.0)[:2]) - box.size_m[:2] / 2
            assert gap.max(axis=2).min() > 0.2


def test_bare_walls_are_in_half_of_even_and_of_odd_seeds():
    for parity in range(2):
        assert sum(company.bare(seed) for seed in range(parity, 40, 2)) == 10


@every_kind
def test_equal_seeds_give_equal_pictures(kind):
    def picture(seed):
        flight = kind(seed)
        room = company.room(flight, seed, texels_per_m=20)
        return render(room, flight, 1.0, WIDTH, company.render_options(seed))

    np.testing.assert_array_equal(picture(3), picture(3))
    assert difference(picture(3), picture(4)) > 5


def seen_walkers(room, flight, t_s):
    """Return where (h, w) the walkers show in the picture, from boxes and truth alone."""
    rays = flight.R_mocap_camera(t_s).apply(bearing_grid(WIDTH).reshape(-1, 3))
    seen = np.zeros(len(rays), bool)
    for box in room.boxes:
        if (box.centre_m(0.0) == box.centre_m(flight.duration_s)).all():
            continue
        to_box = box.centre_m(t_s) - flight.p_mocap_camera(t_s)
        with np.errstate(divide='ignore'):
            ends = (to_box - box.size_m / 2) / rays, (to_box + box.size_m / 2) / rays
        near, far = np.minimum(*ends).max(axis=1), np.maximum(*ends).min(axis=1)
        seen |= (near > 0) & (near < far)
    return seen.reshape(WIDTH // 2, WIDTH)


@every_kind
def test_walkers_are_seen_where_truth_says_they_are(kind):
    flight = kind(5)
    options = replace(company.render_options(5), exposure_s=0.0, jitter=False, noise_std=0.0,
                      stitch_error_deg=0.0, robot=False)
    room = company.room(flight, 5, texels_per_m=30)
    empty = company.room(flight, 5, texels_per_m=30)
    empty.boxes = [box for box in empty.boxes
                   if (box.centre_m(0.0) == box.centre_m(flight.duration_s)).all()]
    for t_s in (0.0, 3.1, 6.4):
        with_them, without = (render(one, flight, t_s, WIDTH, options) for one in (room, empty))
        changed = (np.abs(with_them.astype(int) - without) > 12).any(axis=2)
        expected = seen_walkers(room, flight, t_s)
        assert expected.mean() > 0.02
        # Half a pixel along the outlines, and patches of the background's own colour.
        assert (changed & ~expected).sum() < 0.12 * expected.sum()
        assert (expected & ~changed).sum() < 0.12 * expected.sum()


@every_kind
def test_jittered_blur_is_supersampling_without_bias(kind):
    flight = kind(2)
    room = company.room(flight, 2, texels_per_m=30)
    jittered = replace(company.render_options(2), exposure_s=1e-6, noise_std=0.0)
    fine = replace(jittered, exposure_s=0.0, jitter=False, supersampling=4)
    a, b = (render(room, flight, 2.0, WIDTH, options).astype(float)
            for options in (jittered, fine))
    down, right = ((np.roll(b, -1, axis) - np.roll(b, 1, axis)) / 2 for axis in (0, 1))
    away = slice(WIDTH // 8, 3 * WIDTH // 8)  # from the poles, where a column is no length
    for gradient in (down, right):
        shift_px = ((b - a) * gradient)[away].sum() / (gradient[away] ** 2).sum()
        assert abs(shift_px) < 0.03


def test_part_of_a_flight_is_as_in_the_whole(tmp_path):
    pictures = []
    for first, frames in ((20, 1), (18, 4)):
        assert simulate('company_handheld', tmp_path / 'bag', '--seed', 2, '--first-frame', first,
                        '--frames-limit', frames, '--width', 64, '--force') == 0
        pictures.append(read(tmp_path / 'bag')[0])
    (stamp_ns, picture), = pictures[0].items()
    assert stamp_ns == company.handheld(2).stamps_ns[20]
    np.testing.assert_array_equal(picture, pictures[1][stamp_ns])


def test_command_writes_truth_that_is_the_flight(tmp_path):
    assert simulate('company_pioneer', tmp_path / 'bag', '--seed', 6, '--frames-limit', 4,
                    '--width', 64) == 0
    images, poses, _ = read(tmp_path / 'bag')
    flight = company.pioneer(6)
    assert list(images) == flight.stamps_ns[:4].tolist()
    stamps_ns = np.array(list(poses))
    R_mocap_body = Rotation.from_quat([
        (q.x, q.y, q.z, q.w) for q in (pose.orientation for pose in poses.values())])
    t_s = (stamps_ns - flight.stamps_ns[0]) * 1e-9
    error = (R_mocap_body * R_BODY_CAMERA).inv() * flight.R_mocap_camera(t_s)
    assert error.magnitude().max() < 1e-9
