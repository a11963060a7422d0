# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""
The covariance of the anchored tracker against its errors, over many runs: consistency.

Of an error e with covariance C the normalised square ``eᵀ C⁻¹ e / 3`` (NEES) is 1 in the mean.
Errors within a run go together, so that each run, of its own noise and path, counts once.
"""

from itertools import islice

import numpy as np
from painted_room import flight, room, tracked
import pytest
from scipy.stats import chi2
from sph_stab_ros.evaluation.ground_truth import find_truth_topic, read_truth
from sph_stab_ros.geometry.equirect import bearing_grid
from sph_stab_ros.recording import open_recording
from sph_stab_ros.simulation.recordings import R_CAMERA_MARKERS
from sph_stab_ros.stabilization.pipeline import Stabilizer
from sph_stab_ros.tracking.anchored.tracker import AnchoredTracker
from sph_stab_ros.tracking.base import TrackedOrientation, TrackingStatus
from synthetic import angle_deg, unit
from tracking_accuracy import ROOT

pytestmark = pytest.mark.thorough
# Variances up to twice too large or too small. Since the band is four times as wide as it begins,
# whatever lies in it leaves it when the covariance is four times as large or as small.
BAND = 0.5, 2.
SEEDS = 16
NOISE_GREY = 4
# Of the runs through the room: the third frame, one after the first keyframe, the last one.
START, AFTER_KEYFRAME, END = 3, 10, 19
SEGMENT_FRAMES = 30
SETTLED = SEGMENT_FRAMES - 1
PASSES, WIDTH, PERIOD_NS = 4, 640, 66_666_667


def normalised(results, R_world_camera):
    """Return the normalised squares (N − 1,) of all orientations tracked but the first one."""
    squares = []
    for result, R in list(zip(results, R_world_camera))[1:]:
        assert np.linalg.eigvalsh(result.covariance).min() > 0
        error = (result.R_world_camera * (R_world_camera[0].inv() * R).inv()).as_rotvec()
        squares.append(error @ np.linalg.solve(result.covariance, error) / 3)
    return np.array(squares)


def is_consistent(squares):
    """Tell whether the mean of normalised squares (N,) of N independent runs lies in the band."""
    return BAND[0] < np.mean(squares) < BAND[1]


@pytest.fixture(scope='module')
def flights():
    """Return images and orientations of flights through a room, each with noise of its own."""
    made = []
    for seed in range(SEEDS):
        rng = np.random.default_rng(seed)
        R, p = flight(END + 1, unit(rng.normal(size=3)), 0.022 * unit(rng.normal(size=3)))
        images = [room(*pose) for pose in zip(R, p)]
        made.append(([np.uint8(np.clip(image + rng.normal(0, NOISE_GREY, image.shape), 0, 255))
                      for image in images], R))
    return made


def in_the_room(flights):
    """Return the normalised squares (SEEDS, END) of frames 1 to END of all flights."""
    return np.array([normalised(tracked(images), R) for images, R in flights])


@pytest.fixture(scope='module')
def room_squares(flights):
    return in_the_room(flights)


@pytest.fixture(scope='module')
def segment_squares():
    """Return the normalised squares (N, SETTLED) of trackers started all along the recordings."""
    squares = []
    for name in ('drone', 'pioneer', 'handheld'):
        recording = open_recording(ROOT / 'bags' / name)
        truth = read_truth(recording, find_truth_topic(recording))
        results = []
        for frame in recording.frames():
            if not results:
                stabilizer = Stabilizer()
            results.append(stabilizer.process(frame))
            if len(results) == SEGMENT_FRAMES:
                stamps_ns = np.array([result.stamp_ns for result in results])
                squares.append(normalised(results, truth.at(stamps_ns) * R_CAMERA_MARKERS.inv()))
                results = []
    return np.array(squares)


@pytest.mark.parametrize('runs', (SEEDS, 36))
def test_a_right_covariance_lies_in_the_band_almost_always(runs):
    low, high = np.array(chi2.interval(0.99, 3 * runs)) / (3 * runs)
    assert BAND[0] < low < 1 < high < BAND[1]


@pytest.mark.xfail(strict=True, reason=(
    '0.43, 0.12, 0.29: a stitch error is reckoned with, and errors that go together in real '
    'pictures; a painted room has neither, and the deviations are twice the errors'))
@pytest.mark.parametrize('frame', (START, AFTER_KEYFRAME, END))
def test_errors_in_a_room_are_as_large_as_the_covariance_says(room_squares, frame):
    assert is_consistent(room_squares[:, frame - 1])


@pytest.mark.slow
@pytest.mark.parametrize('frame', (START, SETTLED))
def test_errors_in_recordings_are_as_large_as_the_covariance_says(segment_squares, frame):
    assert len(segment_squares) == 36
    assert is_consistent(segment_squares[:, frame - 1])


@pytest.mark.parametrize('factor', (4., pytest.param(1 / 4, marks=pytest.mark.xfail(
    strict=True, reason='0.43 and 0.29 times 4: what is too large here is then right'))))
def test_a_covariance_four_times_off_is_found_out(monkeypatch, flights, factor):
    track = AnchoredTracker.track

    def scaled(self, grey, stamp_ns):
        result = track(self, grey, stamp_ns)
        return TrackedOrientation(
            result.R_world_camera, result.status, factor * result.covariance)
    monkeypatch.setattr(AnchoredTracker, 'track', scaled)
    squares = in_the_room(flights)
    assert not is_consistent(squares[:, END - 1])
    assert not is_consistent(squares[:, START - 1])


@pytest.mark.slow
@pytest.mark.parametrize('lon_deg, lat_deg', ((70, 45), (90, 90)))
def test_no_status_is_ok_where_an_error_exceeds_a_degree(lon_deg, lat_deg):
    """In pictures that are black but for a part: turns and sideways motion look alike there."""
    recording = open_recording(ROOT / 'bags' / 'drone')
    truth, stabilizer = read_truth(recording, find_truth_topic(recording)), Stabilizer()
    errors_deg = {status: [] for status in TrackingStatus}
    for frame in recording.frames():
        R_world_camera = truth.at([frame.stamp_ns])[0] * R_CAMERA_MARKERS.inv()
        if not any(map(len, errors_deg.values())):
            R_world_first = R_world_camera
            x, y, z = np.moveaxis(bearing_grid(frame.image.shape[1]), -1, 0)
            black = ((np.abs(np.arctan2(x, z)) > np.deg2rad(lon_deg))
                     | (np.abs(np.arcsin(y)) > np.deg2rad(lat_deg)))
        frame.image[black] = 0
        result = stabilizer.process(frame)
        errors_deg[result.status].append(
            angle_deg(result.R_world_camera, R_world_first.inv() * R_world_camera))
    assert max(errors_deg[TrackingStatus.OK]) < 1
    # It is tracked all the same, and no status is a way out of the first frames.
    assert not errors_deg[TrackingStatus.LOST]
    assert len(errors_deg[TrackingStatus.OK]) > 5


def test_who_goes_to_and_fro_does_not_lose_what_he_knows():
    """In minutes between the same walls errors do not add up, and neither does the covariance."""
    recording = open_recording(ROOT / 'bags/pioneer')
    pictures = [frame.grey(WIDTH) for frame in islice(recording.frames(), 0, 160, 2)]
    to_and_fro = [*pictures[:-1], *pictures[:0:-1]]
    tracker, covariances = AnchoredTracker(), []
    for n, picture in enumerate(PASSES * to_and_fro):
        covariances.append(tracker.track(picture, n * PERIOD_NS).covariance)
        tracker.settle()
    after_once, at_end = covariances[len(to_and_fro) - 1], covariances[-1]
    assert np.trace(at_end) < 4 * np.trace(after_once)
