# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""
The anchored tracker on the committed recordings, whose truth is exact.

The bounds are twice to four times what is measured (docs/evaluation.md).
"""

from itertools import islice
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from sph_stab_ros.evaluation.alignment import Alignment
from sph_stab_ros.evaluation.ground_truth import find_truth_topic, read_truth
from sph_stab_ros.evaluation.runs import compare, increasing
from sph_stab_ros.recording import open_recording
from sph_stab_ros.simulation.recordings import R_CAMERA_MARKERS
from sph_stab_ros.stabilization.pipeline import Stabilizer
from sph_stab_ros.tracking import TrackingStatus

BAGS = Path(__file__).resolve().parents[2] / 'bags'


def track(name, every=1, frames=None):
    """Return the StabilizedFrames of a recording, each so many-th one, and their Errors."""
    recording = open_recording(BAGS / name)
    stabilizer = Stabilizer()
    results = [stabilizer.process(frame)
               for frame in islice(recording.frames(), 0, frames, every)]
    estimate = increasing([one.stamp_ns for one in results],
                          Rotation.concatenate([one.R_world_camera for one in results]))
    truth = read_truth(recording, find_truth_topic(recording))
    return results, compare(truth, estimate, Alignment(R_CAMERA_MARKERS.inv()))


@pytest.mark.parametrize('name, mean_deg, per_frame_deg', (
    ('drone', 0.15, 0.04), ('pioneer', 0.3, 0.06), ('handheld', 0.3, 0.06)))
def test_the_error_stays_small(name, mean_deg, per_frame_deg):
    results, errors = track(name)
    assert {one.status for one in results} == {TrackingStatus.OK}
    assert errors.geodesic_deg.mean() < mean_deg
    assert np.median(errors.per_frame_deg) < per_frame_deg


def test_frames_that_are_dropped_do_not_matter():
    results, errors = track('drone', every=2, frames=300)
    assert {one.status for one in results} == {TrackingStatus.OK}
    assert errors.geodesic_deg.max() < 0.4
