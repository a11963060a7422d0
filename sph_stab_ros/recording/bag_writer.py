# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Messages into a rosbag2 folder."""

from pathlib import Path
from typing import Any, Final

from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import get_typestore, Stores
from scipy.spatial.transform import Rotation

from sph_stab_ros.geometry.arrays import Image
from sph_stab_ros.recording import messages

METADATA_VERSION: Final = 9
# What is in its folder.
FILES = ('metadata.yaml', '*.mcap')


class BagWriter:
    """
    A rosbag2 folder with MCAP storage, written message by message; a context manager.

    The message types are those of ROS 2 Jazzy.
    """

    def __init__(self, path: Path) -> None:
        self._types = get_typestore(Stores.ROS2_JAZZY)
        self._writer = Writer(path, version=METADATA_VERSION, storage_plugin=StoragePlugin.MCAP)
        self._connections: dict[str, Any] = {}

    def __enter__(self) -> 'BagWriter':
        self._writer.open()
        return self

    def __exit__(self, *_: object) -> None:
        # Also after an error, so that what there is can be read.
        self._writer.close()

    def write(self, topic: str, msg: Any, received_ns: int) -> None:
        """Write a message made of a class from ``type``, received at ``received_ns``."""
        msgtype = msg.__msgtype__
        if topic not in self._connections:
            self._connections[topic] = self._writer.add_connection(
                topic, msgtype, typestore=self._types)
        self._writer.write(self._connections[topic], max(received_ns, 0),
                           self._types.serialize_cdr(msg, msgtype))

    def type(self, name: str) -> Any:  # noqa: A003
        """Return the class of a message, for example of ``sensor_msgs/msg/Image``."""
        return self._types.types[name]

    def make(self, type_name: str, **fields: Any) -> Any:
        """Return the message of a type with these fields, as ``messages`` asks for it."""
        return self.type(type_name)(**fields)

    def header(self, stamp_ns: int, frame_id: str) -> Any:
        """Return a std_msgs Header."""
        return messages.header(self.make, stamp_ns, frame_id)

    def write_orientation(
            self, topic: str, stamp_ns: int, frame_id: str, rotation: Rotation) -> None:
        """Write ``R_frame_…`` as a geometry_msgs QuaternionStamped."""
        self.write(topic, messages.orientation(self.make, stamp_ns, frame_id, rotation), stamp_ns)

    def write_jpeg(self, topic: str, stamp_ns: int, frame_id: str, image: Image) -> None:
        """Write an image, BGR or grey, as a sensor_msgs CompressedImage."""
        self.write(topic, messages.compressed_image(self.make, stamp_ns, frame_id, image),
                   stamp_ns)
