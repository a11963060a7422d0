# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""
What ROS messages hold, the same in the node and in bags, without ROS.

``make(type, **fields)`` returns a message of whichever library: rclpy's, or that of a bag's
writer. Sequences of numbers are arrays.
"""

from collections.abc import Callable, Mapping
from typing import Any, TypeAlias

import numpy as np
from scipy.spatial.transform import Rotation

from sph_stab_ros.geometry.arrays import Covariance, Image
from sph_stab_ros.geometry.conventions import NS_PER_S
from sph_stab_ros.geometry.warp import focal_length_px
from sph_stab_ros.images.codec import compressed_fields, image_fields, JPEG_QUALITY

CAMERA_INFO = 'sensor_msgs/msg/CameraInfo'
COMPRESSED_IMAGE = 'sensor_msgs/msg/CompressedImage'
COMPRESSED_VIDEO = 'foxglove_msgs/msg/CompressedVideo'
FFMPEG_PACKET = 'ffmpeg_image_transport_msgs/msg/FFMPEGPacket'
IMAGE = 'sensor_msgs/msg/Image'
POSE_WITH_COVARIANCE = 'geometry_msgs/msg/PoseWithCovarianceStamped'
QUATERNION = 'geometry_msgs/msg/QuaternionStamped'
TRANSFORMS = 'tf2_msgs/msg/TFMessage'
UNKNOWN_M2 = 1e9

# From the name of a type and its fields to a message.
Make: TypeAlias = Callable[..., Any]


def header(make: Make, stamp_ns: int, frame_id: str) -> Any:
    """Return a Header."""
    sec, nanosec = divmod(stamp_ns, NS_PER_S)
    return make('std_msgs/msg/Header', frame_id=frame_id,
                stamp=make('builtin_interfaces/msg/Time', sec=sec, nanosec=nanosec))


def orientation(make: Make, stamp_ns: int, frame_id: str, R_frame_other: Rotation) -> Any:
    """Return the QuaternionStamped of a Rotation."""
    return make(QUATERNION, header=header(make, stamp_ns, frame_id),
                quaternion=_quaternion(make, R_frame_other))


def pose(make: Make, stamp_ns: int, frame_id: str, R_world_camera: Rotation,
         covariance: Covariance) -> Any:
    """
    Return the PoseWithCovarianceStamped of an orientation with its covariance in rad².

    As REP 103 has it, the covariance is about the fixed axes of the header's frame, the world.
    The position is unknown, which the message can say by a variance beyond all use only.
    """
    whole = np.diag([UNKNOWN_M2] * 3 + [0.] * 3)
    whole[3:, 3:] = covariance
    position = make('geometry_msgs/msg/Point', x=0., y=0., z=0.)
    return make(
        POSE_WITH_COVARIANCE, header=header(make, stamp_ns, frame_id),
        pose=make('geometry_msgs/msg/PoseWithCovariance', covariance=whole.ravel(), pose=make(
            'geometry_msgs/msg/Pose', position=position,
            orientation=_quaternion(make, R_world_camera))))


def transforms(make: Make, stamp_ns: int, rotations: Mapping[tuple[str, str], Rotation]) -> Any:
    """
    Return the TFMessage of Rotations ``R_parent_child`` by (parent, child).

    A transform holds what maps the child's coordinates into the parent's.
    """
    return make(TRANSFORMS, transforms=[
        make('geometry_msgs/msg/TransformStamped', header=header(make, stamp_ns, parent),
             child_frame_id=child, transform=make(
                 'geometry_msgs/msg/Transform', rotation=_quaternion(make, R_parent_child),
                 translation=make('geometry_msgs/msg/Vector3', x=0., y=0., z=0.)))
        for (parent, child), R_parent_child in rotations.items()])


def camera_info(make: Make, stamp_ns: int, frame_id: str, hfov_rad: float,
                size_wh: tuple[int, int]) -> Any:
    """Return the CameraInfo of a pinhole image with a horizontal field of view and size."""
    width, height = size_wh
    f = focal_length_px(hfov_rad, width)
    # Pixel centres are integers.
    K = np.array(((f, 0, (width - 1) / 2), (0, f, (height - 1) / 2), (0, 0, 1)))
    return make(
        CAMERA_INFO, header=header(make, stamp_ns, frame_id), height=height, width=width,
        distortion_model='plumb_bob', d=np.zeros(5), k=K.ravel(), r=np.eye(3).ravel(),
        p=np.column_stack((K, np.zeros(3))).ravel(), binning_x=0, binning_y=0,
        roi=make('sensor_msgs/msg/RegionOfInterest', x_offset=0, y_offset=0, height=0, width=0,
                 do_rectify=False))


def image(make: Make, stamp_ns: int, frame_id: str, picture: Image) -> Any:
    """Return the Image of a picture, BGR or grey."""
    return make(IMAGE, header=header(make, stamp_ns, frame_id), **image_fields(picture))


def compressed_image(make: Make, stamp_ns: int, frame_id: str, picture: Image,
                     quality: int = JPEG_QUALITY) -> Any:
    """Return the CompressedImage of a picture, BGR or grey, as JPEG."""
    return make(COMPRESSED_IMAGE, header=header(make, stamp_ns, frame_id),
                **compressed_fields(picture, quality))


def _quaternion(make: Make, rotation: Rotation) -> Any:
    x, y, z, w = rotation.as_quat().tolist()
    return make('geometry_msgs/msg/Quaternion', x=x, y=y, z=z, w=w)
