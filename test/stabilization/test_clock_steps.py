# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Clocks that are set while a camera turns: its orientation takes no notice."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from sph_stab_ros.config import ImuConfig, SmoothingConfig, StabilizerConfig, TrackerConfig
from sph_stab_ros.images.frame import Frame
from sph_stab_ros.images.picture_clock import PictureClock
from sph_stab_ros.images.picture_time import Stamp
from sph_stab_ros.recording.picture_times import with_times
from sph_stab_ros.stabilization.imu import ImuSample, mount_rotation
from sph_stab_ros.stabilization.pipeline import Stabilizer
from sph_stab_ros.tracking import TrackingStatus
from synthetic import angle_deg, textured_sphere

PERIOD_NS = 33_333_333
STEPS_S = (-3, 10**9)


def stepped(stamp_ns, number, step_s, at=4):
    """Return the stamp of a clock that is set before the picture ``at``."""
    return stamp_ns + (step_s * 10**9 if number >= at else 0)


def frames(images, stamps_ns):
    """Return Frames with their times decided as those of a recording."""
    stamped = [(Stamp(ns, i * PERIOD_NS), image)
               for i, (ns, image) in enumerate(zip(stamps_ns, images))]
    return [Frame(image, times.stamp_ns, times=times)
            for times, image in with_times('test', stamped, PictureClock())]


@pytest.mark.parametrize('step_s', STEPS_S)
def test_orientations_are_those_without_the_step(step_s):
    """The smoothed ones, too, and nothing of it is an event."""
    R_world_camera = Rotation.from_rotvec(np.outer(np.arange(10), np.deg2rad((0.5, 1.5, -0.3))))
    images = [textured_sphere(256, R) for R in R_world_camera]
    results = []
    for by_s in (0, step_s):
        stabilizer = Stabilizer(StabilizerConfig(
            tracker=TrackerConfig(working_width=256),
            smoothing=SmoothingConfig(mode='follow', time_constant_s=0.2)))
        stamps_ns = [stepped(i * PERIOD_NS, i, by_s) for i in range(len(images))]
        stabilized = list(map(stabilizer.process, frames(images, stamps_ns)))
        assert [s.stamp_ns for s in stabilized] == stamps_ns
        assert not any(s.events for s in stabilized)
        results.append(stabilized)
    for plain, other in zip(*results):
        assert plain.status is other.status is TrackingStatus.OK
        assert angle_deg(plain.R_world_camera, other.R_world_camera) < 1e-6
        assert angle_deg(plain.R_world_virtual, other.R_world_virtual) < 1e-4


@pytest.mark.parametrize('step_s', STEPS_S)
def test_a_gyro_of_the_same_clock_bridges_the_dark_after_the_step(step_s):
    """Longer than prediction is trusted without one."""
    mount = mount_rotation(0., 0., 0.)
    rate_rad_s = np.array((0.1, 0.6, 0.05))
    stabilizer = Stabilizer(StabilizerConfig(
        tracker=TrackerConfig(working_width=256, max_prediction_s=0.1), level='imu',
        imu=ImuConfig()))
    truth = Rotation.from_rotvec(np.outer(np.arange(24) * PERIOD_NS * 1e-9, rate_rad_s))
    images = [textured_sphere(256, R) for R in truth]
    images[8:20] = 12 * [np.zeros_like(images[0])]
    stamps_ns = [stepped(i * PERIOD_NS, i, step_s) for i in range(len(images))]
    stabilized = []
    for i, frame in enumerate(frames(images, stamps_ns)):
        for part in range(6):
            late_ns = (part - 5) * PERIOD_NS // 6
            stabilizer.add_imu(ImuSample(
                stepped(i * PERIOD_NS + late_ns, i, step_s), None, mount.inv().apply(rate_rad_s)))
        stabilized.append(stabilizer.process(frame))
    assert {s.status for s in stabilized[8:20]} == {TrackingStatus.PREDICTED}
    assert {s.status for s in stabilized[20:]} == {TrackingStatus.OK}
    for s, R in zip(stabilized, truth):
        assert angle_deg(s.R_world_camera, R) < 0.5
