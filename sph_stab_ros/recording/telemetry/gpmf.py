# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""
GoPro's telemetry: GPMF, nested records of key, length and value (github.com/gopro/gpmf-parser).

Each sample of the track, a second or so, holds devices (DEVC), these hold streams (STRM). A
stream's last record is the measurements; those before tell their scale (SCAL), how many there have
been with these (TSMP), and, of later cameras, when the first one was taken (STMP).

**Axes.** GoPro's are x left, y backwards, z up as seen from behind (the README's *IMU
orientation*); ORIN says which of them the numbers of a sample are, small letters for the negative
ones. Cameras without ORIN have the orders that the README tells, but for a HERO6 whose stream is
named "(up/down, right/left, forward/back)" or "(z,x,y)", as a HERO5's: in GoPro's own sample
gravity is where that name says, not the README.

**Times.** Those of a payload are its track's, and the clock of the sensor is not the video's: with
STMP samples lie evenly from one payload's to the next one's, on a clock whose offset is that of
the first picture (STMP of SHUT, exposures by picture). Without, the samples' numbers are fitted to
the payloads' beginnings by a straight line, much as GoPro's own demo does.
"""

from collections.abc import Iterable, Iterator
from pathlib import Path
import struct
from typing import NamedTuple

import numpy as np

from sph_stab_ros.geometry.arrays import Floats, Values
from sph_stab_ros.recording.spherical import inside
from sph_stab_ros.recording.spherical_boxes import index_of
from sph_stab_ros.recording.telemetry.base import check_count, Series, series, single, Telemetry

NUMBERS = {'b': '>i1', 'B': '>u1', 's': '>i2', 'S': '>u2', 'l': '>i4', 'L': '>u4', 'j': '>i8',
           'J': '>u8', 'f': '>f4', 'd': '>f8'}
NEST = '\0'
# Where there is no ORIN.
ORDER, FUSION_ORDER, HERO6_ORDER = 'ZXY', 'yXZ', 'YxZ'
US_PER_S = 1e6
# A second of the fastest sensors is 24 kB; each record is a hundred times larger once it is read.
MAX_PAYLOAD_BYTES = 2**22


class Item(NamedTuple):
    """A record: its values are ``repeat`` structures of so many bytes."""

    kind: str
    size: int
    content: bytes

    def text(self) -> str:
        """Return the characters."""
        return self.content.partition(b'\0')[0].decode('latin-1')

    def numbers(self) -> Floats:
        """Return numbers, a row for each structure; ValueError where they are none."""
        numbers = np.frombuffer(self.content, NUMBERS.get(self.kind, 'V'))
        columns = self.size // numbers.itemsize
        if not columns or not len(numbers):
            raise ValueError('a structure is empty')
        return numbers.reshape(-1, columns).astype(float)


class Part(NamedTuple):
    """The measurements of one kind in a payload, and when that began and ended, in s."""

    start_s: float
    end_s: float
    vectors: Floats
    # With these.
    total: int | None
    # On the camera's clock, of the first one, and of the first picture in the payload.
    stamp_s: float | None
    picture_stamp_s: float | None


def is_sample(data: bytes) -> bool:
    """Tell whether a track's sample is GPMF."""
    return data[:5] == b'DEVC\0'


def read(payloads: Iterable[tuple[float, float, bytes]]) -> Telemetry:
    """Return the Telemetry of payloads with their times and durations in s."""
    rates: list[Part] = []
    forces: list[Part] = []
    name, count = '', 0
    for start_s, duration_s, data in payloads:
        try:
            found = list(streams(data[:MAX_PAYLOAD_BYTES]))
            picture_stamp_s = next(
                (_stamp_s(stream) for _, stream in found if 'SHUT' in stream), None)
            for device, stream in found:
                for key, parts in (('GYRO', rates), ('ACCL', forces)):
                    if key not in stream or parts and parts[-1].start_s == start_s:
                        continue
                    parts.append(Part(
                        start_s, start_s + duration_s, in_body(stream, key, device),
                        _total(stream), _stamp_s(stream), picture_stamp_s))
                    name = name or device
                    check_count(count := count + len(parts[-1].vectors))
        except ValueError:
            # A damaged payload is a second without measurements.
            continue
    return Telemetry(f'GoPro GPMF, {name or "unnamed camera"}', joined(rates), joined(forces))


def items(data: bytes) -> Iterator[tuple[str, Item]]:
    """Yield the records in bytes by their keys; ValueError where one is cut short."""
    place = 0
    # Zeros fill up the end.
    while place + 8 <= len(data) and data[place]:
        key, kind, size, repeat = struct.unpack_from('>4scBH', data, place)
        content = data[place + 8:place + 8 + size * repeat]
        if len(content) < size * repeat:
            raise ValueError('a record is cut short')
        yield key.decode('latin-1'), Item(kind.decode('latin-1'), size, content)
        place += 8 + -(-len(content) // 4) * 4


def streams(payload: bytes) -> Iterator[tuple[str, dict[str, Item]]]:
    """Yield the name of the device and the records by their keys, of each stream."""
    for _, device in items(payload):
        if device.kind == NEST:
            inside = list(items(device.content))
            name = next((item.text() for key, item in inside if key == 'DVNM'), '')
            yield from ((name, dict(items(item.content))) for key, item in inside
                        if key == 'STRM' and item.kind == NEST)


def in_body(stream: dict[str, Item], key: str, device_name: str) -> Floats:
    """Return the vectors (N, 3) of a stream in the body's axes; ValueError where they are none."""
    vectors = stream[key].numbers()
    scale = stream['SCAL'].numbers().ravel() if 'SCAL' in stream else np.ones(1)
    if vectors.shape[1] != 3 or len(scale) not in (1, 3) or not scale.all():
        raise ValueError('these are no vectors')
    order = _order(stream, device_name)
    if sorted(order.upper()) != ['X', 'Y', 'Z']:
        raise ValueError('these are no axes')
    x, y, z = (np.where(order[i].isupper(), 1, -1) * vectors[:, i] / scale[i % len(scale)]
               for i in map(order.upper().index, 'XYZ'))
    return single(np.column_stack((-y, x, z)))


def _order(stream: dict[str, Item], device_name: str) -> str:
    """Return which of GoPro's axes the numbers of a sample are."""
    if 'ORIN' in stream:
        return stream['ORIN'].text()
    if device_name.startswith('Fusion'):
        return FUSION_ORDER
    names_axes = 'STNM' in stream and '(' in stream['STNM'].text()
    return HERO6_ORDER if device_name.startswith('Hero6') and not names_axes else ORDER


def joined(parts: list[Part]) -> Series | None:
    """Return the Series of the parts of all payloads."""
    if not parts:
        return None
    counts = np.array([len(part.vectors) for part in parts])
    ends = np.cumsum(counts)
    totals = [part.total for part in parts if part.total is not None]
    if len(totals) == len(parts) and np.all(np.diff(totals, prepend=0) >= counts):
        # They count what is in lost payloads, too.
        ends = np.array(totals)
    numbers = np.concatenate([end - count + np.arange(count)
                              for end, count in zip(ends, counts)])
    stamps_s = np.array([part.stamp_s for part in parts if part.stamp_s is not None])
    times_s = (_interpolated(parts[0], stamps_s, ends - counts, numbers)
               if 1 < len(parts) == len(stamps_s) and np.all(np.diff(stamps_s) > 0)
               else _fitted(parts, ends - counts, numbers))
    return series(times_s, np.concatenate([part.vectors for part in parts]))


def _interpolated(first: Part, stamps_s: Values, starts: Values, numbers: Values) -> Values:
    """Return the times of samples by the camera's own stamps of those that payloads begin with."""
    zero_s = stamps_s[0] if first.picture_stamp_s is None else first.picture_stamp_s
    period_s = (stamps_s[-1] - stamps_s[-2]) / (starts[-1] - starts[-2])
    in_camera_s = np.where(
        numbers > starts[-1], stamps_s[-1] + period_s * (numbers - starts[-1]),
        np.interp(numbers, starts, stamps_s))
    return first.start_s + in_camera_s - zero_s


def _fitted(parts: list[Part], starts: Values, numbers: Values) -> Values:
    """Return the times of samples where payloads have the track's only."""
    starts_s = np.array([part.start_s for part in parts])
    if len(parts) > 2:
        # A payload begins when the samples of those before have come. The last one's end is not
        # when it was filled.
        period_s, first_s = np.polyfit(starts - starts[0], starts_s - starts_s[0], 1)
        if period_s > 0:
            return starts_s[0] + first_s + period_s * (numbers + 1 - starts[0])
    return np.concatenate([
        part.start_s + (part.end_s - part.start_s) * (np.arange(len(part.vectors)) + 1)
        / len(part.vectors) for part in parts])


def _total(stream: dict[str, Item]) -> int | None:
    return int(stream['TSMP'].numbers()[0, 0]) if 'TSMP' in stream else None


def _stamp_s(stream: dict[str, Item]) -> float | None:
    return float(stream['STMP'].numbers()[0, 0]) / US_PER_S if 'STMP' in stream else None


def stabilized_by(path: Path) -> str:
    """Return what in an MP4 file's settings says that the camera stabilised, else nothing."""
    try:
        with path.open('rb') as file:
            settings = next(inside(index_of(file), b'udta', b'GPMF'), b'')
        for _, device in items(settings):
            said = dict(items(device.content)) if device.kind == NEST else {}
            if 'EISE' in said and said['EISE'].text() == 'Y':
                kind = said['EISA'].text() if 'EISA' in said else ''
                return f'GoPro, EISE {kind}'.rstrip()
    except (OSError, ValueError):
        pass
    return ''
