# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""A decoded picture of a video, converted to what somebody asks for."""

from functools import cached_property
from typing import Any, TYPE_CHECKING

import numpy as np

from sph_stab_ros.geometry.arrays import Grey, Image, Planes

if TYPE_CHECKING:
    import av

# Of these the first plane is Y, in eight bits.
Y_FIRST = {'gray', 'nv12', 'yuv420p', 'yuv422p', 'yuv444p', 'yuvj420p', 'yuvj422p', 'yuvj444p'}


class VideoPicture:
    """
    A picture that a decoder of PyAV gave.

    What it is made of is kept as it was decoded; grey is its Y, whoever asks for colours besides.
    """

    def __init__(self, frame: 'av.VideoFrame') -> None:
        self._frame = frame
        self.size_wh = frame.width, frame.height

    @cached_property
    def image(self) -> Image:
        """Return the picture, (H, W, 3) uint8 in BGR order or (H, W)."""
        is_grey = len(self._frame.format.components) == 1
        image: Any = self._frame.to_ndarray(format='gray' if is_grey else 'bgr24')
        return image

    def grey(self, width: int = 0) -> Grey:
        """Return the picture in grey."""
        if self._frame.format.name in Y_FIRST:
            return self._plane(0)
        grey: Any = self._frame.to_ndarray(format='gray')
        return grey

    @property
    def planes(self) -> Planes | None:
        """Return Y, U and V where they are planes of eight bits, and colours half as fine."""
        if self._frame.format.name not in ('yuv420p', 'yuvj420p'):
            return None
        return Planes(*map(self._plane, range(3)))

    def _plane(self, index: int) -> Grey:
        """Return a plane without what pads its rows, in the memory of the decoder."""
        plane = self._frame.planes[index]
        rows = np.frombuffer(memoryview(plane), np.uint8).reshape(-1, plane.line_size)
        return rows[:plane.height, :plane.width]
