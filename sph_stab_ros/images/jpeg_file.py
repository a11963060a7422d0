# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""A picture in a JPEG file, of which only as much is decoded as somebody asks for."""

from functools import cached_property
from typing import Any

import cv2
import numpy as np

from sph_stab_ros.geometry.arrays import Grey, Image
from sph_stab_ros.geometry.projection import to_grey
from sph_stab_ros.images.codec import decoded, JPEG
from sph_stab_ros.images.picture_size import jpeg_size

# By how much a decoder can reduce on the way, which leaves out most of its work.
REDUCED_GREY = {
    8: cv2.IMREAD_REDUCED_GRAYSCALE_8, 4: cv2.IMREAD_REDUCED_GRAYSCALE_4,
    2: cv2.IMREAD_REDUCED_GRAYSCALE_2}


class JpegFile:
    """
    A picture that is decoded when it is asked for, and less of it for tracking.

    ``data`` is the file. At 1920 columns a grey picture of 960 takes 3 ms where one in colour,
    made grey and smaller, takes 8.

    Parameters
    ----------
    data
        A JPEG file; ImageError where it does not even tell its size.

    """

    def __init__(self, data: bytes) -> None:
        self.data = data
        self.size_wh = jpeg_size(data)

    @cached_property
    def image(self) -> Image:
        """Return the whole picture, (H, W, 3) uint8 in BGR order or (H, W); ImageError without."""
        return decoded(self.data, JPEG)

    def grey(self, width: int = 0) -> Grey:
        """
        Return the picture in grey, a smaller one at least as wide as this if it is not decoded.

        Where it cannot be smaller it is made of the colours: leaving these out saves little, and
        a file's own grey is rounded otherwise, by which an orientation would depend on whether
        anybody looks at the picture.
        """
        reduction = next(
            (one for one in REDUCED_GREY if width and self.size_wh[0] >= one * width), None)
        if reduction is None or 'image' in vars(self):
            return to_grey(self.image)
        return decoded(self.data, JPEG, REDUCED_GREY[reduction])


def jpeg_fields(file: JpegFile) -> dict[str, Any]:
    """Return the fields of the CompressedImage message that holds a file, but for its header."""
    return {'format': 'jpeg', 'data': np.frombuffer(file.data, np.uint8)}
