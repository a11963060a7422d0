# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Track with an estimator of your own, here the mean turn of matched features: VIDEO_OR_BAG."""

import sys

import numpy as np
from scipy.spatial.transform import Rotation
from sph_stab_ros import FrameToFrameTracker, open_recording, RotationEstimate, Stabilizer


def least_squares(pair):
    """Return the RotationEstimate of an ImagePair, or None where it cannot tell."""
    pairs = pair.matches()
    if len(pairs) < 10:
        return None
    R_current_previous, _ = Rotation.align_vectors(pairs.current, pairs.previous, pairs.weights)
    error_rad = np.linalg.norm(pairs.current - R_current_previous.apply(pairs.previous), axis=1)
    return RotationEstimate(R_current_previous, float(np.median(error_rad)), len(pairs))


stabilizer = Stabilizer(make_tracker=lambda *config: FrameToFrameTracker(least_squares))
for frame in open_recording(sys.argv[1]).frames():
    print(frame.stamp_ns, stabilizer.process(frame).R_world_camera.as_quat())
