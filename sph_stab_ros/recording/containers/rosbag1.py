# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""ROS 1 bags (http://wiki.ros.org/Bags/Format/2.0), with or without their index."""

from collections import Counter
from collections.abc import Collection, Iterator
import re
import struct

import numpy as np

from sph_stab_ros.geometry.conventions import NS_PER_S
from sph_stab_ros.recording.base import RecordingError
from sph_stab_ros.recording.containers.records import (
    Channel, Damaged, decompressed, DECOMPRESSORS, HEAD, Message, Record, RecordFile, ros2_name,
    Source, uint32, uint64)

MAGIC = b'#ROSBAG V2.0\n'
MESSAGE, HEADER, INDEX, CHUNK, CHUNK_INFO, CONNECTION = range(2, 8)
# The fields of each kind of record, and their sizes where these are fixed.
FIELDS: dict[int, dict[str, int | None]] = {
    MESSAGE: {'conn': 4, 'time': 8}, HEADER: {'index_pos': 8}, INDEX: {'conn': 4, 'count': 4},
    CHUNK: {'compression': None, 'size': 4}, CHUNK_INFO: {'chunk_pos': 8, 'count': 4},
    CONNECTION: {'conn': 4, 'topic': None}}
BYTES_PER_ENTRY = {INDEX: 12, CHUNK_INFO: 8}
OPERATION = re.compile(rb'\x04\0\0\0op=[\x02-\x07]')
OPERATION_BYTES, MOST_BEFORE_OPERATION = 8, 512


class Rosbag1File(RecordFile):
    """A ROS 1 bag, read front to back."""

    START, CHUNK, INNER = len(MAGIC), CHUNK, (MESSAGE, CONNECTION)

    def index(self) -> Counter[Channel] | None:
        """Return the counts in the index, or None where it is missing or contradicts itself."""
        with self.path.open('rb') as file:
            source = Source(file)
            header = self.record_at(source, self.START)
            if header is None or header.kind != HEADER:
                return None
            if header.fields.get('encryptor'):
                encryptor = header.fields['encryptor'].decode(errors='replace')
                raise RecordingError(
                    f'{self.path} is encrypted by {encryptor}: decrypt it with rosbag first')
            try:
                counts = self._read_index(source, uint64(header.fields['index_pos']))
            except (Damaged, LookupError, ValueError, struct.error):
                return None
        found: Counter[Channel] = Counter(dict.fromkeys(self.known.values(), 0))
        for number, count in counts.items():
            found[self.known[number]] += count
        return found

    def _read_index(self, source: Source, at: int) -> Counter[int]:
        """Return the counts by connection in the index that begins there; Damaged if wrong."""
        counts: Counter[int] = Counter()
        if not 0 < at < source.size:
            raise Damaged('no index')
        while at < source.size:
            record = self.record_at(source, at)
            if record is None:
                raise Damaged('no record')
            content = source.read(record.content, record.end - record.content)
            if record.kind == CONNECTION:
                self._define(record, content)
            elif record.kind == CHUNK_INFO:
                counts.update(dict(struct.iter_unpack('<II', content)))
            at = record.end
        if not counts.keys() <= self.known.keys():
            raise Damaged('chunks of unknown connections')
        return counts

    def scan(self, damage: list[str], topics: Collection[str] | None = None
             ) -> Iterator[Message]:
        """Yield the messages as they lie in the file."""
        index_at = 0
        with self.path.open('rb') as file:
            source = Source(file)
            for record in self.records(source, damage):
                try:
                    content = source.read(record.content, record.end - record.content)
                    if record.kind == HEADER:
                        index_at = uint64(record.fields['index_pos'])
                    elif record.kind == CHUNK:
                        if record.end > source.size:
                            damage.append('the last chunk is cut')
                        content = chunk_content(record, content, record.end > source.size)
                        for inside, start, end in inner_records(content):
                            source.count_record()
                            yield from self._take(
                                inside, content, start, end, topics, damage)
                    else:
                        yield from self._take(
                            record, content, 0, len(content), topics, damage)
                except (Damaged, LookupError, ValueError, struct.error) as error:
                    damage.append(f'the record before byte {record.end}: {error}')
            # A recorder that dies leaves the position of the index zero.
            if not 0 < index_at < source.size:
                damage.append('the index is missing')

    def _take(self, record: Record, content: bytes, start: int, end: int,
              topics: Collection[str] | None, damage: list[str]) -> Iterator[Message]:
        """Yield the message that a record holds, if it does; note what it defines."""
        if record.kind == MESSAGE:
            channel = self.known.get(uint32(record.fields['conn']))
            if channel is None:
                damage.append('a message of an unknown connection')
            elif topics is None or channel.topic in topics:
                seconds, nanoseconds = struct.unpack('<II', record.fields['time'])
                yield channel, seconds * NS_PER_S + nanoseconds, content[start:end]
        elif record.kind == CONNECTION:
            self._define(record, content[start:end])

    def _define(self, record: Record, content: bytes) -> None:
        """Note the channel that a connection record defines."""
        topic = re.sub('//+', '/', record.fields['topic'].decode())
        msgtype = ros2_name(fields_of(content)['type'].decode())
        self.known[uint32(record.fields['conn'])] = Channel(topic, msgtype, 'ros1')

    def record_at(self, source: Source, at: int) -> Record | None:
        """Return the record that begins at a position, or None where none does."""
        head = source.read(at, HEAD)
        try:
            record = parsed(head, 0)
        except (Damaged, LookupError, ValueError, struct.error):
            return None
        # Of a chunk that was cut the first part may still be read.
        if at + record.end > source.size and record.kind != CHUNK:
            return None
        return record._replace(content=at + record.content, end=at + record.end)

    def candidates(self, window: bytes) -> Iterator[int]:
        """Yield the positions at which a record might begin."""
        operations = np.array([match.start() for match in OPERATION.finditer(window)], int)
        if not len(operations):
            return
        # The length of the header is before it, and reaches beyond the first operation in it.
        values = np.frombuffer(window, np.uint8).astype(np.uint32)
        lengths = (values[:-3] | values[1:-2] << 8 | values[2:-1] << 16 | values[3:] << 24)
        at = np.flatnonzero(lengths < HEAD)
        following = np.searchsorted(operations, at + 4)
        at, following = at[following < len(operations)], following[following < len(operations)]
        begin = operations[following]
        yield from at[(begin - at <= MOST_BEFORE_OPERATION)
                      & (begin + OPERATION_BYTES - 4 <= at + lengths[at])].tolist()

    def is_sure(self, source: Source, record: Record) -> bool:
        """Tell whether what looks like a record surely is one: its fields all but prove it."""
        return record.kind != MESSAGE or uint32(record.fields['conn']) in self.known


def parsed(data: bytes, at: int) -> Record:
    """Return the record that begins at a position in ``data``; else raise, Damaged at best."""
    content = at + 8 + uint32(data, at)
    fields = fields_of(data[at + 4:content - 4])
    kind, = fields['op']
    for name, size in FIELDS[kind].items():
        if len(fields[name]) != size is not None:
            raise Damaged(f'{name} has {len(fields[name])} bytes')
    size = uint32(data, content - 4)
    if kind in BYTES_PER_ENTRY and size != BYTES_PER_ENTRY[kind] * uint32(fields['count']):
        raise Damaged('an index of a wrong size')
    if kind == CHUNK:
        compression = fields['compression'].decode()
        if compression != 'none' and compression not in DECOMPRESSORS:
            raise Damaged(f'compression {compression}')
        if compression == 'none' and size != uint32(fields['size']):
            raise Damaged('a chunk of two sizes')
    return Record(kind, content, content + size, fields)


def chunk_content(record: Record, data: bytes, cut: bool) -> bytes:
    """Return what a chunk holds, of one that was cut the first part; Damaged if it is wrong."""
    content = decompressed(
        data, record.fields['compression'].decode(), uint32(record.fields['size']))
    if not cut and len(content) != uint32(record.fields['size']):
        raise Damaged(f'a chunk holds {len(content)} bytes')
    return content


def inner_records(content: bytes) -> Iterator[tuple[Record, int, int]]:
    """Yield (record, start and end of its content) of the records in a chunk."""
    at = 0
    while at < len(content):
        record = parsed(content, at)
        if record.end > len(content):
            raise Damaged('a record is cut')
        yield record, record.content, record.end
        at = record.end


def fields_of(header: bytes) -> dict[str, bytes]:
    """Return the ``name=value`` fields of a header."""
    fields: dict[str, bytes] = {}
    at = 0
    while at < len(header):
        end = at + 4 + uint32(header, at)
        name, equals, value = header[at + 4:end].partition(b'=')
        if not equals or end > len(header):
            raise Damaged('a header without fields')
        fields[name.decode()] = value
        at = end
    return fields
