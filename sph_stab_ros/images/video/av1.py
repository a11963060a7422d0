# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""
What messages of AV1 (AV1 Bitstream & Decoding Process Specification) say about themselves.

Shown pictures are numbered (``order_hint``). Where one is missing the decoder takes older pictures
for those that it would have left, without a word; so that is looked for here. Some messages show a
picture that was decoded before, so it is followed which pictures are kept where.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field

from sph_stab_ros.images.video.bits import Bits, Unit, Unreadable

SEQUENCE_HEADER, FRAME_HEADER, FRAME = 1, 3, 6
KEY, INTRA_ONLY, SWITCH = 0, 2, 3
SLOTS = 8
ALL_SLOTS = 0xff
# Twice "as each frame says".
SELECT = 2
LONGEST_HEADER = 256


@dataclass
class Sequence:
    """What a sequence header says of the frame headers; names are the specification's."""

    reduced_still_picture_header: int = 0
    equal_picture_interval: int = 0
    # In bits, 0 where there is no decoder model.
    buffer_removal_time_length: int = 0
    frame_presentation_time_length: int = 0
    # Of those operating points whose removal from the buffer frames may tell.
    operating_point_idcs: list[int] = field(default_factory=list)
    frame_id_length: int = 0
    force_screen_content_tools: int = SELECT
    force_integer_mv: int = SELECT
    order_hint_bits: int = 0


class Av1:
    """A Stream of AV1 in the low overhead format, a temporal unit in each message."""

    def __init__(self) -> None:
        self.wrap = 256
        self._sequence: Sequence | None = None
        # Order hint and kind of the pictures that are kept, and the hint of the one shown last.
        self._kept: list[tuple[int | None, int | None]] = [(None, None)] * SLOTS
        self._shown: int | None = None

    @property
    def is_configured(self) -> bool:
        """Tell whether there is a sequence header."""
        return self._sequence is not None

    def look(self, data: bytes) -> Unit:
        """Return what the next message is; Unreadable where it does not tell."""
        has_parameters = has_picture = is_key = False
        shown: list[int] = []
        if not data:
            raise Unreadable('it is empty')
        for kind, layers, content in obus(data):
            if kind == SEQUENCE_HEADER:
                has_parameters = True
                self._sequence = read_sequence(Bits(content))
                self.wrap = 1 << max(self._sequence.order_hint_bits, 3)
            elif kind in (FRAME_HEADER, FRAME):
                has_picture = True
                if self._sequence is not None:
                    shows_key, number = self._read_frame(Bits(content), self._sequence, layers)
                    is_key |= shows_key
                    shown += [] if number is None else [number]
        follows = not shown or self._shown is None or (shown[0] - self._shown) % self.wrap == 1
        # There are several in layers of one picture, which have one number.
        self._shown = shown[-1] if shown else self._shown
        return Unit(data, has_parameters, has_picture, is_key, follows=is_key or follows)

    def _read_frame(self, bits: Bits, sequence: Sequence, layers: tuple[int, int]
                    ) -> tuple[bool, int | None]:
        """Return whether a frame header shows a key picture, and the order hint of what it is."""
        if sequence.reduced_still_picture_header:
            return True, None
        if bits.u(1):
            hint, kind = kept = self._kept[bits.u(3)]
            if kind == KEY:
                self._kept = [kept] * SLOTS
            return False, hint
        kind, is_shown = bits.u(2), bits.u(1)
        if not is_shown:
            bits.u(1)
        elif sequence.buffer_removal_time_length and not sequence.equal_picture_interval:
            bits.u(sequence.frame_presentation_time_length)
        is_shown_key = kind == KEY and bool(is_shown)
        is_resilient = kind == SWITCH or is_shown_key or bool(bits.u(1))
        bits.u(1)
        skip_tools(bits, sequence)
        bits.u(sequence.frame_id_length)
        if kind != SWITCH:
            bits.u(1)
        number = bits.u(sequence.order_hint_bits)
        if not (is_resilient or kind in (KEY, INTRA_ONLY)):
            bits.u(3)
        skip_removal_times(bits, sequence, layers)
        refreshed = ALL_SLOTS if kind == SWITCH or is_shown_key else bits.u(SLOTS)
        # Without hints there is nothing to compare.
        known = number if sequence.order_hint_bits else None
        for slot in range(SLOTS):
            if refreshed >> slot & 1:
                self._kept[slot] = known, kind
        return is_shown_key, known if is_shown else None


def skip_tools(bits: Bits, sequence: Sequence) -> None:
    """Read over what a frame header says of screen content."""
    has_tools = sequence.force_screen_content_tools
    if has_tools == SELECT:
        has_tools = bits.u(1)
    if has_tools and sequence.force_integer_mv == SELECT:
        bits.u(1)


def skip_removal_times(bits: Bits, sequence: Sequence, layers: tuple[int, int]) -> None:
    """Read over the times at which a frame header has buffers emptied, of some layers each."""
    if sequence.buffer_removal_time_length and bits.u(1):
        temporal, spatial = layers
        for idc in sequence.operating_point_idcs:
            if idc == 0 or idc >> temporal & 1 and idc >> spatial + 8 & 1:
                bits.u(sequence.buffer_removal_time_length)


def obus(data: bytes) -> Iterator[tuple[int, tuple[int, int], bytes]]:
    """Yield the kind, temporal and spatial layer, and beginning of each OBU in a message."""
    at = 0
    while at < len(data):
        head, at = data[at], at + 1
        layers = 0, 0
        if head & 0x80:
            raise Unreadable('it is no sequence of OBUs')
        if head & 4:
            if at == len(data):
                raise Unreadable('its headers are cut')
            layers, at = (data[at] >> 5, data[at] >> 3 & 3), at + 1
        size = len(data) - at
        if head & 2:
            size, at = leb128(data, at)
        if at + size > len(data):
            raise Unreadable('it is cut')
        yield head >> 3 & 15, layers, data[at:at + min(size, LONGEST_HEADER)]
        at += size


def leb128(data: bytes, at: int) -> tuple[int, int]:
    """Return the number of variable length that begins at a position, and where it ends."""
    value = 0
    for index, byte in enumerate(data[at:at + 8]):
        value |= (byte & 0x7f) << 7 * index
        if byte < 0x80:
            return value, at + index + 1
    raise Unreadable('its headers are cut')


def read_operating_points(bits: Bits, delay_length: int, found: Sequence) -> None:
    """Read what a sequence header says of its operating points."""
    has_display_delay = bits.u(1)
    for _ in range(bits.u(5) + 1):
        idc, level = bits.u(12), bits.u(5)
        if level > 7:
            bits.u(1)
        if delay_length and bits.u(1):
            bits.u(2 * delay_length + 1)
            found.operating_point_idcs.append(idc)
        if has_display_delay and bits.u(1):
            bits.u(4)


def read_sequence(bits: Bits) -> Sequence:
    """Return what a sequence header says (5.5)."""
    found = Sequence()
    # The profile, and whether there is one picture only.
    bits.u(4)
    found.reduced_still_picture_header = bits.u(1)
    if found.reduced_still_picture_header:
        return found
    delay_length = 0
    if bits.u(1):
        bits.u(64)
        found.equal_picture_interval = bits.u(1)
        if found.equal_picture_interval:
            bits.ue()
        if bits.u(1):
            delay_length = bits.u(5) + 1
            bits.u(32)
            found.buffer_removal_time_length = bits.u(5) + 1
            found.frame_presentation_time_length = bits.u(5) + 1
    read_operating_points(bits, delay_length, found)
    width_bits, height_bits = bits.u(4) + 1, bits.u(4) + 1
    bits.u(width_bits + height_bits)
    if bits.u(1):
        delta_length = bits.u(4) + 2
        found.frame_id_length = bits.u(3) + delta_length + 1
    # Tools that frame headers do not tell of before the order hint.
    bits.u(7)
    has_order_hints = bits.u(1)
    if has_order_hints:
        bits.u(2)
    found.force_screen_content_tools = SELECT if bits.u(1) else bits.u(1)
    if found.force_screen_content_tools:
        found.force_integer_mv = SELECT if bits.u(1) else bits.u(1)
    if has_order_hints:
        found.order_hint_bits = bits.u(3) + 1
    return found
