# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Greys of a recording in a temporary file: memory does not grow with their number."""

from collections.abc import Iterator
from tempfile import gettempdir, TemporaryFile

import cv2
import numpy as np

from sph_stab_ros.geometry.arrays import Grey

# So good that what JPEG takes away is far below the pictures' own noise, a third of the size of
# what takes away nothing.
QUALITY = 95


class SpoolError(Exception):
    """There is no room for the pictures, said in one line."""


class GreySpool:
    """Grey spheres on disk, to be read from the last to the first; the file has no name."""

    def __init__(self) -> None:
        try:
            self._file = TemporaryFile()
        except OSError as error:
            raise SpoolError(f'no temporary file can be made: {error.strerror}') from error
        self._sizes: list[int] = []

    def __len__(self) -> int:
        return len(self._sizes)

    def add(self, grey: Grey) -> None:
        """Write one more."""
        data = cv2.imencode('.jpg', grey, (cv2.IMWRITE_JPEG_QUALITY, QUALITY))[1]
        try:
            self._file.write(data)
            # So that what does not fit is known now.
            self._file.flush()
        except OSError as error:
            raise SpoolError(f'{gettempdir()} (TMPDIR) takes no more temporary pictures: '
                             f'{error.strerror}') from error
        self._sizes.append(len(data))

    def backwards(self) -> Iterator[Grey]:
        """Yield all of them, the last one first, and close the file."""
        with self._file as file:
            end = file.tell()
            for size in reversed(self._sizes):
                end -= size
                file.seek(end)
                yield cv2.imdecode(np.frombuffer(file.read(size), np.uint8),
                                   cv2.IMREAD_GRAYSCALE)
