# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The core's values to ROS messages and back; images are in ``images.codec``."""

from geometry_msgs.msg import PoseWithCovarianceStamped, Quaternion, QuaternionStamped
import numpy as np
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import CameraInfo

from sph_stab_ros.geometry.conventions import NS_PER_S
from sph_stab_ros.geometry.warp import focal_length_px
from sph_stab_ros.stabilization.steering import Rates

# The same as tf2's.
QUATERNION_TOLERANCE = 0.01
UNKNOWN_M2 = 1e9


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


def pose_message(header, R_world_camera, covariance):
    """
    Return the PoseWithCovarianceStamped of an orientation with its covariance (3, 3) in rad².

    As REP 103 has it, the covariance is about the fixed axes of the header's frame, the world.
    The position is unknown, which the message can say by a variance beyond all use only.
    """
    msg = PoseWithCovarianceStamped(header=header)
    x, y, z, w = R_world_camera.as_quat().tolist()
    msg.pose.pose.orientation = Quaternion(x=x, y=y, z=z, w=w)
    whole = np.diag([UNKNOWN_M2] * 3 + [0.] * 3)
    whole[3:, 3:] = covariance
    msg.pose.covariance = whole.ravel().tolist()
    return msg


def rates_from_twist(msg):
    """
    Return the Rates of a Twist; ValueError where one that counts is not finite.

    Yaw and pitch are those of REP 103's body: ``angular.z`` turns left, ``angular.y`` *down*.
    ``linear.z`` turns up, in rad/s too, and ``linear.x`` zooms in.
    """
    counting = msg.angular.z, msg.angular.y, msg.linear.z, msg.linear.x
    if not np.isfinite(counting).all():
        raise ValueError('angular.z, angular.y, linear.z, linear.x are ({:g}, {:g}, {:g}, {:g})'
                         .format(*counting))
    return Rates(msg.angular.z, msg.linear.z - msg.angular.y, msg.linear.x)


def view_camera_info(header, hfov_rad, size_wh):
    """Return the CameraInfo of a pinhole image with a horizontal field of view and size."""
    width, height = size_wh
    f = float(focal_length_px(hfov_rad, width))
    # Pixel centres are integers.
    cx, cy = (width - 1) / 2, (height - 1) / 2
    return CameraInfo(
        header=header, width=width, height=height,
        distortion_model='plumb_bob', d=[0.] * 5,
        k=[f, 0., cx, 0., f, cy, 0., 0., 1.],
        r=[1., 0., 0., 0., 1., 0., 0., 0., 1.],
        p=[f, 0., cx, 0., 0., f, cy, 0., 0., 0., 1., 0.])
