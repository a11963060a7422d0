# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""
Insta360's telemetry: records behind the end of the video, told by the last bytes of the file.

There is no specification. Layout, units and axes are those that telemetry-parser has found out
(github.com/AdrianEddy/telemetry-parser, src/insta360). The trailer ends with 32 bytes, its size
and version, and 32 letters. Before these lie records, each with six bytes behind it: format, kind,
and size. Where the last one is of kind 0 it lists where the others are. Record 1 is a protocol
buffer about camera and recording; record 3 the samples: a time, three of the accelerometer in g,
and three of the gyro in rad/s.
"""

from collections.abc import Iterator
from io import SEEK_END
from pathlib import Path
import struct
from typing import BinaryIO, NamedTuple

import numpy as np

from sph_stab_ros.geometry.arrays import Floats, Raster
from sph_stab_ros.recording.base import RecordingError
from sph_stab_ros.recording.telemetry.base import check_count, series, single, Telemetry

MAGIC = b'8db42d694ccc418790edff439fe026bf'
FOOTER_BYTES = 72
RECORD_FOOTER_BYTES = 6
PLACES, METADATA, SAMPLES = 0, 1, 3
# In the list of places: kind, format, size, and the distance from the trailer's beginning.
PLACE = struct.Struct('<BBII')
MAX_METADATA_BYTES = 2**24
MAX_RECORDS = 1000
GRAVITY_M_S2 = 9.80665
PLAIN = np.dtype([('time', '<u8'), ('force', '<f8', 3), ('rate', '<f8', 3)])
# As the sensor counts, with a bias of half the range.
RAW = np.dtype([('time', '<u8'), ('force', '<u2', 3), ('rate', '<u2', 3)])
RAW_ZERO = 2**15
RANGE_G, RANGE_DEG_S = 16., 2000.
# Numbers of fields in the protocol buffer.
CAMERA, FIRST_PICTURE, GYRO_TIME, HAS_GYRO_TIME, STABILIZED, OFFSET_V3, IS_RAW, RANGES = (
    2, 24, 28, 29, 42, 54, 62, 65)
# Which of the sensor's axes point up, to the left and backwards; small letters for the opposite.
# Newer files, with a third version of the lenses' offsets, have other axes.
AXES = {'Insta360 Go': 'xyZ', 'Insta360 GO 2': 'yXZ', 'Insta360 OneR': 'yXZ',
        'Insta360 OneRS': 'yxz', 'Insta360 ONE X2': 'xZy'}
AXES_V3 = {'Insta360 GO 2': 'XYZ', 'Insta360 GO 3': 'XYZ', 'Insta360 GO 3S': 'yXZ',
           'Insta360 GO Ultra': 'YxZ', 'Insta360 X4': 'yzX', 'Insta360 X5': 'yzX'}
OTHER_AXES, OTHER_AXES_V3 = 'yXZ', 'Xyz'


class Record(NamedTuple):
    """What is where in the file."""

    kind: int
    start: int
    size: int


def is_trailed(path: Path) -> bool:
    """Tell whether a file ends as Insta360's do."""
    try:
        with path.open('rb') as file:
            file.seek(-min(len(MAGIC), file.seek(0, SEEK_END)), SEEK_END)
            return file.read() == MAGIC
    except OSError:
        return False


def read(path: Path) -> Telemetry:
    """Return the Telemetry of a file with a trailer; RecordingError where it is damaged."""
    try:
        with path.open('rb') as file:
            found = {record.kind: record for record in records(file)}
            about = metadata(file, found)
            if SAMPLES not in found:
                return Telemetry(_source(about))
            kind = RAW if about.get(IS_RAW) else PLAIN
            check_count(count := found[SAMPLES].size // kind.itemsize)
            file.seek(found[SAMPLES].start)
            samples = np.frombuffer(file.read(count * kind.itemsize), kind)
            return decoded(samples, about)
    except (OSError, ValueError, struct.error) as error:
        raise RecordingError(f'{path}: its Insta360 trailer is damaged: {error}') from None


def decoded(samples: Raster, about: dict[int, int | bytes]) -> Telemetry:
    """Return the Telemetry of samples as they are in the file."""
    times_s = (samples['time'].astype(float) - _number(about, FIRST_PICTURE)) / 1e3
    forces, rates = samples['force'].astype(float), samples['rate'].astype(float)
    if samples.dtype == RAW:
        times_s /= 1e3
        ranges = dict(fields(_bytes(about, RANGES)))
        range_g = _number(ranges, 1) or RANGE_G
        range_deg_s = _number(ranges, 2) or RANGE_DEG_S
        forces = (forces - RAW_ZERO) / RAW_ZERO * range_g
        rates = np.deg2rad((rates - RAW_ZERO) / RAW_ZERO * range_deg_s)
    if about.get(HAS_GYRO_TIME):
        times_s -= struct.unpack('<d', _number(about, GYRO_TIME).to_bytes(8, 'little'))[0] / 1e3
    axes = _axes(about)
    return Telemetry(_source(about), series(times_s, _in_body(rates, axes)),
                     series(times_s, GRAVITY_M_S2 * _in_body(forces, axes)))


def records(file: BinaryIO) -> Iterator[Record]:
    """Yield the records of a trailer, the last one first; ValueError where it is damaged."""
    end = file.seek(0, SEEK_END) - FOOTER_BYTES
    if end < 0:
        raise ValueError('it is cut short')
    file.seek(end + 32)
    size, = struct.unpack('<I', file.read(4))
    begin = max(end + FOOTER_BYTES - size, 0)
    for _ in range(MAX_RECORDS):
        if end - RECORD_FOOTER_BYTES < begin:
            return
        file.seek(end - RECORD_FOOTER_BYTES)
        _, kind, size = struct.unpack('<BBI', file.read(RECORD_FOOTER_BYTES))
        start = end - RECORD_FOOTER_BYTES - size
        if start < begin:
            raise ValueError('a record is larger than the trailer')
        if kind == PLACES and size:
            file.seek(start)
            places = file.read(min(size, PLACE.size * MAX_RECORDS))
            yield from (Record(kind, begin + offset, size) for kind, _, size, offset
                        in PLACE.iter_unpack(places) if kind != PLACES)
            return
        yield Record(kind, start, size)
        end = start


def metadata(file: BinaryIO, found: dict[int, Record]) -> dict[int, int | bytes]:
    """Return the fields of the record about camera and recording, by their numbers."""
    if METADATA not in found:
        return {}
    file.seek(found[METADATA].start)
    return dict(fields(file.read(min(found[METADATA].size, MAX_METADATA_BYTES))))


def fields(data: bytes) -> Iterator[tuple[int, int | bytes]]:
    """Yield number and value of the fields of a protocol buffer; ValueError where it is none."""
    place = 0

    def taken(count: int) -> bytes:
        nonlocal place
        place += count
        if place > len(data):
            raise ValueError('a field is cut short')
        return data[place - count:place]

    def varint() -> int:
        value = 0
        for shift in range(0, 70, 7):
            byte = taken(1)[0]
            value |= (byte & 0x7f) << shift
            if byte < 0x80:
                return value % 2**64
        raise ValueError('a number has no end')

    while place < len(data):
        number, wire = divmod(varint(), 8)
        if wire == 0:
            yield number, varint()
        elif wire in (1, 5):
            yield number, int.from_bytes(taken(8 if wire == 1 else 4), 'little')
        elif wire == 2:
            yield number, taken(varint())
        else:
            raise ValueError('a field is of no known type')


def stabilized_by(path: Path) -> str:
    """Return what in a trailer says that the camera stabilised, else nothing."""
    try:
        with path.open('rb') as file:
            about = metadata(file, {record.kind: record for record in records(file)})
    except (OSError, ValueError, struct.error):
        return ''
    return 'Insta360, FlowState in the camera' if about.get(STABILIZED) else ''


def _number(about: dict[int, int | bytes], field: int) -> int:
    value = about.get(field, 0)
    return value if isinstance(value, int) else 0


def _bytes(about: dict[int, int | bytes], field: int) -> bytes:
    value = about.get(field, b'')
    return value if isinstance(value, bytes) else b''


def _source(about: dict[int, int | bytes]) -> str:
    return _bytes(about, CAMERA).decode('utf-8', 'replace') or 'Insta360, unnamed camera'


def _axes(about: dict[int, int | bytes]) -> str:
    camera = _source(about)
    # Twenty numbers or more.
    if _bytes(about, OFFSET_V3).count(b'_') >= 19:
        return AXES_V3.get(camera, OTHER_AXES_V3)
    return AXES.get(camera, OTHER_AXES)


def _in_body(vectors: Floats, axes: str) -> Floats:
    up, left, back = (vectors[:, 'XYZ'.index(one.upper())] * (1 if one.isupper() else -1)
                      for one in axes)
    return single(np.column_stack((-back, left, up)))
