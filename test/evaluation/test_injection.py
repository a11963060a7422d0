# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Known rotations injected into footage, and what ``evaluate --inject`` makes of them."""

import json

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sph_stab_ros.evaluate import main
from sph_stab_ros.evaluation.injection import (
    injected_rotations, ShakenStabilizer, turned, turned_world)
from sph_stab_ros.geometry.masks import load_mask
from sph_stab_ros.images.frame import Frame
from sph_stab_ros.stabilization.stabilized_frame import StabilizedFrame
from sph_stab_ros.tracking import TrackingStatus

from synthetic import textured_sphere


def angles_deg(rotations):
    """Return yaw (left), pitch (up), roll (clockwise), (N, 3)."""
    return rotations.as_euler('YXZ', degrees=True) * (-1, 1, 1)


@pytest.mark.parametrize('frames', [30, 300])
@pytest.mark.parametrize('seed', range(3))
def test_injection_starts_at_zero_and_peaks_as_stated(seed, frames):
    angles = angles_deg(injected_rotations(seed, frames))
    assert angles[0] == pytest.approx((0, 0, 0), abs=1e-9)
    assert np.abs(angles).max(axis=0) == pytest.approx((25, 12, 15))


def test_injection_is_smooth():
    """Noise of deviation 1 smoothed by σ frames differs by 1 / (√2 σ) from frame to frame."""
    angles = angles_deg(injected_rotations(0, 5000))
    ratio = np.diff(angles, axis=0).std(axis=0) / angles.std(axis=0)
    assert ratio == pytest.approx(1 / (np.sqrt(2) * np.array((12, 8, 8))), rel=0.1)


def test_injection_is_the_same_for_the_same_seed_only():
    first, again, other = (injected_rotations(seed, 50).as_quat() for seed in (1, 1, 2))
    assert np.array_equal(first, again)
    assert not np.allclose(first, other)


@pytest.mark.parametrize('rotvec', [(0, 0, 0), (0.3, 0, 0), (0.1, 3, -0.2)])
def test_turned_shows_what_the_turned_camera_sees(rotvec):
    R_world_camera = Rotation.from_rotvec(rotvec)
    world, seen = textured_sphere(256), textured_sphere(256, R_world_camera)
    for image, expected in ((world, seen), (np.dstack(3 * [world]), np.dstack(3 * [seen]))):
        difference = np.abs(turned(image, R_world_camera).astype(int) - expected)
        assert difference.mean() < 0.6
        assert difference.max() < 12


@pytest.mark.parametrize('seed', range(3))
def test_the_body_stays_while_the_world_is_turned(seed):
    world = load_mask('lat:-90,-20', 256)
    R_camera_shaken = Rotation.from_rotvec(np.random.default_rng(seed).normal(0, 0.2, 3))
    image = np.where(world, textured_sphere(256) // 2, 255).astype(np.uint8)
    for picture in (image, np.dstack(3 * [image])):
        seen = turned_world(picture, R_camera_shaken, world)
        np.testing.assert_array_equal(seen[~world], picture[~world])
        # Two pixels beyond what the body hides the interpolation does not know of it.
        hidden = turned(np.where(world, 0, 255).astype(np.uint8), R_camera_shaken) > 0
        apart = cv2.dilate(hidden.astype(np.uint8), np.ones((5, 5))) == 0
        free = world & apart
        assert free.mean() > 0.3
        np.testing.assert_array_equal(seen[free], turned(picture, R_camera_shaken)[free])
        # Nothing of the white body is seen in the world, not where it hides that either.
        assert seen[world].max() < 160


def test_a_world_that_is_not_turned_stays_as_it_is():
    image, world = textured_sphere(128), load_mask('lat:-90,-20', 128)
    assert np.abs(turned_world(image, Rotation.identity(), world).astype(int) - image).max() < 2


class Oracle:
    """A stabiliser that knows the orientations."""

    def __init__(self, rotations):
        self._rotations = iter(rotations)
        self.frames = []

    def process(self, frame):
        """Return the next orientation."""
        self.frames.append(frame)
        return StabilizedFrame(frame, next(self._rotations), TrackingStatus.OK)


def test_truth_is_the_clip_composed_with_the_injection():
    R_world_camera = Rotation.from_rotvec(np.random.default_rng(2).normal(0, 1, (5, 3)))
    injected = injected_rotations(3, 5)
    clip, shaken = Oracle(R_world_camera), Oracle(R_world_camera)
    both = ShakenStabilizer(clip, shaken, injected)
    world = textured_sphere(64)
    for number in range(5):
        both.process(Frame(world, number))
    difference = both.true_rotations().inv() * (R_world_camera * injected)
    assert difference.magnitude() == pytest.approx(np.zeros(5), abs=1e-9)
    assert np.array_equal(clip.frames[4].image, world)
    assert np.array_equal(shaken.frames[4].image, turned(world, injected[4]))
    assert [frame.stamp_ns for frame in shaken.frames] == list(range(5))


def figures(recording, file, *argv):
    assert main([str(recording), '--inject', '1', '--estimators', 'moment', '--json', str(file),
                 *argv]) == 0
    said = json.loads(file.read_text())
    assert said['injected_seed'] == 1
    said['estimators']['moment'].pop('ms_per_frame')
    return said['estimators']['moment']


def test_injection_into_a_bag_is_recovered_twice_the_same(turning_bag, tmp_path):
    first = figures(turning_bag, tmp_path / '1.json')
    assert first['frames'] == 12 and first['lost_frames'] == 0
    assert first['clip_turn_deg'] == pytest.approx(1.5 * 11 * np.hypot(1, 0.3), rel=0.05)
    assert first['per_frame_deg']['median'] < 0.1
    assert first['geodesic_deg']['max'] < 1
    assert figures(turning_bag, tmp_path / '2.json') == first
    assert figures(turning_bag, tmp_path / '3.json', '--max-frames', '10')['frames'] == 10


def test_a_body_that_does_not_turn_misleads_until_it_is_masked(turning_bag, tmp_path):
    errors_deg = []
    for option in ('--body', '--mask'):
        file = tmp_path / f'{option}.json'
        assert main([str(turning_bag), '--inject', '1', '--estimators', 'moment', option,
                     'lat:-90,-20', '--json', str(file)]) == 0
        said = json.loads(file.read_text())
        assert said['body'] == 'lat:-90,-20'
        errors_deg.append(said['estimators']['moment']['geodesic_deg']['max'])
    misled_deg, masked_deg = errors_deg
    assert masked_deg < misled_deg / 2


def test_errors_over_time_are_told_where_asked(turning_bag, tmp_path, capsys):
    told = figures(turning_bag, tmp_path / '1.json', '--every', '0.1')['over_time']
    assert 'geodesic [deg] after' in capsys.readouterr().out
    assert told['time_s'] == pytest.approx([3 / 30, 6 / 30, 9 / 30, 11 / 30])
    assert len(told['geodesic_deg']) == 4


def test_injection_into_a_video_is_recovered(turning_video, tmp_path):
    assert figures(turning_video, tmp_path / '1.json')['geodesic_deg']['max'] < 1
