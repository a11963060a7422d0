# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""One picture with its time, as it passes from the recordings and topics into the core."""

from dataclasses import dataclass

import numpy as np

from sph_stab_ros.images.codec import image_from_message, JPEG, kind_of_whole_file
from sph_stab_ros.images.jpeg import JpegFile


class DecodedWhenAskedFor:
    """The attribute of a Frame that is given as an array or as a JpegFile, and is an array."""

    def __get__(self, frame, owner=None):
        """Return the array."""
        if frame is None:
            # A dataclass takes what the class has for the default; there is none.
            raise AttributeError('image')
        source = vars(frame)['source']
        return source.image if isinstance(source, JpegFile) else source

    def __set__(self, frame, source):
        """Take what the Frame is made of."""
        vars(frame)['source'] = source


@dataclass(frozen=True)
class Frame:
    """
    A picture of the sphere and when it was taken.

    ``image`` is (H, W, 3) uint8 in BGR order or (H, W) uint8 and is not written to; which of its
    pixels shows what is the Projection's business, and whether its size fits the Stabilizer's.
    Given as a JpegFile it is decoded when somebody asks for it, or ImageError is raised.
    ``stamp_ns`` is the header's or the container's time; ``frame_id`` names the camera's frame.
    """

    image: np.ndarray = DecodedWhenAskedFor()
    stamp_ns: int
    frame_id: str = ''

    @property
    def size_wh(self):
        """Width and height of the image in pixels, which need not be decoded for that."""
        source = vars(self)['source']
        return source.size_wh if isinstance(source, JpegFile) else source.shape[1::-1]

    def load(self):
        """Decode the whole image, which then serves ``at_least`` too."""
        self.image

    def at_least(self, width):
        """Return the image, or a smaller one of it, grey perhaps, that is as wide as this."""
        source = vars(self)['source']
        return source.at_least(width) if isinstance(source, JpegFile) else source


def frame_from_message(msg, stamp_ns, frame_id=''):
    """
    Return the Frame of an Image or CompressedImage message.

    A JPEG file is decoded later; what is not whole is refused at once, with ImageError.
    """
    if not hasattr(msg, 'encoding'):
        data = bytes(msg.data)
        if kind_of_whole_file(data) == JPEG:
            return Frame(JpegFile(data), stamp_ns, frame_id)
    return Frame(image_from_message(msg), stamp_ns, frame_id)
