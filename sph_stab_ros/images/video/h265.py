# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""
What messages of H.265 (ITU-T H.265) say about themselves.

Each picture names those that it needs, and the decoder refuses it where one is missing.
"""

from sph_stab_ros.images.video.bits import is_recovery_point, nal_units, START_CODE, Unit

# Slices of pictures, those of pictures with which decoding can begin (IRAP), and others.
SLICES, KEYS, SEI = range(32), range(16, 24), 39
PARAMETERS = {32, 33, 34}


class H265:
    """A Stream of H.265, with start codes (Annex B)."""

    # The least that encoders use.
    wrap = 256

    def __init__(self) -> None:
        self._missing = set(PARAMETERS)

    @property
    def is_configured(self) -> bool:
        """Tell whether there are parameter sets."""
        return not self._missing

    def look(self, data: bytes) -> Unit:
        """Return what the next message is, without what only informs."""
        has_parameters = has_sei = recovers = False
        for unit in nal_units(data):
            kind = kind_of(unit)
            has_parameters |= kind in PARAMETERS
            self._missing.discard(kind)
            if kind == SEI:
                has_sei = True
                recovers |= is_recovery_point(unit[2:])
            elif kind in SLICES:
                return Unit(without_sei(data) if has_sei else data, has_parameters, True,
                            kind in KEYS or recovers)
        return Unit(data, has_parameters, False)


def kind_of(unit: bytes) -> int:
    """Return the kind of a NAL unit."""
    return unit[0] >> 1 & 63


def without_sei(data: bytes) -> bytes:
    """
    Return a message without what no picture is made of.

    Cameras write what they like there, and a decoder that is strict fails at it.
    """
    first, *units = data.split(START_CODE)
    return START_CODE.join([first, *(
        unit for unit in units if unit and (
            kind_of(unit) != SEI or is_recovery_point(unit[2:])))])
