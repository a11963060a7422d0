# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The size of the picture in a file, by its header, and whether it can be one of a camera."""

from struct import error, unpack_from

import numpy as np

from sph_stab_ros.images.image_error import ImageError

JPEG, PNG = 'JPEG', 'PNG'
START_OF_SCAN = b'\xff\xda'
# A sphere of 16384 columns; in BGR it takes 400 MB.
MOST_PIXELS = 2**27
# The picture in three channels, and the coefficients of a progressive JPEG file.
DECODING_BYTES_PER_PIXEL = 9
# Of a progressive file, each of which goes over the whole picture. Ten are usual.
MOST_SCANS = 200
PNG_SIGNATURE_BYTES = 8
# Of a chunk: its length and name before its data, and a checksum behind.
CHUNK_FRAME_BYTES = 12
LAST_CHUNK = b'IEND'
# Start of frame, of all kinds of coding; tables that share their range are none.
FRAME_HEADERS = {*range(0xc0, 0xd0)} - {0xc4, 0xc8, 0xcc}


def refuse_too_much(data: bytes, kind: str) -> None:
    """Raise ImageError where the picture in a file, JPEG or PNG, is beyond what cameras take."""
    width, height = size_of(data, kind)
    if width * height > MOST_PIXELS:
        raise ImageError('too large', f'the {kind} is said to be {width}x{height}')
    # The mark is nowhere else but in thumbnails.
    if kind == JPEG and data.count(START_OF_SCAN) > MOST_SCANS:
        raise ImageError(f'corrupt {JPEG}', f'more than {MOST_SCANS} scans')


def is_whole_png(data: bytes) -> bool:
    """
    Tell whether all chunks of a PNG file are there, up to the last one.

    OpenCV takes the memory that a chunk is said to need, up to 2 GB, before it reads it.
    """
    at, kind = PNG_SIGNATURE_BYTES, b''
    while kind != LAST_CHUNK and at + CHUNK_FRAME_BYTES <= len(data):
        length, kind = unpack_from('>I4s', data, at)
        at += length + CHUNK_FRAME_BYTES
    return kind == LAST_CHUNK and at <= len(data)


def require_memory(data: bytes, kind: str) -> None:
    """Raise MemoryError where there is too little to decode the picture in a file."""
    width, height = size_of(data, kind)
    # Nothing is written to it: that would take the memory.
    np.empty(width * height * DECODING_BYTES_PER_PIXEL, np.uint8)


def size_of(data: bytes, kind: str) -> tuple[int, int]:
    """Return width and height of the picture in a file, JPEG or PNG, by its header."""
    return jpeg_size(data) if kind == JPEG else png_size(data)


def jpeg_size(data: bytes) -> tuple[int, int]:
    """Return width and height from the frame header of a JPEG file (ITU-T T.81, B.2.2)."""
    # Behind the start of the image.
    at = 2
    try:
        while True:
            marker, length = unpack_from('>HH', data, at)
            if marker == 0xffff:
                # Any number of these may come before a marker.
                at += 1
            elif marker & 0xff in FRAME_HEADERS:
                height, width = unpack_from('>HH', data, at + 5)
                return width, height
            else:
                at += 2 + length
    except error:
        raise ImageError(f'corrupt {JPEG}', 'there is no frame header') from None


def png_size(data: bytes) -> tuple[int, int]:
    """Return width and height from the header of a PNG file."""
    try:
        width, height = unpack_from('>II', data, 16)
    except error:
        raise ImageError(f'corrupt {PNG}', 'there is no header') from None
    return width, height
