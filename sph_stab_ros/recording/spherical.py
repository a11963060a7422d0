# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""
Which eye and which part of the sphere a video's metadata say its pictures show.

FFmpeg reads them: Google's spherical metadata, version 1 (XML in a uuid box of MP4 files) and
version 2 (boxes st3d and sv3d), those of Matroska, and the frame packing of H.264 and H.265. It
hands them on beside each picture as its structs AVSphericalMapping and AVStereo3D, the beginnings
of which are the same in all its versions. What it does not read is looked for here: the cropped
area of version 1, and that there is a projection of another name.
"""

from collections.abc import Iterator, Mapping
from pathlib import Path
import re
from struct import unpack_from

from sph_stab_ros.geometry.layout import FRONT, Layout, LEFT_HALF, Part, TOP_HALF, WHOLE
from sph_stab_ros.recording.base import RecordingError
from sph_stab_ros.recording.spherical_boxes import (
    boxes, index_of, is_video, STSD_HEADER_BYTES, UUID)

# AVSphericalProjection.
EQUIRECTANGULAR, TILE, HALF_EQUIRECTANGULAR = 0, 2, 3
OTHER_PROJECTIONS = {1: 'a cube map', 4: 'rectilinear', 5: 'fisheye', 6: 'parametric immersive'}
# AVStereo3DType and the flag that the right eye comes first.
MONO, SIDE_BY_SIDE, TOP_BOTTOM = 0, 1, 2
RIGHT_FIRST = 1
OTHER_PACKINGS = {3: 'alternate pictures', 4: 'a checkerboard', 5: 'a quincunx', 6: 'lines',
                  7: 'columns'}
SPHERICAL, STEREO = 'SPHERICAL', 'STEREO3D'
CROPPED = re.compile(rb'<GSpherical:(\w+)Pixels>\s*(\d+)\s*<')
# In a sample entry of video, before its boxes.
VISUAL_SAMPLE_ENTRY_BYTES = 78
# In a box proj: a header, and what FFmpeg knows.
READ_PROJECTIONS = (b'prhd', b'equi', b'cbmp')
UNREAD_PROJECTIONS = {b'mshp': 'a mesh'}
# Of an eye's picture: wider ones show a whole sphere where nothing is said.
MAX_HALF_SPHERE_ASPECT = 1.25


def layout_of(side_data: Mapping[str, bytes], size_wh: tuple[int, int],
              cropped: Part | None = None) -> Layout | None:
    """
    Return the Layout of pictures (width, height), None of a whole sphere or where nothing is said.

    ``side_data`` are FFmpeg's by their names, ``cropped`` is what boxes_say() returns.
    RecordingError, without the name of the recording, where the pictures are of a kind that is not
    read.
    """
    eye = _eye(side_data.get(STEREO))
    shown = _shown(side_data.get(SPHERICAL))
    if cropped is not None and shown == WHOLE:
        shown = cropped
    if shown is None:
        left, top, right, bottom = eye.edges_px(size_wh)
        is_half = eye != WHOLE and right - left < MAX_HALF_SPHERE_ASPECT * (bottom - top)
        shown = FRONT if is_half else WHOLE
    return None if eye == shown == WHOLE else Layout(eye, shown)


def boxes_say(path: Path) -> tuple[Part | None, str]:
    """
    Return what FFmpeg does not read of an MP4 file's metadata.

    That is which part of the sphere version 1 says is shown, None where it does not, and the name
    of version 2's projection where it is one that nobody has told FFmpeg of.
    """
    try:
        with path.open('rb') as file:
            tracks = [track for track in inside(index_of(file), b'trak') if is_video(track)]
        return (next(map(_cropped_area, (data[len(UUID):] for track in tracks
                                         for data in inside(track, b'uuid')
                                         if data.startswith(UUID))), None),
                next(filter(None, map(_unread_projection, tracks)), ''))
    except (OSError, ValueError):
        return None, ''


def _cropped_area(xml: bytes) -> Part | None:
    number = {name: int(value) for name, value in CROPPED.findall(xml)}
    try:
        width, height = number[b'FullPanoWidth'], number[b'FullPanoHeight']
        left, top = number[b'CroppedAreaLeft'], number[b'CroppedAreaTop']
        part = Part(left / width, top / height,
                    (left + number[b'CroppedAreaImageWidth']) / width,
                    (top + number[b'CroppedAreaImageHeight']) / height)
    except (KeyError, ZeroDivisionError):
        return None
    return part if part.left < part.right <= 1 and part.top < part.bottom <= 1 else None


def _unread_projection(track: bytes) -> str:
    """Return the name of a track's projection that is not read, else nothing."""
    for table in inside(track, b'mdia', b'minf', b'stbl', b'stsd'):
        for entry in boxes(table[STSD_HEADER_BYTES:]):
            data = table[STSD_HEADER_BYTES + entry.content:STSD_HEADER_BYTES + entry.end]
            for projection in inside(data[VISUAL_SAMPLE_ENTRY_BYTES:], b'sv3d', b'proj'):
                for box in boxes(projection):
                    if box.name not in READ_PROJECTIONS:
                        return UNREAD_PROJECTIONS.get(box.name, f"'{box.name.decode('latin-1')}'")
    return ''


def inside(data: bytes, *names: bytes) -> Iterator[bytes]:
    """Yield the contents of boxes along a path of names; ValueError where they are none."""
    if not names:
        yield data
        return
    for box in boxes(data):
        if box.name == names[0]:
            yield from inside(data[box.content:box.end], *names[1:])


def _eye(stereo: bytes | None) -> Part:
    """Return which part of the pictures is the left eye's."""
    packing, flags = (MONO, 0) if stereo is None else unpack_from('=ii', stereo)
    if packing in OTHER_PACKINGS:
        raise RecordingError(
            f'its metadata say that two eyes share {OTHER_PACKINGS[packing]}, which is not read')
    if packing == SIDE_BY_SIDE:
        return Part(.5, 0., 1., 1.) if flags & RIGHT_FIRST else LEFT_HALF
    if packing == TOP_BOTTOM:
        return Part(0., .5, 1., 1.) if flags & RIGHT_FIRST else TOP_HALF
    return WHOLE


def _shown(spherical: bytes | None) -> Part | None:
    """Return which part of the sphere an eye's picture shows, None where nothing is said."""
    if spherical is None:
        return None
    projection, *_ = unpack_from('=4i', spherical)
    if projection in OTHER_PROJECTIONS:
        raise RecordingError(f'its metadata say that the pictures are '
                             f'{OTHER_PROJECTIONS[projection]}, which is not read')
    if projection == HALF_EQUIRECTANGULAR:
        return FRONT
    if projection != TILE:
        return WHOLE
    # How far the edges are from those of the sphere.
    left, top, right, bottom = (edge / 2**32 for edge in unpack_from('=4I', spherical, 16))
    if left + right >= 1 or top + bottom >= 1:
        raise RecordingError('its metadata say that the pictures show no part of the sphere')
    return Part(left, top, 1 - right, 1 - bottom)
