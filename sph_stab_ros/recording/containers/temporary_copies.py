# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
"""
Files that cannot be read in place, as copies in a temporary folder.

Whatever SQLite would write while it takes in a write-ahead log is written there, so that the
recording itself stays as it is, on read-only media too.
"""

from contextlib import closing
from pathlib import Path
import shutil
import sqlite3
import tempfile
from typing import Any
import weakref

from sph_stab_ros.recording.base import RecordingError
from sph_stab_ros.recording.containers.kinds import decompressor_of, FIRST_BYTES

SIDECARS = '-wal', '-journal'
LONGEST_MAGIC = 6
BLOCK_BYTES, PIECE_BYTES = 2**16, 2**24


class Copies:
    """A temporary folder, made when it is needed and gone with this object."""

    def __init__(self) -> None:
        self._folder: Path | None = None

    def readable(self, path: Path, damage: list[str]) -> Path:
        """Return ``path``, or a copy of it that is unpacked and without a log beside it."""
        with path.open('rb') as file:
            compressed = decompressor_of(file.read(FIRST_BYTES)) is not None
        sidecars = [path.with_name(path.name + suffix) for suffix in SIDECARS]
        sidecars = [one for one in sidecars if one.is_file() and one.stat().st_size]
        if not (compressed or sidecars):
            return path
        if self._folder is None:
            self._folder = Path(tempfile.mkdtemp(prefix='sph_stab_ros_'))
            weakref.finalize(self, shutil.rmtree, self._folder, ignore_errors=True)
        copy = self._folder / path.name
        try:
            if compressed:
                unpack(path, copy, damage)
            else:
                for one in (path, *sidecars):
                    shutil.copyfile(one, self._folder / one.name)
                take_in_log(copy)
        except OSError as error:
            raise RecordingError(f'{path} cannot be copied into {self._folder} to be read: '
                                 f'{error.strerror}') from None
        return copy


def unpack(path: Path, target: Path, damage: list[str]) -> None:
    """Write what a compressed file holds, as far as it goes; streams may follow each other."""
    with path.open('rb') as packed, target.open('wb') as unpacked:
        stream: Any = None
        block = packed.read(BLOCK_BYTES)
        while block:
            if stream is None or stream.eof:
                make = decompressor_of(block)
                if make is None:
                    # What pads the file.
                    return
                stream = make()
            try:
                # In pieces: what was made to mislead becomes a thousand times as large.
                unpacked.write(stream.decompress(block, PIECE_BYTES))
                while not (stream.needs_input or stream.eof):
                    unpacked.write(stream.decompress(b'', PIECE_BYTES))
            except OSError:
                raise
            # Each library has exceptions of its own.
            except Exception as error:
                damage.append(f'{path.name}: {error}')
                return
            block = (stream.eof and stream.unused_data) or b''
            if len(block) < LONGEST_MAGIC:
                block += packed.read(BLOCK_BYTES)
        if not stream.eof:
            damage.append(f'{path.name}: the compressed data end too early')


def take_in_log(database: Path) -> None:
    """Let SQLite take what a recorder left in a log into the database itself."""
    try:
        with closing(sqlite3.connect(database)) as connection:
            connection.execute('SELECT count(*) FROM sqlite_master').fetchall()
            connection.execute('PRAGMA wal_checkpoint(TRUNCATE)')
    except sqlite3.DatabaseError:
        # What is damaged is found out when it is read.
        pass
