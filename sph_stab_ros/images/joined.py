# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Two pictures of one moment, one of each lens, put side by side or one above the other."""

from collections import deque
from functools import cached_property
from typing import Any, Generic, TYPE_CHECKING, TypeVar

import numpy as np

from sph_stab_ros.config import LEFT_RIGHT, NOT_JOINED
from sph_stab_ros.geometry.arrays import Grey, Image
from sph_stab_ros.geometry.conventions import NS_PER_S
from sph_stab_ros.images.frame import Frame, PictureSource
from sph_stab_ros.images.image_error import ImageError

if TYPE_CHECKING:
    import av

# Further apart they are not of one moment: half a period at 60 pictures a second. A camera that
# turns by 60 degrees a second turns by half a degree meanwhile.
MAX_APART_NS = NS_PER_S // 120
# One lens' pictures that wait for the other's: a stream may be behind by so many.
MOST_WAITING = 8

Item = TypeVar('Item')


class JoinedPicture:
    """
    The LazyPicture of two that are put together as ``join`` says.

    ImageError where it is asked for and the two are of different sizes or only one has colours.
    """

    def __init__(self, first: PictureSource, second: PictureSource, join: str) -> None:
        self._parts = Frame(first, 0), Frame(second, 0)
        self._axis = 1 if join == LEFT_RIGHT else 0
        width, height = self._parts[0].size_wh
        self.size_wh = (2 * width, height) if join == LEFT_RIGHT else (width, 2 * height)

    @cached_property
    def image(self) -> Image:
        """Return the whole picture."""
        return self._joined([part.image for part in self._parts])

    def grey(self, width: int = 0) -> Grey:
        """Return the picture in grey; a smaller one, at least as wide as this, costs less."""
        of_each = -(-width // 2) if self._axis else width
        return self._joined([part.grey(of_each) for part in self._parts])

    def _joined(self, images: list[Image]) -> Image:
        shapes = [image.shape for image in images]
        if shapes[0] != shapes[1]:
            raise ImageError('unlike lenses', 'the pictures of two lenses are of different sizes '
                             f'or colours: {shapes[0]} and {shapes[1]}')
        return np.concatenate(images, axis=self._axis)


class Pairing(Generic[Item]):
    """Finds what is of one moment in two sequences that come in together, each in its order."""

    def __init__(self) -> None:
        self._waiting: tuple[deque[tuple[int, Item]], ...] = deque(), deque()
        self._left_out = 0

    @property
    def waiting(self) -> int:
        """Return how many of that sequence wait of which the more do."""
        return max(map(len, self._waiting))

    @property
    def left_out(self) -> int:
        """Return how many have none of the other sequence with them, those that wait included."""
        return self._left_out + sum(map(len, self._waiting))

    def add(self, which: int, stamp_ns: int, item: Item) -> tuple[Item, Item] | None:
        """Take in the next one of a sequence, 0 or 1; return it and what is of its moment."""
        own, others = self._waiting[which], self._waiting[1 - which]
        nearest = min(range(len(others)), key=lambda n: abs(others[n][0] - stamp_ns), default=None)
        if nearest is None or abs(others[nearest][0] - stamp_ns) > MAX_APART_NS:
            own.append((stamp_ns, item))
            if len(own) > MOST_WAITING:
                own.popleft()
                self._left_out += 1
            return None
        # What has waited for longer will wait for ever.
        self._left_out += len(own) + nearest
        own.clear()
        for _ in range(nearest):
            others.popleft()
        _, other = others.popleft()
        return (other, item) if which else (item, other)


def tracks_of(container: 'av.container.InputContainer', join: str) -> list[Any]:
    """
    Return the streams of a container that hold its pictures, of two lenses if they are joined.

    These are its first one and the next one of the same size; one alone, or none, where there are
    no more.
    """
    tracks = list(container.streams.video)
    if join == NOT_JOINED:
        return tracks[:1]
    return [one for one in tracks
            if (one.width, one.height) == (tracks[0].width, tracks[0].height)][:2]
