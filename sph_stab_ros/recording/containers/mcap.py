# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""
MCAP files (https://mcap.dev/spec) of any profile, chunked or not, with or without their index.

A chunk that contradicts its checksum is left out as a whole: which of its messages are right
cannot be known.
"""

from collections import Counter
from collections.abc import Collection, Iterator
import re
import struct
from zlib import crc32

from sph_stab_ros.recording.containers.records import (
    Channel, Damaged, decompressed, HEAD, Message, Record, RecordFile, ros2_name, Source, uint16,
    uint32, uint64)

MAGIC = b'\x89MCAP0\r\n'
FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK = 2, 3, 4, 5, 6
MESSAGE_INDEX, STATISTICS, DATA_END = 7, 11, 15
# The smallest content of each kind of record; the only one where it is fixed.
SMALLEST = {1: 8, SCHEMA: 14, CHANNEL: 16, MESSAGE: 22, CHUNK: 40, MESSAGE_INDEX: 6, 8: 64, 9: 36,
            10: 40, STATISTICS: 46, 12: 8, 13: 20}
FIXED = {FOOTER: 20, 14: 17, DATA_END: 4}
FOOTER_BYTES = 9 + FIXED[FOOTER] + len(MAGIC)
COMPRESSIONS = ('', 'lz4', 'zstd')
RECORD_HEAD = struct.Struct('<BQ')
MESSAGE_HEAD = struct.Struct('<HIQQ')
# Schema, channel, message or chunk, and a length below 2**40.
CANDIDATE = re.compile(rb'(?=[\x03-\x06].{5}\0\0\0)', re.DOTALL)
# Three days: what is found further from the last message is taken for something else.
NEAR_NS = 2**48


class McapFile(RecordFile):
    """An MCAP file, read front to back."""

    START, CHUNK, INNER = len(MAGIC), CHUNK, (SCHEMA, CHANNEL, MESSAGE)
    _last_ns: int | None = None

    def index(self) -> Counter[Channel] | None:
        """Return the counts in the summary section, or None where it cannot be trusted."""
        with self.path.open('rb') as file:
            source = Source(file)
            end = max(source.size - FOOTER_BYTES, 0)
            footer = source.read(end, FOOTER_BYTES)
            if len(footer) < FOOTER_BYTES or not footer.endswith(MAGIC) or footer[0] != FOOTER:
                return None
            start, checksum = uint64(footer, 9), uint32(footer, 25)
            if not 0 < start < end:
                return None
            summary = source.read(start, end - start)
        if checksum and crc32(summary + footer[:25]) != checksum:
            return None
        types: dict[int, str] = {}
        counts: Counter[Channel] | None = None
        try:
            for kind, start, end in inner_records(summary):
                self._define(kind, summary[start:end], types)
                if kind == STATISTICS:
                    counts = Counter({
                        self.known[channel]: count for channel, count in struct.iter_unpack(
                            '<HQ', summary[start + 46:end])})
        except (Damaged, LookupError, ValueError, struct.error):
            return None
        if counts is not None:
            # Also what has no messages.
            counts.update(dict.fromkeys(self.known.values(), 0))
        return counts

    def scan(self, damage: list[str], topics: Collection[str] | None = None
             ) -> Iterator[Message]:
        """Yield the messages as they lie in the file."""
        types: dict[int, str] = {}
        with self.path.open('rb') as file:
            source = Source(file)
            for record in self.records(source, damage):
                if record.kind == FOOTER and record.end + len(MAGIC) >= source.size:
                    return
                try:
                    if record.kind == CHUNK:
                        content = chunk_content(source, record, damage)
                        for kind, start, end in inner_records(content):
                            source.count_record()
                            yield from self._take(
                                kind, content, start, end, types, topics, damage)
                    elif record.kind in (SCHEMA, CHANNEL, MESSAGE):
                        content = source.read(record.content, record.end - record.content)
                        yield from self._take(
                            record.kind, content, 0, len(content), types, topics, damage)
                except (Damaged, LookupError, ValueError, struct.error) as error:
                    damage.append(f'the record before byte {record.end}: {error}')
        damage.append('the end is missing')

    def _take(self, kind: int, content: bytes, start: int, end: int, types: dict[int, str],
              topics: Collection[str] | None, damage: list[str]) -> Iterator[Message]:
        """Yield the message that a record holds, if it does; note what it defines."""
        if kind == MESSAGE:
            number, _, received_ns, _ = MESSAGE_HEAD.unpack_from(content, start)
            channel = self.known.get(number)
            if channel is None:
                damage.append(f'a message of an unknown channel {number}')
            else:
                self._last_ns = received_ns
            if channel is not None and (topics is None or channel.topic in topics):
                yield channel, received_ns, content[start + MESSAGE_HEAD.size:end]
        else:
            self._define(kind, content[start:end], types)

    def _define(self, kind: int, content: bytes, types: dict[int, str]) -> None:
        """Note the type or the channel that a record defines."""
        if kind == SCHEMA:
            types[uint16(content)] = ros2_name(string(content, 2)[0])
        elif kind == CHANNEL:
            topic, end = string(content, 4)
            self.known[uint16(content)] = Channel(
                topic, types.get(uint16(content, 2), ''), string(content, end)[0])

    def record_at(self, source: Source, at: int) -> Record | None:
        """Return the record that begins at a position, or None where none does."""
        head = source.read(at, 9)
        if len(head) < 9:
            return None
        kind, size = RECORD_HEAD.unpack(head)
        content, end = at + 9, at + 9 + size
        if not 1 <= kind <= 15 and kind < 0x80 or size < SMALLEST.get(kind, 0):
            return None
        if kind == CHUNK:
            # Of one that was cut the first part may still be read.
            return Record(kind, content, end) if is_chunk(
                source.read(content, 48), size) else None
        if end > source.size or size != FIXED.get(kind, size):
            return None
        if kind == MESSAGE_INDEX and uint32(source.read(content + 2, 4)) != size - 6:
            return None
        return Record(kind, content, end)

    def candidates(self, window: bytes) -> Iterator[int]:
        """Yield the positions at which a record might begin."""
        return (match.start() for match in CANDIDATE.finditer(window))

    def is_sure(self, source: Source, record: Record) -> bool:
        """Tell whether what looks like a record surely is one: more than its length fits."""
        if record.kind == CHUNK:
            return True
        if record.kind == MESSAGE:
            following = self.record_at(source, record.end)
            return self._is_expected(source, record) and following is not None and (
                following.kind != MESSAGE or self._is_expected(source, following))
        # Two names, and something else with its length before it.
        at = 2 if record.kind == SCHEMA else 4
        content = source.read(record.content, min(record.end - record.content, HEAD))
        try:
            for _ in range(2):
                _, at = string(content, at)
            return record.content + at + 4 + uint32(content, at) == record.end
        except (Damaged, UnicodeDecodeError, struct.error):
            return False

    def _is_expected(self, source: Source, record: Record) -> bool:
        """Tell whether a message is in a known channel and not far from those before."""
        number, _, received_ns, _ = MESSAGE_HEAD.unpack(
            source.read(record.content, MESSAGE_HEAD.size))
        return number in self.known and (
            self._last_ns is None or abs(received_ns - self._last_ns) < NEAR_NS)


def is_chunk(head: bytes, size: int) -> bool:
    """Tell whether the content of a record of this size begins like a chunk's."""
    try:
        compression, end = string(head, 28)
        return compression in COMPRESSIONS and uint64(head, end) == size - end - 8 and (
            compression != '' or uint64(head, end) == uint64(head, 16))
    except (Damaged, UnicodeDecodeError, struct.error):
        return False


def chunk_content(source: Source, record: Record, damage: list[str]) -> bytes:
    """Return what a chunk holds, of one that was cut the first part; Damaged if it is wrong."""
    size = record.end - record.content
    chunk = source.read(record.content, size)
    compression, start = string(chunk, 28)
    content = decompressed(chunk[start + 8:], compression, uint64(chunk, 16))
    if len(chunk) < size:
        damage.append('the last chunk is cut')
    elif len(content) != uint64(chunk, 16):
        raise Damaged(f'a chunk holds {len(content)} bytes')
    elif uint32(chunk, 24) and crc32(content) != uint32(chunk, 24):
        raise Damaged('a chunk contradicts its checksum')
    return content


def inner_records(content: bytes) -> Iterator[tuple[int, int, int]]:
    """Yield (kind, start and end of the content) of the records in a chunk."""
    at = 0
    while at < len(content):
        kind, size = RECORD_HEAD.unpack_from(content, at)
        start, at = at + 9, at + 9 + size
        if at > len(content):
            raise Damaged('a record is cut')
        if kind == 0:
            raise Damaged('no record')
        yield kind, start, at


def string(record: bytes, start: int) -> tuple[str, int]:
    """Return the string at ``start`` and the position behind it."""
    end = start + 4 + uint32(record, start)
    if end > len(record):
        raise Damaged('a string is cut')
    return record[start + 4:end].decode(), end
