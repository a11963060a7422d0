# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Which container a file is, by its first bytes, whatever its name."""

from bz2 import BZ2Decompressor
from collections.abc import Callable
from lzma import LZMADecompressor
from pathlib import Path
from typing import Any, TypeAlias
import zlib

from sph_stab_ros.recording.base import RecordingError
from sph_stab_ros.recording.containers import mcap, rosbag1, sqlite
from sph_stab_ros.recording.containers.mcap import McapFile
from sph_stab_ros.recording.containers.records import DECOMPRESSORS
from sph_stab_ros.recording.containers.rosbag1 import Rosbag1File
from sph_stab_ros.recording.containers.sqlite import SqliteFile

Kind: TypeAlias = type[McapFile] | type[Rosbag1File] | type[SqliteFile]

KINDS: dict[bytes, Kind] = {
    mcap.MAGIC: McapFile, rosbag1.MAGIC: Rosbag1File, sqlite.MAGIC: SqliteFile}
# Where the first bytes are damaged, the name is all there is.
SUFFIXES: dict[str, Kind] = {'.mcap': McapFile, '.bag': Rosbag1File, '.db3': SqliteFile}


class Gunzip:
    """What unpacks gzip, as the other decompressors do it."""

    def __init__(self) -> None:
        self._stream = zlib.decompressobj(zlib.MAX_WBITS | 16)

    def decompress(self, data: bytes, max_length: int = -1) -> bytes:
        """Return what comes of more data, and of those before that were too much."""
        return self._stream.decompress(self._stream.unconsumed_tail + data, max(max_length, 0))

    @property
    def needs_input(self) -> bool:
        """Tell whether all data so far are unpacked."""
        return not self._stream.unconsumed_tail

    @property
    def eof(self) -> bool:
        """Tell whether the end is reached."""
        return self._stream.eof

    @property
    def unused_data(self) -> bytes:
        """Return what is behind the end."""
        return self._stream.unused_data


ZSTD = b'\x28\xb5\x2f\xfd'
COMPRESSED: dict[bytes, Callable[[], Any]] = {
    ZSTD: DECOMPRESSORS['zstd'],
    b'\x04\x22\x4d\x18': DECOMPRESSORS['lz4'],
    b'\x1f\x8b': Gunzip,
    b'BZh': BZ2Decompressor,
    b'\xfd7zXZ\0': LZMADecompressor,
}

# What people take for recordings, or what became of them.
REFUSED = {
    b'PK\x03\x04': 'a ZIP archive: unpack it first',
    b'7z\xbc\xaf\x27\x1c': 'a 7z archive: unpack it first',
    b'Rar!': 'a RAR archive: unpack it first',
    b'#ROSBAG V1': 'a bag of a ROS before 2010: convert it with "rosbag fix"',
    b'version https://git-lfs': 'a pointer of Git LFS: fetch the file with "git lfs pull"',
    b'rosbag2_bagfile_information': 'the metadata of a bag: give its folder',
    b'<!DOCTYPE': 'a web page: the download went wrong',
    b'<html': 'a web page: the download went wrong',
    b'-----BEGIN PGP': 'encrypted: decrypt it first',
    b'age-encryption.org': 'encrypted: decrypt it first',
    b'Salted__': 'encrypted: decrypt it first',
    b'LUKS\xba\xbe': 'encrypted: decrypt it first',
    bytes(512): 'nothing but zeros at its start: it was never written to the disk',
}
# Of the flags of an extended WebP.
WEBP_ANIMATED = 2
FIRST_BYTES = 2**12
# Nothing comes out of bzip2 before a whole block of up to 900 kB has gone in.
COMPRESSED_BLOCK_BYTES = 2**20


def decompressor_of(head: bytes) -> Callable[[], Any] | None:
    """Return what unpacks a file that begins like this, or None where it is not compressed."""
    return next((make for magic, make in COMPRESSED.items() if head.startswith(magic)), None)


def kind_of(path: Path) -> Kind | None:
    """Return the kind of bag that a file is, compressed as a whole perhaps, or None."""
    with path.open('rb') as file:
        head = file.read(FIRST_BYTES)
        make = decompressor_of(head)
        if make is not None:
            try:
                head = make().decompress(
                    head + file.read(COMPRESSED_BLOCK_BYTES), FIRST_BYTES)
            # Each library has exceptions of its own.
            except Exception:
                return None
        end = file.seek(0, 2)
        file.seek(max(end - len(mcap.MAGIC), 0))
        tail = file.read()
    for magic, kind in KINDS.items():
        if head.startswith(magic):
            return kind
    if not head or refusal(head) or make is not None:
        return None
    if tail == mcap.MAGIC:
        return McapFile
    return next((SUFFIXES[suffix] for suffix in path.suffixes if suffix in SUFFIXES), None)


def refusal(head: bytes) -> str | None:
    """Return what a file is that begins like this, where that is known to be no recording."""
    if not head:
        return 'empty'
    if head[257:262] == b'ustar':
        return 'a tar archive: unpack it first'
    if head[8:16] == b'WEBPVP8X' and head[20:21] and head[20] & WEBP_ANIMATED:
        return 'an animated WebP, which FFmpeg does not read: make it a GIF or a video first'
    return next((what for magic, what in REFUSED.items() if head.startswith(magic)), None)


def refuse_if_known(path: Path) -> None:
    """Raise RecordingError where a file is known to be no recording, in a line that says why."""
    with path.open('rb') as file:
        head = file.read(FIRST_BYTES)
    what = refusal(head)
    if what is None and decompressor_of(head):
        what = 'compressed, but not a bag: unpack it first'
    if what is not None:
        raise RecordingError(f'{path} is not a readable recording: it is {what}')
