# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Pair pictures by stamp with their orientations, which come later and on another topic."""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from threading import Lock
from time import monotonic
from typing import TypeAlias

# The node is gone when pictures come for so long and no orientation; they then go out without.
SILENCE_S = 1.0
# A second of pictures at 30 Hz; a node that is slower than that cannot be steered by.
MAX_WAITING = 32
# A camera that does not stamp; the node takes the time of receipt, which we cannot know. The
# newest picture is then taken to be the one meant.
UNKNOWN_NS = 0

# (x, y, z, w)
UnitQuaternion: TypeAlias = tuple[float, float, float, float]


@dataclass(frozen=True)
class Orientation:
    """Of the camera, and of the virtual one that is shown."""

    R_world_camera: UnitQuaternion
    R_world_virtual: UnitQuaternion


@dataclass(frozen=True)
class Packet:
    """
    A picture in the camera's own video, as the camera sent it.

    ``number`` is one more than that of the packet before it, which it needs unless ``chunk`` is
    'key'; ``codec`` is what WebCodecs call the stream.
    """

    number: int
    data: bytes
    chunk: str
    codec: str


@dataclass(frozen=True)
class Picture:
    """
    A camera's picture as it goes to the browsers.

    ``data`` is a JPEG or PNG file, ``received_s`` its time of receipt by ``monotonic``;
    ``orientation`` is None without a node. ``derotated`` tells that it is the virtual camera's.
    Of a picture in a video ``data`` is H.264, and ``chunk`` 'key' or 'delta', as WebCodecs say;
    ``size`` is that of the camera's, (width, height), which may be larger. ``codec`` is the
    camera's where the video is. Of a camera that sends video ``packet`` is its own, for browsers
    that can take it; ``data`` is then empty where nobody needs a file.
    """

    stamp_ns: int
    data: bytes
    received_s: float
    orientation: Orientation | None = None
    derotated: bool = False
    chunk: str = ''
    size: tuple[int, int] | None = None
    codec: str = ''
    packet: Packet | None = None


class StampedOrientations:
    """
    Puts the two orientations of a picture together, which come on a topic each.

    Parameters
    ----------
    emit
        Takes stamp and Orientation.

    """

    def __init__(self, emit: Callable[[int, Orientation], object]) -> None:
        self._emit = emit
        self._halves: dict[int, dict[str, UnitQuaternion]] = {}

    def add(self, stamp_ns: int, **half: UnitQuaternion) -> None:
        """Take in one of an Orientation's values; emit the Orientation if it was the last one."""
        known = self._halves.setdefault(stamp_ns, {})
        known.update(half)
        if len(known) == len(fields(Orientation)):
            # Each topic keeps its order: what came before and is alone will stay alone.
            while next(iter(self._halves)) != stamp_ns:
                del self._halves[next(iter(self._halves))]
            del self._halves[stamp_ns]
            self._emit(stamp_ns, Orientation(**known))
        elif len(self._halves) > MAX_WAITING:
            del self._halves[next(iter(self._halves))]


class Pairing:
    """
    Holds each picture until its orientation comes; may be used from several threads.

    Parameters
    ----------
    emit
        Takes each Picture that is complete, one at a time; not to call back.

    """

    def __init__(self, emit: Callable[[Picture], object],
                 clock: Callable[[], float] = monotonic) -> None:
        self._emit = emit
        self._clock = clock
        self._lock = Lock()
        self._pictures: deque[Picture] = deque(maxlen=MAX_WAITING)
        # An orientation may overtake a picture that has to be encoded first.
        self._orientations: deque[tuple[int, Orientation]] = deque(maxlen=MAX_WAITING)
        # When the first picture came that the node has not answered by an orientation.
        self._awaited_s: float | None = None

    def add_picture(self, picture: Picture) -> None:
        """Emit a picture whose orientation is known, or that no node looks at; keep others."""
        with self._lock:
            known = [orientation for stamp_ns, orientation in self._orientations
                     if stamp_ns == picture.stamp_ns]
            now_s = self._clock()
            if self._awaited_s is None and not known:
                self._awaited_s = now_s
            gone = self._awaited_s is not None and now_s >= self._awaited_s + SILENCE_S
            if known or gone:
                self._pictures.clear()
                self._emit(replace(picture, orientation=known[-1] if known else None))
            else:
                if picture.stamp_ns == UNKNOWN_NS:
                    self._pictures.clear()
                self._pictures.append(picture)

    def add_orientation(self, stamp_ns: int, orientation: Orientation) -> None:
        """Emit the picture of an orientation; those before it were left out by the node."""
        with self._lock:
            self._awaited_s = None
            self._orientations.append((stamp_ns, orientation))
            if any(picture.stamp_ns in (stamp_ns, UNKNOWN_NS) for picture in self._pictures):
                while (picture := self._pictures.popleft()).stamp_ns not in (stamp_ns, UNKNOWN_NS):
                    pass
                self._emit(replace(picture, orientation=orientation))
