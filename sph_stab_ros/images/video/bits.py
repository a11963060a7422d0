# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What the formats of video have in common: bits, NAL units, and what is asked of a message."""

from collections.abc import Iterator
from typing import NamedTuple, Protocol

START_CODE = b'\0\0\1'
# Of a slice only the first fields are read; parameter sets and most of SEI are shorter.
LONGEST_HEADER = 512
RECOVERY_POINT = 6


class Unreadable(ValueError):
    """The headers of a message end too early, or refer to others that are not there."""


class Unit(NamedTuple):
    """
    What a message says about itself.

    ``data`` is what to decode of it, a picture or parameters, or both, or neither. ``is_key``:
    decoding can begin with it, unless the stream lacks parameters; ``needs_any``: if the decoder
    has been given other pictures, whatever they show; ``is_closed``: nothing behind it needs
    anything before it. ``follows``: as far as it tells, no picture
    that it may need is missing between it and the one before.
    """

    data: bytes
    has_parameters: bool
    has_picture: bool
    is_key: bool = False
    needs_any: bool = False
    is_closed: bool = False
    follows: bool = True


class Stream(Protocol):
    """
    A sequence of messages, looked into one after the other, whether they are decoded or not.

    After ``wrap`` pictures the numbers by which gaps are found begin again.
    """

    wrap: int

    @property
    def is_configured(self) -> bool:
        """Tell whether the parameters have come without which nothing can be decoded."""

    def look(self, data: bytes) -> Unit:
        """Return what the next message is; Unreadable where it does not tell."""


class Bits:
    """Reads the bits of ``data`` one after the other; Unreadable at its end."""

    def __init__(self, data: bytes) -> None:
        self._value, self._left = int.from_bytes(data, 'big'), 8 * len(data)

    def u(self, count: int) -> int:
        """Return the number in the next bits."""
        self._left -= count
        if self._left < 0:
            raise Unreadable('its headers are cut')
        return self._value >> self._left & (1 << count) - 1

    def ue(self) -> int:
        """Return the next number of exponential Golomb code."""
        zeros = 0
        while not self.u(1):
            zeros += 1
        return (1 << zeros) - 1 + self.u(zeros)

    def se(self) -> int:
        """Return the next number of signed exponential Golomb code."""
        code = self.ue()
        return (code + 1) // 2 if code % 2 else -(code // 2)


def nal_units(data: bytes) -> Iterator[bytes]:
    """Yield the beginnings of the NAL units in a message (Annex B), freed of escapes."""
    start = data.find(START_CODE)
    if start < 0:
        raise Unreadable('it has no start codes')
    while start >= 0:
        begin = start + len(START_CODE)
        following = data.find(START_CODE, begin)
        end = len(data) if following < 0 else following
        unit = data[begin:min(end, begin + LONGEST_HEADER)]
        if unit:
            yield unit.replace(b'\0\0\3', b'\0\0')
        start = following


def is_recovery_point(sei: bytes) -> bool:
    """Tell whether decoding can begin here, by the payload of a SEI unit."""
    at = 0
    while at + 2 <= len(sei) and sei[at:] != b'\x80':
        numbers = []
        for _ in range(2):
            number = 0
            while at < len(sei) and sei[at] == 0xff:
                number, at = number + 0xff, at + 1
            numbers.append(number + (sei[at] if at < len(sei) else 0))
            at += 1
        kind, size = numbers
        if kind == RECOVERY_POINT:
            return True
        at += size
    return False
