# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What the texts of ``evaluate``'s own arguments mean."""

from argparse import ArgumentTypeError

import numpy as np
from scipy.spatial.transform import Rotation

from sph_stab_ros.config import AUTO
from sph_stab_ros.evaluation.transforms import Frames, same_frame
from sph_stab_ros.geometry.conventions import NS_PER_S, R_BODY_CAMERA
from sph_stab_ros.geometry.warp import view_rotation


def mount_argument(text: str) -> Rotation:
    """Return R_body_camera from ``yaw,pitch,roll`` in degrees or a quaternion ``x,y,z,w``."""
    try:
        values = np.array(text.split(','), float)
        if np.isfinite(values).all() and len(values) == 4:
            return Rotation.from_quat(values)
        if np.isfinite(values).all() and len(values) == 3:
            return R_BODY_CAMERA * view_rotation(*np.deg2rad(values))
    except ValueError:
        pass
    raise ArgumentTypeError(f"'{text}' is neither yaw,pitch,roll in degrees nor qx,qy,qz,qw")


def clock_argument(text: str) -> int | str:
    """Return nanoseconds from seconds, or AUTO."""
    try:
        return AUTO if text == AUTO else round(float(text) * NS_PER_S)
    except (ValueError, OverflowError):
        raise ArgumentTypeError(f"'{text}' is neither auto nor a number of seconds") from None


def frames_argument(text: str) -> Frames:
    """Return (parent, child) from ``parent:child``."""
    parent, _, child = (same_frame(one) for one in text.partition(':'))
    if not parent or not child or parent == child:
        raise ArgumentTypeError(f"'{text}' is not PARENT:CHILD, two names of frames")
    return parent, child
