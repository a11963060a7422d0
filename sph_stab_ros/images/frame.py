# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""One picture with its time, as it passes from the recordings and topics into the core."""

from dataclasses import dataclass
from typing import Any, Protocol, TypeAlias

import numpy as np

from sph_stab_ros.geometry.arrays import Grey, Image, Raster
from sph_stab_ros.geometry.layout import Layout
from sph_stab_ros.geometry.projection import to_grey
from sph_stab_ros.images.codec import decoded, file_in, is_raw, JPEG
from sph_stab_ros.images.colour import Colour
from sph_stab_ros.images.jpeg_file import JpegFile
from sph_stab_ros.images.picture_time import PictureTime
from sph_stab_ros.images.raw import image_from_raw


class LazyPicture(Protocol):
    """A picture of which no more is decoded than is asked for, such as a JpegFile."""

    @property
    def size_wh(self) -> tuple[int, int]:
        """Width and height in pixels."""

    @property
    def image(self) -> Image:
        """Return the picture, decoded once; ImageError where it cannot be."""

    def grey(self, width: int = 0) -> Grey:
        """Return the picture in grey; a smaller one, at least as wide as this, costs less."""


# A picture, or what one is made of when it is asked for.
PictureSource: TypeAlias = Image | LazyPicture


@dataclass(frozen=True)
class Frame:
    """
    A picture of the sphere and when it was taken.

    It may be asked for in colours (``image``) or in ``grey``; neither is written to. ``source`` is
    an array as ``image`` or the LazyPicture that holds it. Which of its pixels shows what is the
    Projection's business, and whether its size fits the Stabilizer's. ``stamp_ns`` is the header's
    or the container's time; ``frame_id`` names the camera's frame. ``times`` is what a
    PictureClock made of the stamp; without, the stamp is taken as it is. ``layout`` is where the
    picture holds the sphere, as far as a recording says so, and ``refusal`` why that cannot be
    read unless somebody knows better; ``colour`` is what its values mean.
    """

    source: PictureSource
    stamp_ns: int
    frame_id: str = ''
    times: PictureTime | None = None
    layout: Layout | None = None
    colour: Colour | None = None
    refusal: Exception | None = None

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
        """Return the picture, BGR (H, W, 3) or grey (H, W); ImageError where it is damaged."""
        return self.source if isinstance(self.source, np.ndarray) else self.source.image

    @property
    def deep_image(self) -> Raster | None:
        """Return the picture, BGR (H, W, 3) uint16, where it has more than eight bits."""
        # As few sources can.
        return getattr(self.source, 'deep_image', None)

    @property
    def size_wh(self) -> tuple[int, int]:
        """Width and height of the picture in pixels, which need not be decoded for that."""
        if isinstance(self.source, np.ndarray):
            height, width = self.source.shape[:2]
            return width, height
        return self.source.size_wh

    def load(self) -> None:
        """Decode the whole picture where that then serves ``grey`` too."""
        if isinstance(self.source, JpegFile):
            self.source.image

    def grey(self, width: int = 0) -> Grey:
        """Return the picture in grey; a smaller one, at least as wide as this, costs less."""
        return (to_grey(self.source) if isinstance(self.source, np.ndarray)
                else self.source.grey(width))


def source_from_message(msg: Any) -> PictureSource:
    """
    Return what is in a message that holds a whole picture.

    A JPEG file is decoded later; what is not whole is refused at once, with ImageError.
    """
    if is_raw(msg):
        return image_from_raw(msg)
    data, kind = file_in(msg)
    return JpegFile(data) if kind == JPEG else decoded(data, kind)


def frame_from_message(msg: Any, stamp_ns: int, frame_id: str = '',
                       times: PictureTime | None = None) -> Frame:
    """Return the Frame of a message that holds a whole picture, else raise ImageError."""
    return Frame(source_from_message(msg), stamp_ns, frame_id, times)
