# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""
Which eye, which part of the sphere and which projection a video's metadata say its pictures show.

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
from typing import NamedTuple

from sph_stab_ros.config import CUBEMAP, DUAL_FISHEYE, EQUI_ANGULAR_CUBEMAP, FISHEYE, VR180
from sph_stab_ros.geometry.layout import FRONT, Layout, LEFT_HALF, Part, TOP_HALF, WHOLE
from sph_stab_ros.recording.base import RecordingError
from sph_stab_ros.recording.spherical_boxes import (
    boxes, index_of, is_video, STSD_HEADER_BYTES, UUID)

# AVSphericalProjection.
EQUIRECTANGULAR, CUBE, TILE, HALF_EQUIRECTANGULAR = range(4)
OTHER_PROJECTIONS = {4: 'rectilinear', 5: 'fisheye', 6: 'parametric immersive'}
# AVStereo3DType and the flag that the right eye comes first.
MONO, SIDE_BY_SIDE, TOP_BOTTOM = 0, 1, 2
RIGHT_FIRST = 1
OTHER_PACKINGS = {3: 'alternate pictures', 4: 'a checkerboard', 5: 'a quincunx', 6: 'lines',
                  7: 'columns'}
SPHERICAL, STEREO = 'SPHERICAL', 'STEREO3D'
CROPPED = re.compile(rb'<GSpherical:(\w+)Pixels>\s*(\d+)\s*<')
NAMED = re.compile(rb'<GSpherical:ProjectionType>\s*([^<]*?)\s*<')
# In a sample entry of video, before its boxes.
VISUAL_SAMPLE_ENTRY_BYTES = 78
# In a box proj: a header, what FFmpeg knows, and what it knows the first layout of.
HEADER, EQUIRECTANGULAR_BOX, CUBE_BOX = b'prhd', b'equi', b'cbmp'
# By their names in boxes and in XML.
NAMES = {b'mshp': 'a mesh', b'ytmp': 'a mesh', b'cubemap': 'a cube map'}
READ_BY = {
    'a mesh': f"-p projection:={EQUI_ANGULAR_CUBEMAP} reads YouTube's cubes, -p layout:={VR180} "
    'its half spheres',
    'fisheye': f"-p projection:={FISHEYE} or {DUAL_FISHEYE} reads them, by the lenses' "
    'calibration in fisheye.*'}
ANYTHING_ELSE = '-p projection:=... or layout:=... says otherwise'
# Of an eye's picture: wider ones show a whole sphere where nothing is said.
MAX_HALF_SPHERE_ASPECT = 1.25


class InBoxes(NamedTuple):
    """
    What FFmpeg does not read of an MP4 file's metadata.

    Which part of the sphere version 1 says is shown, None where it does not; and which projection
    it is, where nobody has told FFmpeg of that, else nothing.
    """

    cropped: Part | None = None
    projection: str = ''


def layout_of(side_data: Mapping[str, bytes], size_wh: tuple[int, int],
              in_boxes: InBoxes = InBoxes()) -> Layout | None:
    """
    Return the Layout of pictures (width, height), None of a whole sphere or where nothing is said.

    ``side_data`` are FFmpeg's by their names, ``in_boxes`` is what boxes_say() returns.
    RecordingError, without the name of the recording, where the pictures are of a kind that is not
    read.
    """
    eye = _eye(side_data.get(STEREO))
    spherical = side_data.get(SPHERICAL)
    projection = in_boxes.projection or _other_projection(spherical)
    if projection == 'a cube map' and eye == WHOLE:
        return Layout(WHOLE, projection=CUBEMAP)
    if projection:
        eyes = '' if eye == WHOLE else ' for each of two eyes'
        raise RecordingError(
            f'its metadata say that the pictures are {projection}{eyes}, which is not read: '
            f'{READ_BY.get(projection, ANYTHING_ELSE)}')
    shown = _shown(spherical)
    if in_boxes.cropped is not None and shown == WHOLE:
        shown = in_boxes.cropped
    if shown is None:
        left, top, right, bottom = eye.edges_px(size_wh)
        is_half = eye != WHOLE and right - left < MAX_HALF_SPHERE_ASPECT * (bottom - top)
        shown = FRONT if is_half else WHOLE
    return None if eye == shown == WHOLE else Layout(eye, shown)


def boxes_say(path: Path) -> InBoxes:
    """Return what FFmpeg does not read of a file's metadata, nothing where it is no MP4 file."""
    try:
        with path.open('rb') as file:
            tracks = [track for track in inside(index_of(file), b'trak') if is_video(track)]
        xml = next((data[len(UUID):] for track in tracks for data in inside(track, b'uuid')
                    if data.startswith(UUID)), b'')
        in_boxes = next(filter(None, map(_projection_in_box, tracks)), '')
        return InBoxes(_cropped_area(xml), in_boxes or _projection_in_xml(xml))
    except (OSError, ValueError):
        return InBoxes()


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


def _projection_in_xml(xml: bytes) -> str:
    """Return which projection version 1 names, nothing where FFmpeg reads it."""
    found = NAMED.search(xml)
    return _named(found[1]) if found and found[1] != b'equirectangular' else ''


def _projection_in_box(track: bytes) -> str:
    """Return which projection a track is of, nothing where FFmpeg reads it."""
    for table in inside(track, b'mdia', b'minf', b'stbl', b'stsd'):
        for entry in boxes(table[STSD_HEADER_BYTES:]):
            data = table[STSD_HEADER_BYTES + entry.content:STSD_HEADER_BYTES + entry.end]
            for projection in inside(data[VISUAL_SAMPLE_ENTRY_BYTES:], b'sv3d', b'proj'):
                for box in boxes(projection):
                    if box.name == CUBE_BOX:
                        # Behind version and flags.
                        layout = projection[box.content + 4:box.content + 8]
                        return f'a cube map of another layout ({layout.hex()})' if any(
                            layout) else ''
                    if box.name not in (HEADER, EQUIRECTANGULAR_BOX):
                        return _named(box.name)
    return ''


def _named(name: bytes) -> str:
    """Return what to call a projection."""
    return NAMES.get(name, f"'{name.decode('latin-1')}'")


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


def _other_projection(spherical: bytes | None) -> str:
    """Return which projection FFmpeg says it is, nothing of an equirectangular one."""
    if spherical is None:
        return ''
    projection, = unpack_from('=i', spherical)
    if projection != CUBE:
        return OTHER_PROJECTIONS.get(projection, '')
    # Behind the angles and the four bounds.
    padding_px, = unpack_from('=I', spherical, 32)
    return f'a cube map with {padding_px} px of padding' if padding_px else 'a cube map'


def _shown(spherical: bytes | None) -> Part | None:
    """Return which part of the sphere an eye's picture shows, None where nothing is said."""
    if spherical is None:
        return None
    projection, = unpack_from('=i', spherical)
    if projection == HALF_EQUIRECTANGULAR:
        return FRONT
    if projection != TILE:
        return WHOLE
    # How far the edges are from those of the sphere.
    left, top, right, bottom = (edge / 2**32 for edge in unpack_from('=4I', spherical, 16))
    if left + right >= 1 or top + bottom >= 1:
        raise RecordingError('its metadata say that the pictures show no part of the sphere')
    return Part(left, top, 1 - right, 1 - bottom)
