# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The definitions of messages that are read: ROS's own, and those of compressed video."""

from functools import cache
import sys
from typing import Any

from rosbags.typesys import get_types_from_msg, get_typestore, Stores
from rosbags.typesys.store import Typestore

if sys.version_info >= (3, 14):
    from compression.zstd import ZstdDecompressor
else:
    from backports.zstd import ZstdDecompressor

from sph_stab_ros.recording.containers.kinds import ZSTD
from sph_stab_ros.recording.containers.limits import unpacked
from sph_stab_ros.recording.messages import (
    COMPRESSED_IMAGE, COMPRESSED_VIDEO, FFMPEG_PACKET, IMAGE, TRANSFORMS)

IMAGE_TYPES = (IMAGE, COMPRESSED_IMAGE, FFMPEG_PACKET, COMPRESSED_VIDEO)
# How the messages in a channel are encoded: the definitions of types, and what decodes by them.
ENCODINGS = {'cdr': (Stores.ROS2_JAZZY, 'deserialize_cdr'),
             'ros1': (Stores.ROS1_NOETIC, 'deserialize_ros1')}
# The packages of either generation differ; converted bags have the one in the encoding of the
# other.
OTHER_FFMPEG_PACKET = FFMPEG_PACKET + 'OfOtherRos'
FFMPEG_PACKET_ROS2 = """
std_msgs/Header header
int32 width
int32 height
string encoding
uint64 pts
uint8 flags
bool is_bigendian
uint8[] data
"""
FFMPEG_PACKET_ROS1 = """
std_msgs/Header header
uint8[] data
int32 img_width
int32 img_height
string encoding
uint64 pts
uint8 flags
"""
COMPRESSED_VIDEO_OF_FOXGLOVE = """
builtin_interfaces/Time timestamp
string frame_id
uint8[] data
string format
"""
# Of a standard type that rosbags' Noetic lacks.
TRANSFORMS_ROS1 = 'geometry_msgs/TransformStamped[] transforms'


@cache
def types_of(store: Stores) -> Typestore:
    """Return the definitions that messages of a generation of ROS are decoded by."""
    types = get_typestore(store)
    packets = [FFMPEG_PACKET_ROS2, FFMPEG_PACKET_ROS1]
    if store is Stores.ROS1_NOETIC:
        packets.reverse()
    for name, text in zip((FFMPEG_PACKET, OTHER_FFMPEG_PACKET, COMPRESSED_VIDEO),
                          (*packets, COMPRESSED_VIDEO_OF_FOXGLOVE)):
        types.register(get_types_from_msg(text, name))
    if TRANSFORMS not in types.types:
        types.register(get_types_from_msg(TRANSFORMS_ROS1, TRANSFORMS))
    return types


def is_known(msgtype: str, encoding: str) -> bool:
    """Tell whether messages of a type can be decoded, whatever the recording says of it."""
    return encoding in ENCODINGS and msgtype in types_of(ENCODINGS[encoding][0]).types


def decoded(data: bytes, msgtype: str, encoding: str) -> Any:
    """Return a message, which may be compressed by itself."""
    store, decode = ENCODINGS[encoding]
    # The encapsulation that CDR data begin with is never this.
    if encoding == 'cdr' and data.startswith(ZSTD):
        data = unpacked(ZstdDecompressor(), data)
    deserialize = getattr(types_of(store), decode)
    try:
        return deserialize(data, msgtype)
    except Exception:
        if msgtype != FFMPEG_PACKET:
            raise
        return deserialize(data, OTHER_FFMPEG_PACKET)
