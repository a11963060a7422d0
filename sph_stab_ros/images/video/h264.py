# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""
What messages of H.264 (ITU-T H.264) say about themselves.

Pictures that others may need are numbered (``frame_num``). Where a number is left out the decoder
puts a copy of another picture in place of the missing one, without a word; so it is looked for
here.
"""

from sph_stab_ros.images.video.bits import Bits, is_recovery_point, nal_units, Unit, Unreadable

SLICE, PARTITION_A, IDR, SEI, SPS, PPS = 1, 2, 5, 6, 7, 8
# A kind of slice.
INTRA = 2
# The largest numbers of parameter sets, and bits of frame_num.
MOST_SPS, MOST_PPS, MOST_BITS = 31, 255, 16
# Profiles whose SPS tells of colours and scaling.
HIGH_PROFILES = {100, 110, 122, 244, 44, 83, 86, 118, 128, 138, 139, 134, 135}


class H264:
    """A Stream of H.264, with start codes (Annex B)."""

    def __init__(self) -> None:
        self.wrap = 16
        # The bits of frame_num and those before it, by SPS, and the SPS of each PPS.
        self._number_bits: dict[int, tuple[int, int]] = {}
        self._sps_of_pps: dict[int, int] = {}
        self._last_reference: int | None = None

    @property
    def is_configured(self) -> bool:
        """Tell whether there are parameter sets."""
        return bool(self._number_bits and self._sps_of_pps)

    def look(self, data: bytes) -> Unit:
        """Return what the next message is; Unreadable where it does not tell."""
        has_parameters = recovers = False
        for unit in nal_units(data):
            kind = unit[0] & 31
            has_parameters |= kind in (SPS, PPS)
            if kind == SPS:
                self._read_sps(Bits(unit[1:]))
            elif kind == PPS:
                self._read_pps(Bits(unit[1:]))
            elif kind == SEI:
                recovers |= is_recovery_point(unit[1:])
            elif kind in (SLICE, PARTITION_A, IDR):
                return self._looked_into(
                    unit, Unit(data, has_parameters, True, kind == IDR or recovers,
                               is_closed=kind == IDR))
        return Unit(data, has_parameters, False)

    def _looked_into(self, unit: bytes, found: Unit) -> Unit:
        """Return what was found of a picture, with what its first slice tells besides."""
        if not self.is_configured:
            return found
        bits = Bits(unit[1:])
        bits.ue()
        is_intra = bits.ue() % 5 == INTRA
        try:
            before, count = self._number_bits[self._sps_of_pps[bits.ue()]]
        except KeyError:
            raise Unreadable('its parameter set is missing') from None
        bits.u(before)
        number, last = bits.u(count), self._last_reference
        self.wrap = 1 << count
        if unit[0] >> 5 & 3:
            self._last_reference = number
        # A gradual refresh begins with a picture like others; the decoder makes up what that
        # needs by the numbers before it, if there are any.
        needs_any = not found.is_closed and not is_intra and number <= 1
        # The two fields of a frame have one number.
        follows = found.is_closed or last is None or (number - last) % self.wrap <= 1
        return found._replace(needs_any=needs_any, follows=follows)

    def _read_sps(self, bits: Bits) -> None:
        profile = bits.u(8)
        bits.u(16)
        number, before = bits.ue(), 0
        if profile in HIGH_PROFILES:
            chroma = bits.ue()
            if chroma == 3:
                # The number of the colour in each slice, where colours are separate.
                before = 2 * bits.u(1)
            for _ in ('bit_depth_luma', 'bit_depth_chroma'):
                bits.ue()
            bits.u(1)
            if bits.u(1):
                for index in range(12 if chroma == 3 else 8):
                    if bits.u(1):
                        skip_scaling_list(bits, 16 if index < 6 else 64)
        count = bits.ue() + 4
        if number > MOST_SPS or count > MOST_BITS:
            raise Unreadable('its parameters make no sense')
        self._number_bits[number] = before, count

    def _read_pps(self, bits: Bits) -> None:
        number, sps = bits.ue(), bits.ue()
        if number > MOST_PPS:
            raise Unreadable('its parameters make no sense')
        self._sps_of_pps[number] = sps


def skip_scaling_list(bits: Bits, size: int) -> None:
    """Read over a scaling list (7.3.2.1.1.1)."""
    last = following = 8
    for _ in range(size):
        if following:
            following = (last + bits.se()) % 256
        last = following or last
