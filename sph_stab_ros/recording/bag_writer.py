# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Results into a rosbag2 folder, under the node's topic names."""

import numpy as np
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import get_typestore, Stores

from sph_stab_ros.geometry.conventions import NS_PER_S
from sph_stab_ros.geometry.warp import focal_length_px
from sph_stab_ros.images.codec import encode_jpeg, jpeg_format

METADATA_VERSION = 9


class BagWriter:
    """
    A rosbag2 folder with MCAP storage, written message by message; a context manager.

    The message types are those of ROS 2 Jazzy.
    """

    def __init__(self, path):
        self._types = get_typestore(Stores.ROS2_JAZZY)
        self._writer = Writer(path, version=METADATA_VERSION, storage_plugin=StoragePlugin.MCAP)
        self._connections = {}

    def __enter__(self):
        self._writer.open()
        return self

    def __exit__(self, *_):
        # Also after an error, so that what there is can be read.
        self._writer.close()

    def write(self, topic, msg, received_ns):
        """Write a message made of a class from ``type``, received at ``received_ns``."""
        msgtype = msg.__msgtype__
        if topic not in self._connections:
            self._connections[topic] = self._writer.add_connection(
                topic, msgtype, typestore=self._types)
        self._writer.write(self._connections[topic], max(received_ns, 0),
                           self._types.serialize_cdr(msg, msgtype))

    def type(self, name):  # noqa: A003
        """Return the class of a message, for example of ``sensor_msgs/msg/Image``."""
        return self._types.types[name]

    def header(self, stamp_ns, frame_id):
        """Return a std_msgs Header."""
        sec, nanosec = divmod(max(stamp_ns, 0), NS_PER_S)
        stamp = self.type('builtin_interfaces/msg/Time')(sec=sec, nanosec=nanosec)
        return self.type('std_msgs/msg/Header')(stamp=stamp, frame_id=frame_id)

    def write_orientation(self, topic, stamp_ns, frame_id, rotation):
        """Write ``R_frame_…`` as a geometry_msgs QuaternionStamped."""
        x, y, z, w = rotation.as_quat()
        self.write(topic, self.type('geometry_msgs/msg/QuaternionStamped')(
            header=self.header(stamp_ns, frame_id),
            quaternion=self.type('geometry_msgs/msg/Quaternion')(x=x, y=y, z=z, w=w)), stamp_ns)

    def write_jpeg(self, topic, stamp_ns, frame_id, image):
        """Write an image, BGR or grey, as a sensor_msgs CompressedImage."""
        self.write(topic, self.type('sensor_msgs/msg/CompressedImage')(
            header=self.header(stamp_ns, frame_id), format=jpeg_format(image),
            data=encode_jpeg(image)), stamp_ns)

    def write_camera_info(self, topic, stamp_ns, frame_id, hfov_rad, size_wh):
        """Write the sensor_msgs CameraInfo of an ideal perspective view."""
        width, height = size_wh
        focal_px = focal_length_px(hfov_rad, width)
        K = np.array(((focal_px, 0, (width - 1) / 2), (0, focal_px, (height - 1) / 2), (0, 0, 1)))
        self.write(topic, self.type('sensor_msgs/msg/CameraInfo')(
            header=self.header(stamp_ns, frame_id), height=height, width=width,
            distortion_model='plumb_bob', d=np.zeros(5), k=K.ravel(), r=np.eye(3).ravel(),
            p=np.column_stack((K, np.zeros(3))).ravel(), binning_x=0, binning_y=0,
            roi=self.type('sensor_msgs/msg/RegionOfInterest')(
                x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)), stamp_ns)
