# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""
Bags, damaged in every way: pictures and one line come out, never another exception.

What comes out of which damage is stated in ``test/recording/test_damaged_bags.py``.
"""

from contextlib import suppress
from functools import cache
from pathlib import Path
import re
import struct
import tempfile

from fuzzing import examples, mutated, tried
from hypothesis import given, strategies as st
import numpy as np
from rosbags.typesys import get_typestore, Stores
import small_bags
from sph_stab_ros.evaluation.ground_truth import read_truth
from sph_stab_ros.images.codec import ImageError
from sph_stab_ros.recording import open_recording, RecordingError

RECORD_OF_MCAP = re.compile(rb'(?s)[\x01-\x0f].{5}\0\0\0')


@cache
def folder():
    """Return a folder for bags, as long as the tests run."""
    return tempfile.TemporaryDirectory(prefix='fuzz_')


@cache
def mcap_files():
    messages = small_bags.image_messages(4)
    return tuple(small_bags.mcap(messages, compression=compression, per_chunk=per_chunk,
                                 checksums=checksums).data
                 for compression, per_chunk, checksums in (
                     ('', 2, True), ('', 2, False), ('lz4', 2, False), ('zstd', 2, False),
                     ('', 0, False)))


@cache
def rosbag1_files():
    messages = small_bags.image_messages(4, generation=1)
    return tuple(
        small_bags.rosbag1(Path(folder().name) / f'{compression}.bag', messages, compression).data
        for compression in (None, 'bz2', 'lz4'))


@cache
def sqlite_files():
    return small_bags.sqlite(
        Path(folder().name) / 'sqlite', small_bags.image_messages(4)).read_bytes(),


def heads_of_mcap(data):
    return [match.start() for match in RECORD_OF_MCAP.finditer(data)] or [0]


def heads_of_rosbag1(data):
    return [match.start() - 8 for match in re.finditer(rb'[a-z_]+=', data)] or [0]


def heads_of_sqlite(data):
    return [0, 16, 28, *range(0, len(data), 4096), *range(8, len(data), 4096)]


def read(name, data, image_topic=None):
    """Read all there is in a file of these bytes; RecordingError is the only way to fail."""
    path = Path(folder().name) / 'input'
    with tried(name, data):
        path.write_bytes(data)
        try:
            recording = open_recording(path, image_topic)
            for topic in recording.topics:
                with suppress(RecordingError):
                    for _ in recording.messages(topic):
                        pass
                with suppress(RecordingError):
                    read_truth(recording, topic)
                with suppress(RecordingError):
                    read_truth(recording, topic, ('map', 'base'))
            for frame in recording.frames():
                try:
                    frame.load()
                    frame.grey(32)
                except ImageError:
                    pass
        except RecordingError as error:
            assert str(error)


@given(st.deferred(lambda: mutated(*mcap_files(), hot=heads_of_mcap)))
@examples(60)
def test_mcap(data):
    read('mcap', data)


@given(st.deferred(lambda: mutated(*rosbag1_files(), hot=heads_of_rosbag1)))
@examples(60)
def test_rosbag1(data):
    read('rosbag1', data)


@given(st.deferred(lambda: mutated(*sqlite_files(), hot=heads_of_sqlite)))
@examples(60)
def test_sqlite(data):
    read('sqlite', data)


def records(inside):
    """Return a strategy for records in a chunk of MCAP, some of them wrong."""
    return st.lists(st.one_of(
        st.sampled_from(inside), mutated(*inside),
        st.builds(small_bags.record, st.integers(0, 255), st.binary(max_size=40))), max_size=8)


@cache
def inside_of_chunk():
    """Return the records that a chunk holds."""
    text, record = small_bags.text, small_bags.record
    schema = record(3, struct.pack('<H', 1) + text(small_bags.COMPRESSED_IMAGE) +
                    text('ros2msg') + text(''))
    channel = record(4, struct.pack('<HH', 1, 1) + text(small_bags.IMAGE_TOPIC) + text('cdr') +
                     text(''))
    return schema, channel, *(small_bags.mcap_message(*one)
                              for one in small_bags.image_messages(2))


@given(st.deferred(lambda: st.builds(
    chunk_of_mcap, records(inside_of_chunk()), st.sampled_from(('', 'lz4', 'zstd')))))
@examples(60)
def test_chunks_of_mcap_that_hold_anything(data):
    """Compressed as they should be: what is inside is read as it is."""
    read('mcap_chunk', data)


def chunk_of_mcap(found, compression):
    """Return an MCAP file with one chunk of records."""
    inside = b''.join(found)
    packed = small_bags.COMPRESS[compression](inside)
    return small_bags.MCAP_MAGIC + small_bags.record(1, bytes(8)) + small_bags.record(
        6, struct.pack('<QQQI', 0, 0, len(inside), 0) + small_bags.text(compression) +
        struct.pack('<Q', len(packed)) + packed)


@given(st.deferred(lambda: mutated(*small_messages())))
@examples(40)
def test_messages_of_every_type(data):
    """The bytes of a message, whichever type a bag says it is of; as truth too."""
    for encoding in ('cdr', 'ros1'):
        inside = []
        for number, msgtype in enumerate(TYPES, 1):
            inside += [
                small_bags.record(3, struct.pack('<H', number) + small_bags.text(msgtype) +
                                  small_bags.text('ros2msg') + small_bags.text('')),
                small_bags.record(4, struct.pack('<HH', number, number) +
                                  small_bags.text(f'/topic_{number}') +
                                  small_bags.text(encoding) + small_bags.text('')),
                small_bags.record(5, struct.pack('<HIQQ', number, 0, 5, 5) + data)]
        read('message', chunk_of_mcap(inside, ''), image_topic='/topic_1')


TYPES = ('sensor_msgs/msg/CompressedImage', 'sensor_msgs/msg/Image', 'tf2_msgs/msg/TFMessage',
         'ffmpeg_image_transport_msgs/msg/FFMPEGPacket', 'nav_msgs/msg/Path',
         'geometry_msgs/msg/PoseStamped', 'sensor_msgs/msg/Imu', 'nav_msgs/msg/Odometry')


@cache
def small_messages():
    """Return messages of all these types, cut to a size that fits any."""
    types = get_typestore(Stores.ROS2_JAZZY)
    make = types.types
    time = make['builtin_interfaces/msg/Time'](sec=5, nanosec=7)
    header = make['std_msgs/msg/Header'](stamp=time, frame_id='map')
    quaternion = make['geometry_msgs/msg/Quaternion'](x=0., y=0., z=0., w=1.)
    transform = make['geometry_msgs/msg/TransformStamped'](
        header=header, child_frame_id='base', transform=make['geometry_msgs/msg/Transform'](
            translation=make['geometry_msgs/msg/Vector3'](x=0., y=0., z=0.), rotation=quaternion))
    pose = make['geometry_msgs/msg/PoseStamped'](
        header=header, pose=make['geometry_msgs/msg/Pose'](
            position=make['geometry_msgs/msg/Point'](x=0., y=0., z=0.), orientation=quaternion))
    image = make['sensor_msgs/msg/Image'](
        header=header, height=4, width=6, encoding='mono8', is_bigendian=0, step=6,
        data=np.zeros(24, np.uint8))
    messages = (make['tf2_msgs/msg/TFMessage'](transforms=[transform, transform]), pose, image,
                make['nav_msgs/msg/Path'](header=header, poses=[pose, pose]))
    return tuple(bytes(types.serialize_cdr(msg, msg.__msgtype__)) for msg in messages) + tuple(
        data for generation in (1, 2)
        for _, data in small_bags.image_messages(1, generation, width=64))
