# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""
What server and page say to each other over the WebSocket.

To the page: pictures as binary messages, a header of JSON and the image file behind it
(``picture_message``); everything else as JSON texts with a ``type``: ``state``, ``notice``,
``echo``, ``datagrams``.

From the page: JSON texts, each one of the commands below; whatever else is a ProtocolError.
"""

from dataclasses import asdict, dataclass, fields
import json
from math import hypot
from struct import pack
from typing import Any, TypeAlias

from sph_stab_ros.geometry.rotations import is_unit_quaternion
from sph_stab_ros.operator.pairing import Picture, UnitQuaternion

# All commands are shorter by far.
MAX_MESSAGE_BYTES = 1024
# Of a link.
MAX_FIGURE = 1e6


class ProtocolError(ValueError):
    """A message that no page of ours sends, with the reason in one line."""


@dataclass(frozen=True)
class Drawn:
    """The page has drawn this picture; another one may come."""

    sequence: int

    def __post_init__(self) -> None:
        """Check the value."""
        if type(self.sequence) is not int or not 0 <= self.sequence < 2**53:
            raise ProtocolError('sequence is not a number of a picture')


@dataclass(frozen=True)
class Skipped(Drawn):
    """The page cannot draw this picture; another one may come."""


@dataclass(frozen=True)
class Arrived(Drawn):
    """
    What has come by datagrams: all up to a picture can be used.

    The ``newest`` that is here whole is another one where it needs a picture that has got lost.
    """

    newest: int

    def __post_init__(self) -> None:
        """Check the values."""
        super().__post_init__()
        Drawn(self.newest)


@dataclass(frozen=True)
class NeedKey:
    """The page lacks a picture that those after it in the video need."""


@dataclass(frozen=True)
class Echo:
    """The page asks for this number back, and for the time."""

    sent_ms: float

    def __post_init__(self) -> None:
        """Check the value."""
        if not (type(self.sent_ms) in (int, float) and abs(self.sent_ms) < 2**53):
            raise ProtocolError('sent_ms is not a time')


@dataclass(frozen=True)
class Look:
    """The operator looks there: the quaternion (x, y, z, w) of ``R_virtual_view``."""

    direction: UnitQuaternion

    def __post_init__(self) -> None:
        """Check the value and make it a unit quaternion."""
        if not (isinstance(self.direction, list) and len(self.direction) == 4
                and all(type(part) in (int, float) and abs(part) <= 2 for part in self.direction)):
            raise ProtocolError('direction is not four numbers')
        if not is_unit_quaternion(self.direction):
            raise ProtocolError('direction is not a unit quaternion')
        norm = hypot(*self.direction)
        object.__setattr__(self, 'direction', tuple(part / norm for part in self.direction))


@dataclass(frozen=True)
class TakeControl:
    """From now on this page's look direction and buttons count."""


@dataclass(frozen=True)
class ResetHeading:
    """Make the camera's present orientation the world's."""


@dataclass(frozen=True)
class Level:
    """Make the present orientation level."""


@dataclass(frozen=True)
class SetMode:
    """Change how the view follows the robot."""

    mode: str

    def __post_init__(self) -> None:
        """Check the value."""
        if not (isinstance(self.mode, str) and 0 < len(self.mode) <= 40):
            raise ProtocolError('mode is not a name')


@dataclass(frozen=True)
class Record:
    """Begin to record on the robot, or end that."""

    on: bool

    def __post_init__(self) -> None:
        """Check the value."""
        if type(self.on) is not bool:
            raise ProtocolError('on is neither true nor false')


@dataclass(frozen=True)
class Link:
    """What the page shows of its link: rates per second, and times; None where unknown."""

    drawn: float | None
    dropped: float | None
    mbit_s: float | None
    latency_ms: float | None
    latency_p95_ms: float | None
    round_trip_ms: float | None

    def __post_init__(self) -> None:
        """Check the values."""
        for name, value in asdict(self).items():
            # Written so that NaN fails too.
            if value is not None and not (type(value) in (int, float) and abs(value) < MAX_FIGURE):
                raise ProtocolError(f'{name} is not a figure')


Command: TypeAlias = (
    Drawn | Skipped | Arrived | NeedKey | Echo | Look | TakeControl | ResetHeading | Level
    | SetMode | Record | Link)

COMMANDS: dict[str, type[Command]] = {
    'drawn': Drawn, 'skipped': Skipped, 'arrived': Arrived, 'need_key': NeedKey, 'echo': Echo,
    'look': Look, 'take_control': TakeControl, 'reset_heading': ResetHeading, 'level': Level,
    'set_mode': SetMode, 'record': Record, 'link': Link}


def parse_command(text: str) -> Command:
    """Return the command in a message of the page, or raise ProtocolError."""
    try:
        values = json.loads(text)
    except (ValueError, RecursionError):
        raise ProtocolError('not JSON') from None
    kind = values.pop('type', None) if isinstance(values, dict) else None
    command = COMMANDS.get(kind) if isinstance(kind, str) else None
    if command is None:
        raise ProtocolError('not a command')
    if values.keys() != {field.name for field in fields(command)}:
        raise ProtocolError(f'{kind} takes other values')
    return command(**values)


def picture_message(sequence: int, picture: Picture) -> bytes:
    """
    Return the binary message of a Picture.

    Its first four bytes, little-endian, tell the length of the JSON behind them; the rest is the
    image file, or the part of a video.
    """
    header = json.dumps({
        'sequence': sequence,
        # That of the camera's, where it is another.
        'size': picture.size,
        # A JavaScript number cannot hold nanoseconds since 1970.
        'stamp_ns': str(picture.stamp_ns),
        'orientation': picture.orientation and asdict(picture.orientation),
        'derotated': picture.derotated,
        'chunk': picture.chunk,
        'codec': picture.codec,
    }).encode()
    return b''.join((pack('<I', len(header)), header, picture.data))


def text_message(kind: str, **values: Any) -> str:
    """Return a JSON text for the page."""
    return json.dumps({'type': kind, **values})
