# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The chain of rotations from frame to frame, where frames are missing."""

import numpy as np
from scipy.spatial.transform import Rotation
from sph_stab_ros.tracking import TrackingStatus
from sph_stab_ros.tracking.frame_to_frame.tracker import FrameToFrameTracker
from synthetic import textured_sphere

WIDTH = 256
NS = 10**9
DARK = np.zeros((WIDTH // 2, WIDTH), np.uint8)


def sphere(angle_deg):
    """Return the grey sphere of a camera turned to the left."""
    return textured_sphere(WIDTH, Rotation.from_rotvec((0, -np.deg2rad(angle_deg), 0)))


def test_what_turned_goes_on_turning_for_as_long_as_that_is_trusted():
    tracker = FrameToFrameTracker('pts', max_prediction_s=0.5)
    tracker.track(sphere(0), 0)
    turned = tracker.track(sphere(2), NS // 10)
    for after_s, expected_s, status in (
            (0.2, 0.2, TrackingStatus.PREDICTED), (0.8, 0.5, TrackingStatus.LOST)):
        predicted = tracker.track(DARK, round((0.1 + after_s) * NS))
        turn = (turned.R_world_camera.inv() * predicted.R_world_camera).magnitude()
        assert predicted.status is status
        assert np.isclose(turn, turned.R_world_camera.magnitude() * expected_s / 0.1)


def test_after_a_loss_nothing_of_the_motion_before_is_known():
    known = [True]
    tracker = FrameToFrameTracker(
        lambda pair: pair.pts() if known[0] else None, max_prediction_s=0.5)
    tracker.track(sphere(0), 0)
    assert tracker.track(sphere(2), NS // 10).R_world_camera.magnitude() > np.deg2rad(1)
    known[0] = False
    lost = tracker.track(sphere(90), 2 * NS)
    assert lost.status is TrackingStatus.LOST
    dark = tracker.track(DARK, 2 * NS + NS // 10)
    assert dark.status is TrackingStatus.LOST
    assert (lost.R_world_camera.inv() * dark.R_world_camera).magnitude() == 0
