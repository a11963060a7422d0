# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Bags of compressed video, of every type of message and either generation of ROS."""

import numpy as np
from rosbags.rosbag1 import Writer as Rosbag1Writer
from rosbags.rosbag2 import StoragePlugin, Writer as Rosbag2Writer
from rosbags.typesys import get_types_from_msg, get_typestore, Stores
from tiny_recordings import stamps_of

TOPIC = '/theta/image_raw/video'
COMPRESSED_IMAGE = 'sensor_msgs/msg/CompressedImage'
COMPRESSED_VIDEO = 'foxglove_msgs/msg/CompressedVideo'
FFMPEG_PACKET = 'ffmpeg_image_transport_msgs/msg/FFMPEGPacket'
# As the packages have them; that of ROS 1 has other names and another order.
DEFINITIONS = {
    COMPRESSED_VIDEO: 'builtin_interfaces/Time timestamp\nstring frame_id\nuint8[] data\n'
                      'string format\n',
    FFMPEG_PACKET: 'std_msgs/Header header\nint32 width\nint32 height\nstring encoding\n'
                   'uint64 pts\nuint8 flags\nbool is_bigendian\nuint8[] data\n'}
FFMPEG_PACKET_ROS1 = ('std_msgs/Header header\nuint8[] data\nint32 img_width\nint32 img_height\n'
                      'string encoding\nuint64 pts\nuint8 flags\n')
DEFINITIONS_ROS1 = {**DEFINITIONS, FFMPEG_PACKET: FFMPEG_PACKET_ROS1}


def write_video_bag(path, packets, msgtype, codec, ros=2, definitions=None,
                    storage=StoragePlugin.MCAP):
    """Write a bag of messages of a type, in the order of decoding, and return its path."""
    if ros == 1:
        types, path = get_typestore(Stores.ROS1_NOETIC), path.with_suffix('.bag')
        writer = Rosbag1Writer(path)
    else:
        types = get_typestore(Stores.ROS2_JAZZY)
        writer = Rosbag2Writer(path, version=9, storage_plugin=storage)
    definitions = definitions or (DEFINITIONS_ROS1 if ros == 1 else DEFINITIONS)
    for name, text in definitions.items():
        types.register(get_types_from_msg(text, name))
    serialize = types.serialize_ros1 if ros == 1 else types.serialize_cdr
    stamps_ns = stamps_of(1 + max(index for index, _ in packets)).tolist()
    with writer:
        connection = writer.add_connection(TOPIC, msgtype, typestore=types)
        for received, (index, data) in enumerate(packets):
            stamp = types.types['builtin_interfaces/msg/Time'](*divmod(stamps_ns[index], 10**9))
            header = types.types['std_msgs/msg/Header'](
                **({'seq': 0} if ros == 1 else {}), stamp=stamp, frame_id='theta_camera')
            all_fields = {
                'header': header, 'timestamp': stamp, 'frame_id': 'theta_camera', 'width': 128,
                'height': 64, 'img_width': 128, 'img_height': 64, 'pts': index, 'flags': 0,
                'is_bigendian': False, 'format': codec, 'encoding': codec,
                'data': np.frombuffer(data, np.uint8)}
            message = types.types[msgtype]
            msg = message(**{name: all_fields[name]
                             for name in message.__dataclass_fields__ if name in all_fields})
            writer.write(connection, stamps_ns[0] + received * 33_333_333 + 10**9,
                         serialize(msg, msgtype))
    return path
