# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""
Whether a video's metadata say that the camera took its tilt out of the pictures.

Ricoh Theta cameras write into their MP4 files a box ``RMKN`` with the same EXIF structure as in
their photos, down to a flag *zenith correction applied* (Ricoh, theta-api-specs,
theta-metadata). Other programs drop it when they convert a video, and bags have no place for it:
where it is absent, nothing is known.
"""

from collections.abc import Iterable
from pathlib import Path
import struct
from typing import BinaryIO

EXIF_IFD, MAKER_NOTE, THETA_IFD, ZENITH_CORRECTION = 0x8769, 0x927C, 0x4001, 0x0007
MAKER_NOTE_HEADER = b'Ricoh\0\0\0'
# The boxes with metadata are small; a damaged size must not fill the memory.
MAX_EXIF_BYTES = 2**20


def tilt_removed_in_camera(path: Path) -> bool:
    """Tell whether an MP4 file says that its pictures are levelled already."""
    try:
        with path.open('rb') as file:
            exif = mp4_box(file, (b'moov', b'udta', b'RMKN'))
            return exif is not None and zenith_correction_applied(exif)
    except (OSError, struct.error):
        return False


def mp4_box(file: BinaryIO, names: Iterable[bytes]) -> bytes | None:
    """Return the content of the box found along ``names``, outermost first, or None."""
    end = file.seek(0, 2)
    file.seek(0)
    for name in names:
        box_end = find_box(file, name, end)
        if box_end is None:
            return None
        end = box_end
    return file.read(min(end - file.tell(), MAX_EXIF_BYTES))


def find_box(file: BinaryIO, wanted: bytes, end: int) -> int | None:
    """Go to the content of the next box of that name; return where it ends, or None."""
    while file.tell() + 8 <= end:
        start = file.tell()
        size, name = struct.unpack('>I4s', file.read(8))
        if size == 1:
            size, = struct.unpack('>Q', file.read(8))
        box_end = end if size == 0 else start + size
        if not file.tell() <= box_end <= end:
            return None
        if name == wanted:
            return box_end
        file.seek(box_end)
    return None


def zenith_correction_applied(exif: bytes) -> bool:
    """Tell whether EXIF data, from the TIFF header on, carry Ricoh's flag."""
    order = {b'II': '<', b'MM': '>'}.get(exif[:2])
    if order is None:
        return False

    def tags(position: int) -> dict[int, int]:
        """Return where the values of the tags of the directory at ``position`` are."""
        count, = struct.unpack_from(order + 'H', exif, position)
        entries = range(position + 2, position + 2 + 12 * count, 12)
        return {struct.unpack_from(order + 'H', exif, entry)[0]: entry + 8 for entry in entries}

    def offset_at(position: int) -> int:
        return struct.unpack_from(order + 'I', exif, position)[0]

    try:
        maker_note = offset_at(tags(offset_at(tags(offset_at(4))[EXIF_IFD]))[MAKER_NOTE])
        if exif[maker_note:maker_note + 8] != MAKER_NOTE_HEADER:
            return False
        theta = tags(offset_at(tags(maker_note + 8)[THETA_IFD]))
        flag, = struct.unpack_from(order + 'H', exif, theta[ZENITH_CORRECTION])
    except KeyError:
        return False
    return flag == 1
