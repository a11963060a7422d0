# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Find recordings in files and folders, by their content."""

from collections.abc import Iterator, Sequence
import os
from pathlib import Path
from typing import NamedTuple

from sph_stab_ros.recording import RecordingError
from sph_stab_ros.recording.containers import METADATA
from sph_stab_ros.recording.containers.kinds import kind_of

# First bytes of videos and where they stand.
VIDEOS = (
    (4, (b'ftyp', b'moov', b'mdat', b'wide')),    # MP4, QuickTime
    (0, (b'\x1a\x45\xdf\xa3',)),                  # Matroska, WebM
    (8, (b'AVI ',)),
    (0, (b'\x00\x00\x01\xba', b'FLV\x01')),       # MPEG program stream, Flash
)
TRANSPORT_PACKET_BYTES, TRANSPORT_SYNC = 188, b'G'
# What bears such a name is meant to be a recording: where it is none, that is to be said.
BAG_SUFFIXES = {'.bag', '.db3', '.mcap'}
COMPRESSED_SUFFIXES = {'.bz2', '.gz', '.lz4', '.xz', '.zst', '.zstd'}
VIDEO_SUFFIXES = {'.360', '.avi', '.insv', '.mjpeg', '.mkv', '.mov', '.mp4', '.webm'}


class Found(NamedTuple):
    """A recording, and the name of its result: its path relative to where it was found."""

    name: str
    path: Path


def find_recordings(inputs: Sequence[Path], out: Path) -> list[Found]:
    """
    Return the recordings that ``inputs`` are or, where they are folders, hold, but for ``out``.

    RecordingError where there are none, or two would have results of the same name.
    """
    found: dict[str, Found] = {}
    for one in inputs:
        if not os.path.lexists(one):
            raise RecordingError(f'{one} does not exist')
        root = one.absolute()
        searched = root.is_dir() and not is_bag_folder(root)
        for path in recordings_in(root, out) if searched else (root,):
            name = path.relative_to(root if searched else root.parent).as_posix()
            other = found.setdefault(name, Found(name, path))
            if other.path != path:
                raise RecordingError(f'{other.path} and {path} would have results of the same '
                                     'name: call batch for each, with another --out')
    if not found:
        raise RecordingError(f'no recording in {", ".join(map(str, inputs))}')
    return sorted(found.values())


def recordings_in(root: Path, out: Path) -> Iterator[Path]:
    """Yield the recordings below a folder, leaving out what is hidden."""
    unreadable: list[Path] = []
    for folder, names, files in os.walk(
            root, onerror=lambda error: unreadable.append(Path(error.filename))):
        here = Path(folder)
        if here.resolve() == out.resolve():
            names.clear()
        elif is_bag_folder(here):
            names.clear()
            yield here
        else:
            names[:] = [name for name in names if not name.startswith('.')]
            yield from (here / name for name in files
                        if not name.startswith('.') and is_meant(here / name))
    # To be read, they are refused by their names.
    yield from unreadable


def is_bag_folder(folder: Path) -> bool:
    """Tell whether a folder is one bag: it has metadata, or parts that bear the folder's name."""
    try:
        names = [path.name for path in folder.iterdir()]
    except OSError:
        return False
    return METADATA in names or any(
        name == folder.name + suffix or name.startswith(f'{folder.name}_0{suffix}')
        for name in names for suffix in ('.mcap', '.db3'))


def is_meant(path: Path) -> bool:
    """Tell whether a file is a recording by its content, or is called one."""
    suffixes = [suffix.lower() for suffix in path.suffixes]
    if suffixes and (suffixes[-1] in BAG_SUFFIXES | VIDEO_SUFFIXES or (
            suffixes[-1] in COMPRESSED_SUFFIXES and {*suffixes[:-1]} & BAG_SUFFIXES)):
        return True
    try:
        return path.is_file() and (kind_of(path) is not None or is_video(path))
    except OSError:
        return False


def is_video(path: Path) -> bool:
    """Tell whether a file begins as videos do."""
    with path.open('rb') as file:
        head = file.read(2 * TRANSPORT_PACKET_BYTES)
    return head[::TRANSPORT_PACKET_BYTES] == 2 * TRANSPORT_SYNC or any(
        head[at:].startswith(magics) for at, magics in VIDEOS)
