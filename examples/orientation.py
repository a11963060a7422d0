# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Print the orientation of the camera in every picture of a video or bag: VIDEO_OR_BAG."""

import sys

import numpy as np
from sph_stab_ros import open_recording, Stabilizer, TrackingStatus

stabilizer = Stabilizer()
for frame in open_recording(sys.argv[1]).frames():
    stabilized = stabilizer.process(frame)
    # A scipy Rotation: it maps what the camera sees into the frame of the first picture.
    R_world_camera = stabilized.R_world_camera
    turned_deg = np.rad2deg(R_world_camera.magnitude())
    # Any other status means: not measured in this picture, do not steer by it.
    if stabilized.status is TrackingStatus.OK:
        x, y, z, w = R_world_camera.as_quat()
        print(f'{stabilized.stamp_ns} {x:.5f} {y:.5f} {z:.5f} {w:.5f} turned {turned_deg:.2f} deg')
    else:
        print(f'{stabilized.stamp_ns} {stabilized.status.value}')
