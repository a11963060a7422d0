# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Two cameras or streams, one for each lens, read as one: their pictures are joined."""

from collections.abc import Callable
from functools import partial
from threading import Lock
from typing import Any, TypeAlias

from sph_stab_ros.config import NOT_JOINED
from sph_stab_ros.images.image_error import ImageError
from sph_stab_ros.images.joined import JoinedPicture, MAX_APART_NS, MOST_WAITING, Pairing
from sph_stab_ros.live.address import Address, SourceError
from sph_stab_ros.live.source import CONNECTED, LivePicture, LiveSource, Log, SourceState

Refuse: TypeAlias = Callable[[ImageError], Any]
Take: TypeAlias = Callable[[LivePicture], Any]


class JoinedSources:
    """
    Two LiveSources whose pictures are paired by their stamps; to others it is what one is.

    Parameters are those of a LiveSource, but that there are two addresses and ``join`` says how
    their pictures are put together.
    """

    def __init__(self, addresses: tuple[Address, Address], take: Take, log: Log, refuse: Refuse,
                 join: str) -> None:
        if join == NOT_JOINED:
            raise SourceError('a source for the rear lens needs join:=left_right or top_bottom')
        self._take, self._join = take, join
        self._pairing: Pairing[LivePicture] = Pairing()
        self._pictures = 0
        self._size_wh: tuple[int, int] | None = None
        # Each is read in a thread of its own.
        self._lock = Lock()
        self._sources = [LiveSource(address, partial(self.add, which), log, refuse)
                         for which, address in enumerate(addresses)]
        self.name = ' and '.join(one.name for one in self._sources)

    @property
    def state(self) -> SourceState:
        """Return the state of that source which is worse off, with the pictures of both."""
        first, second = (one.state for one in self._sources)
        worse = second if first.status == CONNECTED else first
        return worse._replace(
            codec=', '.join(sorted({first.codec, second.codec} - {''})), size_wh=self._size_wh,
            clock=', '.join(sorted({first.clock, second.clock} - {''})),
            connections=first.connections + second.connections, pictures=self._pictures,
            left_out=first.left_out + second.left_out + self._pairing.left_out)

    def why_silent(self) -> str:
        """Return why nothing comes from either, '' where something does."""
        reasons = '; '.join(filter(None, (one.why_silent() for one in self._sources)))
        if not reasons and self._pairing.waiting >= MOST_WAITING:
            return (f'no picture of {self.name} is of the same time as one of the other, within '
                    f'{MAX_APART_NS / 1e6:.0f} ms')
        return reasons

    def start(self) -> None:
        """Start to read."""
        for one in self._sources:
            one.start()

    def close(self) -> None:
        """Stop reading."""
        for one in self._sources:
            one.close()

    def has_ended(self, wait_s: float = 0.) -> bool:
        """Tell whether nothing more will come: one lens' pictures alone are none."""
        return any(one.has_ended(wait_s / 2) for one in self._sources)

    def add(self, which: int, picture: LivePicture) -> None:
        """Take in a picture of a lens, 0 or 1, and pass on the pair that it completes."""
        with self._lock:
            pair = self._pairing.add(which, picture.stamp_ns, picture)
            if pair is None:
                return
            first, second = pair
            joined = JoinedPicture(first.source, second.source, self._join)
            self._pictures, self._size_wh = self._pictures + 1, joined.size_wh
            self._take(LivePicture(
                joined, first.stamp_ns, max(first.received_s, second.received_s)))


def source_of(address: Address, rear: Address | None, take: Take, log: Log, refuse: Refuse,
              join: str) -> LiveSource | JoinedSources:
    """Return what reads an address, and that of another lens if there is one."""
    if rear is None:
        return LiveSource(address, take, log, refuse, join)
    return JoinedSources((address, rear), take, log, refuse, join)
