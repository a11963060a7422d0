# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""A Frame that is a JPEG file: only as much of it is decoded as somebody asks for."""

from struct import error, unpack_from

import cv2

from sph_stab_ros.images.codec import (
    decoded, image_from_message, ImageError, JPEG, kind_of_whole_file)
from sph_stab_ros.images.frame import Frame

# By how much a decoder can reduce on the way, which leaves out most of its work.
REDUCED_GREY = {
    8: cv2.IMREAD_REDUCED_GRAYSCALE_8, 4: cv2.IMREAD_REDUCED_GRAYSCALE_4,
    2: cv2.IMREAD_REDUCED_GRAYSCALE_2, 1: cv2.IMREAD_GRAYSCALE}
# Start of frame, of all kinds of coding; tables that share their range are none.
FRAME_HEADERS = {*range(0xc0, 0xd0)} - {0xc4, 0xc8, 0xcc}


class JpegFrame:
    """
    A Frame whose image is decoded when it is asked for, and less of it for tracking.

    At 1920 columns a grey picture of 960 takes 3 ms where one in colour, made grey and smaller,
    takes 8.

    Parameters
    ----------
    data : bytes
        A JPEG file; ImageError where it is no whole one.
    stamp_ns, frame_id, times
        As Frame's.

    """

    def __init__(self, data, stamp_ns, frame_id='', times=None):
        self._data = data
        self.stamp_ns, self.frame_id, self.times = stamp_ns, frame_id, times
        self.time_ns = times.time_ns if times else stamp_ns
        self.clock_ns = times.clock_ns if times else stamp_ns
        self.size_wh = jpeg_size(data)
        self._image = None

    @property
    def image(self):
        """Return the whole picture, (H, W, 3) uint8 in BGR order or (H, W)."""
        if self._image is None:
            self._image = decoded(self._data, JPEG)
        return self._image

    def load(self):
        """Decode the whole picture, which then serves ``at_least`` too."""
        self.image

    def at_least(self, width):
        """Return the picture, a smaller and grey one where nobody wanted the whole so far."""
        if self._image is not None:
            return self._image
        reduction = next(
            (one for one in REDUCED_GREY if self.size_wh[0] >= one * width), 1)
        return decoded(self._data, JPEG, REDUCED_GREY[reduction])


def jpeg_size(data):
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


def frame_from_message(msg, stamp_ns, frame_id='', times=None):
    """Return the Frame, or JpegFrame, of an Image or CompressedImage message."""
    if not hasattr(msg, 'encoding'):
        data = bytes(msg.data)
        if kind_of_whole_file(data) == JPEG:
            return JpegFrame(data, stamp_ns, frame_id, times)
    return Frame(image_from_message(msg), stamp_ns, frame_id, times)
