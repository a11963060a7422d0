# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""One picture with its time, as it passes from the recordings and topics into the core."""

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from sph_stab_ros.geometry.arrays import Image
from sph_stab_ros.geometry.layout import Layout
from sph_stab_ros.images.codec import image_from_message, JPEG, whole_file
from sph_stab_ros.images.colour import Colour
from sph_stab_ros.images.jpeg import JpegFile
from sph_stab_ros.images.picture_time import PictureTime


class LazyPicture(Protocol):
    """A picture of which no more is decoded than is asked for, such as a JpegFile."""

    @property
    def size_wh(self) -> tuple[int, int]:
        """Width and height in pixels."""

    @property
    def image(self) -> Image:
        """Return the picture, decoded once; ImageError where it cannot be."""

    def at_least(self, width: int) -> Image:
        """Return the picture, or a smaller one, grey perhaps, that is as wide as this."""


@dataclass(frozen=True)
class Frame:
    """
    A picture of the sphere and when it was taken.

    ``source`` is the picture, (H, W, 3) uint8 in BGR order or (H, W) uint8, which is not written
    to, or the LazyPicture that holds it; which of its pixels shows what is the Projection's
    business, and whether its size fits the Stabilizer's. ``stamp_ns`` is the header's or the
    container's time; ``frame_id`` names the camera's frame. ``times`` is what a PictureClock made
    of the stamp; without, the stamp is taken as it is. ``layout`` is where the picture holds the
    sphere, as far as a recording says so, and ``colour`` what its values mean.
    """

    source: Image | LazyPicture
    stamp_ns: int
    frame_id: str = ''
    times: PictureTime | None = None
    layout: Layout | None = None
    colour: Colour | None = None

    @property
    def time_ns(self) -> int:
        """Return the time on the timeline of the pictures, in which no clock is set."""
        return self.stamp_ns if self.times is None else self.times.time_ns

    @property
    def clock_ns(self) -> int:
        """Return the time by the clock of the stamps, which an IMU's are of, too."""
        return self.stamp_ns if self.times is None else self.times.clock_ns

    @property
    def image(self) -> Image:
        """Return the picture, decoded when first asked for; ImageError where it cannot be."""
        return self.source if isinstance(self.source, np.ndarray) else self.source.image

    @property
    def size_wh(self) -> tuple[int, int]:
        """Width and height of the picture in pixels, which need not be decoded for that."""
        if isinstance(self.source, np.ndarray):
            height, width = self.source.shape[:2]
            return width, height
        return self.source.size_wh

    def load(self) -> None:
        """Decode the whole picture, which then serves ``at_least`` too."""
        self.image

    def at_least(self, width: int) -> Image:
        """Return the picture, or a smaller one, grey perhaps, that is as wide as this."""
        return (self.source if isinstance(self.source, np.ndarray)
                else self.source.at_least(width))


def frame_from_message(msg: Any, stamp_ns: int, frame_id: str = '',
                       times: PictureTime | None = None) -> Frame:
    """
    Return the Frame of an Image or CompressedImage message.

    A JPEG file is decoded later; what is not whole is refused at once, with ImageError.
    """
    if not hasattr(msg, 'encoding'):
        data, kind = whole_file(bytes(msg.data))
        if kind == JPEG:
            return Frame(JpegFile(data), stamp_ns, frame_id, times)
    return Frame(image_from_message(msg), stamp_ns, frame_id, times)
