# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Units and axes that everything counts in; the package's docstring states them in full."""

from typing import Any

from scipy.spatial.transform import Rotation

NS_PER_S = 10**9

# A body at the camera (REP 103: x forward through the image centre, y left, z up) and its optical
# axes (x right, y down, z forward).
R_BODY_CAMERA = Rotation.from_matrix([[0, 0, 1], [-1, 0, 0], [0, -1, 0]])
R_CAMERA_BODY = R_BODY_CAMERA.inv()


def stamp_ns(stamp: Any) -> int:
    """Return a builtin_interfaces Time, of rclpy's or of a bag reader's, in nanoseconds."""
    return int(stamp.sec * NS_PER_S + stamp.nanosec)
