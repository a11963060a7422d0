# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What the readers of the containers share: records found one behind the other, over damage."""

from abc import ABC, abstractmethod
from bz2 import BZ2Decompressor
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping
from pathlib import Path
import struct
import sys
from typing import Any, BinaryIO, ClassVar, NamedTuple, Protocol, TypeAlias

from lz4.frame import LZ4FrameDecompressor

if sys.version_info >= (3, 14):
    from compression.zstd import ZstdDecompressor
else:
    from backports.zstd import ZstdDecompressor

from sph_stab_ros.recording.containers.limits import (
    Damaged as Damaged, MOST_CUT_CHUNKS, READ_BESIDES, READ_FOR_EACH, RECORDS_BESIDES,
    RECORDS_FOR_EACH, unpacked)

# Decompressors that give what they can of a stream cut short.
DECOMPRESSORS: dict[str, Callable[[], Any]] = {
    'zstd': ZstdDecompressor, 'lz4': LZ4FrameDecompressor, 'bz2': BZ2Decompressor}
# How much is searched at once for the next record, and how long the head of one may be.
WINDOW, HEAD = 2**20, 2**12


class Channel(NamedTuple):
    """What is recorded of a topic: its type, as ROS 2 names it, and how messages are encoded."""

    topic: str
    msgtype: str
    encoding: str


# Time of receipt in ns, and the message as it is encoded.
Message: TypeAlias = tuple[Channel, int, bytes]


class Part(Protocol):
    """
    One file of a bag, read front to back.

    Its index, if any, only tells what there is; messages are found without it, so that a damaged
    index loses nothing and damaged content costs no more than itself.
    """

    path: Path

    def index(self) -> Counter[Channel] | None:
        """Return the number of messages of each channel, or None where that needs a scan."""

    def channels(self) -> Collection[Channel]:
        """Return the channels that have been met so far."""

    def scan(self, damage: list[str], topics: Collection[str] | None = None
             ) -> Iterator[Message]:
        """Yield the messages (of these topics) as recorded; add to ``damage`` what is broken."""


class Source:
    """The bytes of a file by their position."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self.size = file.seek(0, 2)
        self._left = READ_FOR_EACH * self.size + READ_BESIDES
        self._records_left = RECORDS_FOR_EACH * self.size + RECORDS_BESIDES
        self._cut_chunks_left = MOST_CUT_CHUNKS

    @property
    def is_exhausted(self) -> bool:
        """Tell whether more was read than any search for records should need."""
        return self._left < 0 or self._cut_chunks_left < 0

    def count_record(self) -> None:
        """Count a record within a chunk; Damaged where there are more than any file has."""
        self._records_left -= 1
        if self._records_left < 0:
            raise Damaged('too many records')

    def count_cut_chunk(self) -> None:
        """Count a chunk that reaches beyond the end."""
        self._cut_chunks_left -= 1

    def read(self, at: int, count: int) -> bytes:
        """Return ``count`` bytes, or as many as there are."""
        self._left -= count if at + count <= self.size else max(self.size - at, 0)
        self._file.seek(at)
        # A damaged count must not ask for more memory than there is.
        return self._file.read(max(min(count, self.size - at), 0))


class Record(NamedTuple):
    """
    Where a record's content lies; ``end`` is beyond the file's where that was cut.

    ``fields`` is what its header has besides.
    """

    kind: int
    content: int
    end: int
    fields: Mapping[str, bytes] = {}


class RecordFile(ABC):
    """A file that is a sequence of records: what it takes to go on behind a damaged one."""

    # Where the first record begins, which kind holds others, and which kinds can be in those.
    START: ClassVar[int]
    CHUNK: ClassVar[int]
    INNER: ClassVar[Collection[int]]

    def __init__(self, path: Path) -> None:
        self.path = path
        self.known: dict[int, Channel] = {}

    def channels(self) -> Collection[Channel]:
        """Return the channels that have been met so far."""
        return self.known.values()

    @abstractmethod
    def record_at(self, source: Source, at: int) -> Record | None:
        """Return the record that begins at a position, or None where none does."""

    @abstractmethod
    def candidates(self, window: bytes) -> Iterator[int]:
        """Yield the positions at which a record might begin."""

    @abstractmethod
    def is_sure(self, source: Source, record: Record) -> bool:
        """Tell whether what looks like a record, in the midst of anything, surely is one."""

    def records(self, source: Source, damage: list[str]) -> Iterator[Record]:
        """Yield all records; where there is none the next one is searched for."""
        at, search_from, in_chunk = self.START, self.START + 1, False
        while at < source.size:
            if source.is_exhausted:
                damage.append(f'the rest from byte {at} on makes no sense')
                return
            record = self.record_at(source, at)
            if record is None:
                damage.append(f'no record at byte {at}')
                found = self._next_record(source, search_from, in_chunk)
                if found is None:
                    return
                at, search_from, in_chunk = found, found + 1, False
                continue
            yield record
            # Where no record follows, something may be missing from this one.
            at, search_from, in_chunk = record.end, record.content, record.kind == self.CHUNK
            if at > source.size:
                source.count_cut_chunk()
                at = self._next_record(source, search_from, in_chunk) or at

    def _next_record(self, source: Source, at: int, in_chunk: bool) -> int | None:
        """Return where the next record begins, from ``at`` on; none that is in a chunk."""
        while at < source.size:
            window = source.read(at, WINDOW + HEAD)
            for offset in self.candidates(window):
                if offset >= WINDOW:
                    continue
                if source.is_exhausted:
                    return None
                record = self.record_at(source, at + offset)
                if record is not None and not (in_chunk and record.kind in self.INNER
                                               ) and self.is_sure(source, record):
                    return at + offset
            at += WINDOW
        return None


def decompressed(data: bytes, compression: str, size: int) -> bytes:
    """
    Return the content of a chunk, which has ``size`` bytes, as far as it goes where it was cut.

    Damaged where that is something else.
    """
    if compression in ('', 'none'):
        return data
    try:
        return unpacked(DECOMPRESSORS[compression](), data, size)
    # Each library has exceptions of its own.
    except Exception as error:
        raise Damaged(f'{compression}: {error}') from None


def ros2_name(msgtype: str) -> str:
    """Return the name of a type as ROS 2 has it."""
    if msgtype == 'tf/tfMessage':
        # What it was called before tf2.
        return 'tf2_msgs/msg/TFMessage'
    return msgtype.replace('/', '/msg/') if msgtype.count('/') == 1 else msgtype


def uint16(data: bytes, position: int = 0) -> int:
    """Return the little-endian number at ``position``."""
    return struct.unpack_from('<H', data, position)[0]


def uint32(data: bytes, position: int = 0) -> int:
    """Return the little-endian number at ``position``."""
    return struct.unpack_from('<I', data, position)[0]


def uint64(data: bytes, position: int = 0) -> int:
    """Return the little-endian number at ``position``."""
    return struct.unpack_from('<Q', data, position)[0]
