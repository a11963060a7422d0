# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The stabiliser and its trackers on streams of frames, good and bad."""

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sph_stab_ros.config import options, StabilizerConfig, TrackerConfig
from sph_stab_ros.geometry.projection_factory import ProjectionError
from sph_stab_ros.images.frame import Frame
from sph_stab_ros.stabilization.pipeline import Stabilizer, view_direction
from sph_stab_ros.stabilization.stabilized_frame import StabilizationEvent
from sph_stab_ros.tracking import TrackingStatus
from synthetic import angle_deg, textured_sphere

WIDTH = 256
PERIOD_NS = 33_333_333
ESTIMATORS = {one.name: one.choices for one in options(TrackerConfig)}['estimator']
# Both trackers must behave; of the chain's methods one stands for all.
every_tracker = pytest.mark.parametrize('estimator', ('anchored', 'moment'))


def turning(frames, degrees_per_frame=(0.5, 1., -0.3)):
    """Return the orientations R_world_camera (frames) of a camera that turns steadily."""
    steps = np.arange(frames)[:, None] * np.deg2rad(degrees_per_frame)
    return Rotation.from_rotvec(steps)


def films(orientations, width=WIDTH):
    """Return the Frames that a camera of these orientations takes of a world at infinity."""
    return [Frame(textured_sphere(width, R), i * PERIOD_NS) for i, R in enumerate(orientations)]


def stabilizer(estimator, **options):
    """Return a Stabilizer fit for the small pictures here."""
    return Stabilizer(StabilizerConfig(tracker=TrackerConfig(
        estimator=estimator, flow='dis', working_width=WIDTH, **options)))


def black(frame):
    """Return the frame with nothing to see."""
    return Frame(np.zeros_like(frame.image), frame.stamp_ns)


@pytest.mark.parametrize('estimator', ESTIMATORS)
def test_orientations_are_those_of_the_camera(estimator):
    truth = turning(6)
    process = stabilizer(estimator).process
    for frame, R in zip(films(truth), truth):
        stabilized = process(frame)
        assert stabilized.status is TrackingStatus.OK
        assert stabilized.stamp_ns == frame.stamp_ns
        assert angle_deg(stabilized.R_world_camera, R) < 0.3


@every_tracker
def test_the_stabilised_sphere_stands_still(estimator):
    truth = turning(5, (2., 3., 1.))
    process = stabilizer(estimator).process
    first, *_, last = [process(frame) for frame in films(truth)]
    raw = cv2.absdiff(last.frame.image, first.frame.image).mean()
    assert cv2.absdiff(last.sphere(), first.frame.image).mean() < 0.1 * raw


@every_tracker
def test_a_view_looks_along_its_direction_whatever_the_camera_does(estimator):
    truth = turning(4, (2., 3., 1.))
    process = stabilizer(estimator).process
    R_world_view = Rotation.from_euler('Y', -90, degrees=True)
    views = [process(frame).view(R_world_view, 1., (80, 60)) for frame in films(truth)]
    assert views[0].shape == (60, 80)
    assert cv2.absdiff(views[0], views[-1]).mean() < 3
    other = process(films(truth)[-1]).view(Rotation.identity(), 1., (80, 60))
    assert cv2.absdiff(other, views[-1]).mean() > 10


@every_tracker
def test_the_first_orientation_and_the_one_after_a_reset_are_the_world(estimator):
    frames = films(turning(4))
    stabilise = stabilizer(estimator)
    for frame in frames:
        stabilise.process(frame)
    stabilise.reset()
    assert stabilise.process(frames[2]).R_world_camera.magnitude() == 0


@every_tracker
def test_black_frames_are_bridged_by_prediction(estimator):
    truth = turning(10)
    frames = films(truth)
    frames[5:7] = map(black, frames[5:7])
    stabilized = list(map(stabilizer(estimator).process, frames))
    statuses = [s.status for s in stabilized]
    assert statuses[5:7] == [TrackingStatus.PREDICTED] * 2
    assert set(statuses[:5] + statuses[7:]) == {TrackingStatus.OK}
    for s, R in zip(stabilized, truth):
        assert angle_deg(s.R_world_camera, R) < 0.3


@every_tracker
def test_prediction_ends_and_says_so(estimator):
    truth = turning(9)
    frames = films(truth)
    frames[3:8] = map(black, frames[3:8])
    stabilized = list(map(stabilizer(estimator, max_prediction_s=0.1).process, frames))
    assert [s.status for s in stabilized[3:8]] == 3 * [TrackingStatus.PREDICTED] + 2 * [
        TrackingStatus.LOST]
    # Held, not turned on for ever.
    assert angle_deg(stabilized[7].R_world_camera, stabilized[6].R_world_camera) < 1e-6
    assert stabilized[8].status is TrackingStatus.OK
    assert angle_deg(stabilized[8].R_world_camera, truth[8]) < 0.3


@every_tracker
def test_a_black_start_waits_for_the_first_picture(estimator):
    frames = films(turning(3))
    process = stabilizer(estimator).process
    assert process(black(frames[0])).status is TrackingStatus.LOST
    assert process(frames[1]).R_world_camera.magnitude() == 0
    assert process(frames[2]).status is TrackingStatus.OK


@every_tracker
def test_a_gap_of_seconds_is_noticed_and_bridged(estimator):
    truth = turning(3, (10., 5., 0.))
    frames = films(truth)
    frames[2] = Frame(frames[2].image, 3_000_000_000)
    *_, last = map(stabilizer(estimator).process, frames)
    assert last.events == (StabilizationEvent.GAP,)
    assert angle_deg(last.R_world_camera, truth[2]) < 0.3


@pytest.mark.parametrize('stamp_ns', (PERIOD_NS, PERIOD_NS // 2))
@every_tracker
def test_stamps_that_do_not_increase_are_noticed_and_the_frame_is_used(estimator, stamp_ns):
    truth = turning(4)
    frames = films(truth)
    frames[2] = Frame(frames[2].image, stamp_ns)
    stabilized = list(map(stabilizer(estimator).process, frames))
    assert stabilized[2].events == (StabilizationEvent.STAMP_NOT_INCREASING,)
    assert stabilized[3].events == ()
    assert angle_deg(stabilized[3].R_world_camera, truth[3]) < 0.15


@pytest.mark.parametrize('widths', ((480, 320), (256, 160), (160, 256)))
@every_tracker
def test_a_new_size_costs_no_turn(estimator, widths):
    """The first frame of the new size is tracked against the last one of the old."""
    truth = turning(6)
    frames = films(truth, width=widths[0])[:3] + films(truth, width=widths[1])[3:]
    stabilized = list(map(stabilizer(estimator).process, frames))
    assert stabilized[3].events == (StabilizationEvent.RESIZED,)
    assert stabilized[3].status is TrackingStatus.OK
    for one, R_world_camera in zip(stabilized, truth):
        # The smallest pictures here tell no tenths of a degree; a turn lost would be a whole one.
        assert angle_deg(one.R_world_camera, R_world_camera) < angle_deg(truth[0], truth[1]) / 2


@pytest.mark.parametrize('shape, reason', [
    ((100, 100, 3), '100x100'), ((0, 0, 3), '0x0'), ((322, 640, 3), '2:1'), ((32, 64), '64 px')])
@every_tracker
def test_pictures_that_are_no_spheres_are_refused(estimator, shape, reason):
    stabilise = stabilizer(estimator)
    frames = films(turning(2))
    stabilise.process(frames[0])
    with pytest.raises(ProjectionError, match=reason):
        stabilise.process(Frame(np.zeros(shape, np.uint8), 0))
    # And harm nobody.
    assert stabilise.process(frames[1]).events == ()


def test_view_angles_are_those_of_the_view():
    view = StabilizerConfig().view
    assert view_direction(view).magnitude() == 0
    np.testing.assert_allclose(
        view_direction(type(view)(yaw_deg=90.)).apply((0, 0, 1)), (-1, 0, 0), atol=1e-12)
