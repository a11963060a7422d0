# Copyright 2026 The sph_stab_ros developers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""The core's values to ROS messages and back; images are in ``recording.images``."""

from geometry_msgs.msg import Quaternion, QuaternionStamped
import numpy as np
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import CameraInfo

from sph_stab_ros.trajectory import NS_PER_S
from sph_stab_ros.warp import focal_length_px

# The same as tf2's.
QUATERNION_TOLERANCE = 0.01


def stamp_ns(stamp):
    """Return a builtin_interfaces Time in nanoseconds."""
    return stamp.sec * NS_PER_S + stamp.nanosec


def orientation_message(header, rotation):
    """Return the QuaternionStamped of a Rotation."""
    x, y, z, w = rotation.as_quat().tolist()
    return QuaternionStamped(header=header, quaternion=Quaternion(x=x, y=y, z=z, w=w))


def rotation_from_message(msg):
    """Return the Rotation of a QuaternionStamped; ValueError where it is not a unit one."""
    quaternion = msg.quaternion.x, msg.quaternion.y, msg.quaternion.z, msg.quaternion.w
    # Written so that NaN fails too.
    if not abs(np.linalg.norm(quaternion) - 1) <= QUATERNION_TOLERANCE:
        raise ValueError('({:g}, {:g}, {:g}, {:g}) is not a unit quaternion'.format(*quaternion))
    return Rotation.from_quat(quaternion)


def view_camera_info(header, view):
    """Return the CameraInfo of the pinhole image that a ViewConfig describes."""
    f = float(focal_length_px(np.deg2rad(view.hfov_deg), view.width))
    # Pixel centres are integers.
    cx, cy = (view.width - 1) / 2, (view.height - 1) / 2
    return CameraInfo(
        header=header, width=view.width, height=view.height,
        distortion_model='plumb_bob', d=[0.] * 5,
        k=[f, 0., cx, 0., f, cy, 0., 0., 1.],
        r=[1., 0., 0., 0., 1., 0., 0., 0., 1.],
        p=[f, 0., cx, 0., 0., f, cy, 0., 0., 0., 1., 0.])
