# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""
Bags whose index is missing, because the recorder died or the file was cut short.

All three formats are sequences that can be read front to back without their index: MCAP
(https://mcap.dev/spec), ROS 1 bags (http://wiki.ros.org/Bags/Format/2.0), and the SQLite files
of rosbag2, whose messages lie in the order of recording.
"""

from bz2 import BZ2Decompressor
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from io import BytesIO
from pathlib import Path
import sqlite3
import struct
import sys
from typing import Any, BinaryIO, NamedTuple, TypeAlias

from lz4.frame import LZ4FrameDecompressor

if sys.version_info >= (3, 14):
    from compression.zstd import ZstdDecompressor
else:
    from backports.zstd import ZstdDecompressor

from sph_stab_ros.geometry.conventions import NS_PER_S

# Decompressors that give what they can of a stream cut short.
DECOMPRESSORS: dict[str, Callable[[], Any]] = {
    'zstd': ZstdDecompressor, 'lz4': LZ4FrameDecompressor, 'bz2': BZ2Decompressor}


class Truncated(Exception):
    """The end of the file came before the end of its content."""


# What reading damaged content ends in; UnicodeDecodeError is a ValueError.
DAMAGE = (Truncated, sqlite3.DatabaseError, struct.error, LookupError, ValueError)


class Connection(NamedTuple):
    """What BagRecording needs to know of a topic."""

    topic: str
    msgtype: str
    msgcount: int


# Topic, type, time of receipt in ns, data.
Message: TypeAlias = tuple[str, str, int, bytes]


class SalvagedBag:
    """
    A stand-in for the readers of rosbags that needs no index, only more time.

    ``truncated`` tells, after the messages were read, whether a file ended too early.
    """

    def __init__(self, path: Path) -> None:
        self.truncated = False
        files = sorted(path.iterdir()) if path.is_dir() else [path]
        self._parts = [file for file in files if file.suffix in SCANNERS]
        counts = Counter((topic, msgtype) for topic, msgtype, _, _ in self._scan())
        self.connections = [Connection(*key, count) for key, count in counts.items()]

    def __enter__(self) -> 'SalvagedBag':
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def messages(
            self, connections: Sequence[Connection]) -> Iterator[tuple[Connection, int, bytes]]:
        """Yield (connection, time of receipt in ns, data) of the given connections."""
        wanted = {connection.topic: connection for connection in connections}
        for topic, _, received_ns, data in self._scan():
            if topic in wanted:
                yield wanted[topic], received_ns, data

    def _scan(self) -> Iterator[Message]:
        for part in self._parts:
            try:
                yield from SCANNERS[part.suffix](part)
            except DAMAGE:
                self.truncated = True


def scan_mcap(path: Path) -> Iterator[Message]:
    """Yield the messages of an MCAP file."""
    types: dict[int, str] = {}
    channels: dict[int, tuple[str, str]] = {}
    with path.open('rb') as file:
        if file.read(8) != b'\x89MCAP0\r\n':
            raise Truncated
        for opcode, record in mcap_records(file):
            if opcode == MCAP_SCHEMA:
                types[uint16(record)] = mcap_string(record, 2)[0]
            elif opcode == MCAP_CHANNEL:
                channels[uint16(record)] = mcap_string(record, 4)[0], types[uint16(record, 2)]
            elif opcode == MCAP_MESSAGE:
                yield *channels[uint16(record)], uint64(record, 6), record[22:]


MCAP_SCHEMA, MCAP_CHANNEL, MCAP_MESSAGE, MCAP_CHUNK, MCAP_DATA_END = 3, 4, 5, 6, 15


def mcap_records(stream: BinaryIO) -> Iterator[tuple[int, bytes]]:
    """Yield (opcode, content) of the records up to the end of the data, chunks opened."""
    while True:
        opcode, size = struct.unpack('<BQ', read_whole(stream, 9))
        if opcode == MCAP_DATA_END:
            return
        if opcode != MCAP_CHUNK:
            yield opcode, read_whole(stream, size)
            continue
        chunk = read_available(stream, size)
        if len(chunk) < 40:
            raise Truncated
        compression, start = mcap_string(chunk, 28)
        content = decompressed(chunk[start + 8:], compression)
        inside = BytesIO(content)
        while inside.tell() < len(content):
            opcode, size_inside = struct.unpack('<BQ', read_whole(inside, 9))
            yield opcode, read_whole(inside, size_inside)
        if len(chunk) < size:
            raise Truncated


def mcap_string(record: bytes, start: int) -> tuple[str, int]:
    """Return the string at ``start`` and the position behind it."""
    end = start + 4 + uint32(record, start)
    return record[start + 4:end].decode(), end


def scan_rosbag1(path: Path) -> Iterator[Message]:
    """Yield the messages of a ROS 1 bag."""
    connections: dict[bytes, tuple[str, str]] = {}
    with path.open('rb') as file:
        if file.readline(16) != b'#ROSBAG V2.0\n':
            raise Truncated
        index_position = 0
        for header, data in rosbag1_records(file):
            if header['op'] == ROSBAG1_HEADER:
                index_position = uint64(header['index_pos'])
            elif header['op'] == ROSBAG1_CONNECTION:
                msgtype = rosbag1_fields(data)['type'].decode().replace('/', '/msg/')
                connections[header['conn']] = header['topic'].decode(), msgtype
            elif header['op'] == ROSBAG1_MESSAGE:
                seconds, nanoseconds = struct.unpack('<II', header['time'])
                yield *connections[header['conn']], seconds * NS_PER_S + nanoseconds, data
        # A recorder that dies leaves the position of the index zero.
        if not 0 < index_position < file.tell():
            raise Truncated


ROSBAG1_MESSAGE, ROSBAG1_HEADER = b'\x02', b'\x03'
ROSBAG1_CHUNK, ROSBAG1_CONNECTION = b'\x05', b'\x07'


def rosbag1_records(stream: BinaryIO) -> Iterator[tuple[dict[str, bytes], bytes]]:
    """Yield (header fields, data) of all records, chunks opened, to the end of the stream."""
    while True:
        start = stream.read(4)
        if not start:
            return
        if len(start) < 4:
            raise Truncated
        header = rosbag1_fields(read_whole(stream, uint32(start)))
        size = uint32(read_whole(stream, 4))
        if header.get('op') != ROSBAG1_CHUNK:
            yield header, read_whole(stream, size)
            continue
        chunk = read_available(stream, size)
        yield from rosbag1_records(BytesIO(decompressed(chunk, header['compression'].decode())))
        if len(chunk) < size:
            raise Truncated


def rosbag1_fields(content: bytes) -> dict[str, bytes]:
    """Return the ``name=value`` fields of a header."""
    fields: dict[str, bytes] = {}
    position = 0
    while position < len(content):
        end = position + 4 + uint32(content, position)
        name, _, value = content[position + 4:end].partition(b'=')
        fields[name.decode()] = value
        position = end
    return fields


def scan_sqlite(path: Path) -> Iterator[Message]:
    """Yield the messages of a rosbag2 SQLite file."""
    database = sqlite3.connect(f'{path.absolute().as_uri()}?immutable=1', uri=True)
    try:
        # Without it SQLite refuses a file shorter than its header says.
        database.execute('PRAGMA writable_schema=ON')
        topics = {number: (topic, msgtype) for number, topic, msgtype in
                  database.execute('SELECT id, name, type FROM topics')}
        for number, received_ns, data in database.execute(
                'SELECT topic_id, timestamp, data FROM messages ORDER BY id'):
            yield *topics[number], received_ns, data
    finally:
        database.close()


SCANNERS = {'.mcap': scan_mcap, '.bag': scan_rosbag1, '.db3': scan_sqlite}


def decompressed(data: bytes, compression: str) -> bytes:
    """Return the content of a chunk, as far as it goes."""
    if compression in ('', 'none'):
        return data
    try:
        return DECOMPRESSORS[compression]().decompress(data)
    except Exception as error:
        raise Truncated from error


def read_available(stream: BinaryIO, size: int) -> bytes:
    """Return up to ``size`` bytes; a damaged size must not ask for more memory than there is."""
    position = stream.tell()
    left = stream.seek(0, 2) - position
    stream.seek(position)
    return stream.read(min(size, left))


def read_whole(stream: BinaryIO, size: int) -> bytes:
    """Return ``size`` bytes or raise Truncated."""
    data = read_available(stream, size)
    if len(data) < size:
        raise Truncated
    return data


def uint16(data: bytes, position: int = 0) -> int:
    """Return the little-endian number at ``position``."""
    return struct.unpack_from('<H', data, position)[0]


def uint32(data: bytes, position: int = 0) -> int:
    """Return the little-endian number at ``position``."""
    return struct.unpack_from('<I', data, position)[0]


def uint64(data: bytes, position: int = 0) -> int:
    """Return the little-endian number at ``position``."""
    return struct.unpack_from('<Q', data, position)[0]
