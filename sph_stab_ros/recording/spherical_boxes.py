# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""
Metadata that say that the pictures of an MP4 or MOV file are whole spheres.

Google's (github.com/google/spatial-media): version 1, XML in a uuid box of the track, and version
2, the boxes st3d and sv3d of the sample entry; players know the one or the other. FFmpeg writes
them only from what PyAV cannot set, so they are put into the index of a finished file.
"""

from collections.abc import Iterator
from pathlib import Path
import shutil
from struct import calcsize, pack, unpack_from
from typing import BinaryIO, NamedTuple

# Of version 1.
UUID = bytes.fromhex('ffcc8263f8554a938814587a02521fdd')
XML = (
    '<?xml version="1.0"?><rdf:SphericalVideo '
    'xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#" '
    'xmlns:GSpherical="http://ns.google.com/videos/1.0/spherical/">'
    '<GSpherical:Spherical>true</GSpherical:Spherical>'
    '<GSpherical:Stitched>true</GSpherical:Stitched>'
    '<GSpherical:StitchingSoftware>sph_stab_ros</GSpherical:StitchingSoftware>'
    '<GSpherical:ProjectionType>equirectangular</GSpherical:ProjectionType>'
    '</rdf:SphericalVideo>').encode()
# Boxes that hold nothing but boxes, on the way to what is changed.
CONTAINERS = (b'moov', b'trak', b'mdia', b'minf', b'stbl')
# Of files whose index is written last.
FIRST_BOXES = (b'ftyp', b'wide', b'mdat')
# In stsd, before the sample entries.
STSD_HEADER_BYTES = 8
# Where media lie: the formats of their offsets by the box that holds them.
OFFSETS = {b'stco': 'I', b'co64': 'Q'}
COPY_BYTES = 2**24


class Box(NamedTuple):
    """Where a box is in a file or in bytes, and where its content begins."""

    name: bytes
    start: int
    content: int
    end: int


def write_spherical(path: Path) -> None:
    """Say in an MP4 or MOV file that its pictures are spheres; ValueError where it is none."""
    with path.open('r+b') as file:
        found = {box.name: box for box in file_boxes(file)}
        moov = found.get(b'moov')
        if moov is None or b'moof' in found:
            raise ValueError('an index of the whole file is missing')
        file.seek(moov.start)
        index = file.read(moov.end - moov.start)
        edited = with_metadata(index)
        if UUID not in edited:
            raise ValueError('there is no video track')
        growth = len(edited) - len(index)
        if moov.end == file.seek(0, 2):
            file.seek(moov.start)
            file.write(edited)
            return
        # What lies behind the index moves.
        edited = with_metadata(index, moov.start, growth)
        shifted = path.with_name(path.name + '.shifted')
        with shifted.open('wb') as target:
            file.seek(0)
            copy(file, target, moov.start)
            target.write(edited)
            file.seek(moov.end)
            shutil.copyfileobj(file, target, COPY_BYTES)
    shifted.replace(path)


def with_metadata(data: bytes, index_start: int = 0, shift: int = 0) -> bytes:
    """
    Return boxes with the metadata in their video tracks.

    Media that lie behind ``index_start`` in the file are moved by ``shift``.
    """
    parts, end = [], 0
    for box in boxes(data):
        content, end = data[box.content:box.end], box.end
        if box.name in CONTAINERS:
            content = with_metadata(content, index_start, shift)
        if box.name == b'trak' and is_video(content):
            content = with_sample_entries(content) + packed(b'uuid', UUID + XML)
        elif box.name in OFFSETS:
            content = moved(content, OFFSETS[box.name], index_start, shift)
        parts.append(packed(box.name, content))
    return b''.join(parts) + data[end:]


def with_sample_entries(data: bytes) -> bytes:
    """Return boxes of a video track with version 2 of the metadata in their sample entries."""
    parts, end = [], 0
    for box in boxes(data):
        content, end = data[box.content:box.end], box.end
        if box.name in CONTAINERS:
            content = with_sample_entries(content)
        elif box.name == b'stsd':
            header, entries = content[:STSD_HEADER_BYTES], content[STSD_HEADER_BYTES:]
            content = header + b''.join(
                packed(entry.name, entries[entry.content:entry.end] + version_2())
                for entry in boxes(entries))
        parts.append(packed(box.name, content))
    return b''.join(parts) + data[end:]


def version_2() -> bytes:
    """Return the boxes that say: one eye, an upright sphere, all of it."""
    source = packed(b'svhd', bytes(4) + b'sph_stab_ros\0')
    # Version and flags, then yaw, pitch and roll, or how far which edges are from the sphere's.
    projection = packed(b'prhd', bytes(4 + 3 * 4)) + packed(b'equi', bytes(4 + 4 * 4))
    return (packed(b'st3d', bytes(4 + 1))
            + packed(b'sv3d', source + packed(b'proj', projection)))


def moved(content: bytes, kind: str, index_start: int, shift: int) -> bytes:
    """Return the content of a table of offsets of which those behind the index are moved."""
    count = int.from_bytes(content[4:8], 'big')
    layout = f'>{count}{kind}'
    if len(content) < 8 + calcsize(layout):
        raise ValueError('a table of offsets is cut short')
    offsets = [one + shift if one > index_start else one
               for one in unpack_from(layout, content, 8)]
    if kind == 'I' and max(offsets, default=0) >= 2**32:
        raise ValueError('the file is too large for its table of offsets')
    return content[:8] + pack(layout, *offsets) + content[8 + calcsize(layout):]


def is_video(track: bytes) -> bool:
    """Tell whether boxes of a track are of a video's."""
    media = next((track[box.content:box.end] for box in boxes(track) if box.name == b'mdia'), b'')
    # Behind version, flags and a field of zeros.
    return any(box.name == b'hdlr' and media[box.content + 8:box.content + 12] == b'vide'
               for box in boxes(media))


def boxes(data: bytes) -> Iterator[Box]:
    """Yield the boxes in bytes; ValueError where they are none."""
    start = 0
    # QuickTime may end a list by zeros.
    while start + 8 <= len(data) and any(data[start:start + 8]):
        yield (box := box_at(data[start:start + 16], start, len(data)))
        start = box.end


def is_without_index(path: Path) -> bool:
    """Tell whether a file is an MP4 or MOV file whose recorder did not live to write its index."""
    if not path.is_file():
        # What came through a pipe is gone; to open it again would wait for another writer.
        return False
    try:
        with path.open('rb') as file:
            if file.read(8)[4:] not in FIRST_BOXES:
                return False
            index_of(file)
    except ValueError:
        return True
    except OSError:
        pass
    return False


def index_of(file: BinaryIO) -> bytes:
    """Return the content of a file's box moov; ValueError where there is none."""
    for box in file_boxes(file):
        if box.name == b'moov':
            file.seek(box.content)
            return file.read(box.end - box.content)
    raise ValueError('there is no index')


def file_boxes(file: BinaryIO) -> Iterator[Box]:
    """Yield the outermost boxes of a file; ValueError where they are none."""
    start, end = 0, file.seek(0, 2)
    while start < end:
        file.seek(start)
        yield (box := box_at(file.read(16), start, end))
        start = box.end


def box_at(header: bytes, start: int, end: int) -> Box:
    """Return the Box that begins at ``start`` with these bytes, in what ends at ``end``."""
    if len(header) < 8:
        raise ValueError('a box is cut short')
    size, name = unpack_from('>I4s', header)
    content = start + 8
    if size == 1:
        if len(header) < 16:
            raise ValueError('a box is cut short')
        size, content = unpack_from('>Q', header, 8)[0], start + 16
    box = Box(name, start, content, start + size if size else end)
    if not box.content <= box.end <= end:
        raise ValueError(f'the size of a box {name!r} is wrong')
    return box


def packed(name: bytes, content: bytes) -> bytes:
    """Return a box."""
    return pack('>I4s', 8 + len(content), name) + content


def copy(source: BinaryIO, target: BinaryIO, count: int) -> None:
    """Copy so many bytes."""
    while count > 0 and (data := source.read(min(count, COPY_BYTES))):
        target.write(data)
        count -= len(data)
