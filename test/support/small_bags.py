# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
"""Small bags of every kind, written with all that can vary in the field, and damage to them."""

from dataclasses import dataclass, field
from io import BytesIO
import struct
from zlib import crc32

from backports import zstd
import lz4.frame
import numpy as np
from rosbags.rosbag1 import Writer as Rosbag1Writer
from rosbags.rosbag2 import StoragePlugin, Writer as Rosbag2Writer
from rosbags.typesys import get_typestore, Stores
from sph_stab_ros.images.codec import encode_jpeg
from tiny_recordings import IMAGE_TOPIC, stamps_of, textured_sphere

COMPRESSED_IMAGE = 'sensor_msgs/msg/CompressedImage'
MCAP_MAGIC = b'\x89MCAP0\r\n'
COMPRESS = {'': lambda data: data, 'lz4': lz4.frame.compress, 'zstd': zstd.compress}


def image_messages(count, generation=2, width=64):
    """Return (time of receipt, encoded CompressedImage) of pictures that all differ."""
    types = get_typestore(Stores.ROS2_JAZZY if generation == 2 else Stores.ROS1_NOETIC)
    serialize = types.serialize_cdr if generation == 2 else types.serialize_ros1
    sequence = {} if generation == 2 else {'seq': 0}

    def encoded(seed, stamp_ns):
        return serialize(types.types[COMPRESSED_IMAGE](
            header=types.types['std_msgs/msg/Header'](
                **sequence, frame_id='theta_camera',
                stamp=types.types['builtin_interfaces/msg/Time'](*divmod(stamp_ns, 10**9))),
            format='jpeg', data=encode_jpeg(textured_sphere(width, seed))), COMPRESSED_IMAGE)
    return [(stamp_ns, bytes(encoded(seed, stamp_ns)))
            for seed, stamp_ns in enumerate(stamps_of(count).tolist())]


@dataclass
class Written:
    """A file, and which messages (as a slice) stand in which of its bytes."""

    data: bytes
    spans: list = field(default_factory=list)

    def untouched(self, messages, first, last):
        """Return the messages outside of what reaches into the bytes first to last."""
        return [message for start, end, part in self.spans
                if end <= first or last < start for message in messages[part]]


def mcap(messages, *, compression='zstd', per_chunk=4, checksums=True, index=True,
         profile='ros2', topic=IMAGE_TOPIC, msgtype=COMPRESSED_IMAGE, encoding='cdr'):
    """Return the Written MCAP file of one topic; messages without chunks if ``per_chunk`` is 0."""
    schema = record(3, struct.pack('<H', 1) + text(msgtype) + text('ros2msg') + text(''))
    channel = record(4, struct.pack('<HH', 1, 1) + text(topic) + text(encoding) + text(''))
    file, spans, chunks = BytesIO(), [], []
    file.write(MCAP_MAGIC + record(1, text(profile) + text('')))

    def checksum(data):
        return crc32(data) if checksums else 0
    if not per_chunk:
        file.write(schema + channel)
    for first in range(0, len(messages), per_chunk or 1):
        part = slice(first, first + (per_chunk or 1))
        inside = b''.join(mcap_message(*one) for one in messages[part])
        start = file.tell()
        if per_chunk:
            inside = (schema + channel if first == 0 else b'') + inside
            times = messages[part][0][0], messages[part][-1][0]
            packed = COMPRESS[compression](inside)
            sizes = text(compression) + struct.pack('<Q', len(packed))
            file.write(record(6, struct.pack('<QQQI', *times, len(inside), checksum(inside)) +
                              sizes + packed))
            spans.append((start, file.tell(), part))
            end = file.tell()
            file.write(record(7, struct.pack('<HI', 1, 0)))
            chunks.append(record(8, struct.pack(
                '<QQQQIHQQ', *times, start, end - start, 10, 1, end, file.tell() - end) +
                sizes + struct.pack('<Q', len(inside))))
        else:
            file.write(inside)
            spans.append((start, file.tell(), part))
    file.write(record(15, bytes(4)))
    if index:
        statistics = struct.pack('<QHIIIIQQIHQ', len(messages), 1, 1, 0, 0, len(chunks),
                                 messages[0][0], messages[-1][0], 10, 1, len(messages))
        start = file.tell()
        summary = schema + channel + b''.join(chunks) + record(11, statistics)
        footer = b'\x02' + struct.pack('<QQQ', 20, start, 0)
        file.write(summary + footer + struct.pack('<I', checksum(summary + footer)) + MCAP_MAGIC)
    return Written(file.getvalue(), spans)


def mcap_message(received_ns, data):
    """Return the record of a message in channel 1."""
    return record(5, struct.pack('<HIQQ', 1, 0, received_ns, received_ns) + data)


def record(kind, content):
    """Return a record of an MCAP file."""
    return struct.pack('<BQ', kind, len(content)) + content


def text(value):
    """Return a string as MCAP has it."""
    return struct.pack('<I', len(value)) + value.encode()


def rosbag1(path, messages, compression=None, chunk_bytes=4000):
    """Write a ROS 1 bag; return what was Written, the chunks found by their headers."""
    types = get_typestore(Stores.ROS1_NOETIC)
    writer = Rosbag1Writer(path)
    writer.chunk_threshold = chunk_bytes
    if compression:
        writer.set_compression(Rosbag1Writer.CompressionFormat[compression.upper()])
    starts, counts = [], [0]
    write_chunk = writer.write_chunk

    def noting(chunk):
        starts.append(writer.bio.tell())
        write_chunk(chunk)
    writer.write_chunk = noting
    with writer:
        connection = writer.add_connection(IMAGE_TOPIC, COMPRESSED_IMAGE, typestore=types)
        for number, (received_ns, data) in enumerate(messages, 1):
            writer.write(connection, received_ns, data)
            if len(starts) == len(counts):
                counts.append(number)
    if counts[-1] < len(messages):
        counts.append(len(messages))
    data = path.read_bytes()
    sizes = [chunk_size(data, start) for start in starts]
    return Written(data, [(start, start + size, slice(*part)) for start, size, part in
                          zip(starts, sizes, zip(counts, counts[1:]))])


def chunk_size(data, start):
    """Return the size of the record of a ROS 1 bag that begins at ``start``."""
    content = start + 4 + struct.unpack_from('<I', data, start)[0]
    return content + 4 + struct.unpack_from('<I', data, content)[0] - start


def sqlite(path, messages):
    """Write a rosbag2 folder with SQLite storage; return its file."""
    types = get_typestore(Stores.ROS2_JAZZY)
    with Rosbag2Writer(path, version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        connection = writer.add_connection(IMAGE_TOPIC, COMPRESSED_IMAGE, typestore=types)
        for received_ns, data in messages:
            writer.write(connection, received_ns, data)
    return path / f'{path.name}.db3'


def overwritten(data, at, rng, count=8):
    """Return ``data`` with ``count`` bytes from ``at`` on changed, each to another value."""
    damaged = bytearray(data)
    for position in range(at, min(at + count, len(data))):
        damaged[position] ^= int(rng.integers(1, 256))
    return bytes(damaged)


def random_places(seed, size, count):
    """Return positions in a file: at random, and some near its ends, where the indices are."""
    rng = np.random.default_rng(seed)
    return rng, [*rng.integers(0, size, count).tolist(),
                 *rng.integers(0, 200, count // 8).tolist(),
                 *(size - rng.integers(1, 400, count // 8)).tolist()]
