# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""
Telemetry of a turning camera, written as cameras write it: GPMF, CAMM, and Insta360's trailer.

Motion is that of a body at the camera (x forward, y left, z up).
"""

from pathlib import Path
from struct import pack

import numpy as np
from scipy.spatial.transform import Rotation

from sph_stab_ros.geometry.conventions import R_BODY_CAMERA, R_CAMERA_BODY
from sph_stab_ros.recording.spherical_boxes import boxes, packed
from sph_stab_ros.recording.telemetry.insta360 import MAGIC

GRAVITY_M_S2 = 9.80665
# Of GPMF's shorts, a unit.
SCALE = 1000


def orientation(t):
    """Return R_world_camera of a smooth motion at times (N,) in seconds."""
    return Rotation.from_euler('YXZ', np.transpose((
        60 * np.sin(0.9 * t), 15 * np.sin(1.7 * t + 1) - 12, 20 * np.sin(1.3 * t + 2))),
        degrees=True)


def body_rates(t):
    """Return what a gyro would measure, (N, 3) in rad/s."""
    h = 1e-4
    turns = orientation(t - h).inv() * orientation(t + h)
    return R_BODY_CAMERA.apply(turns.as_rotvec() / (2 * h))


def body_forces(t):
    """Return what an accelerometer would show of a camera that stays in its place, (N, 3)."""
    up = orientation(t).inv().apply((0., -GRAVITY_M_S2, 0.))
    return R_BODY_CAMERA.apply(up)


def with_track(path, kind, samples, timescale=10**6, settings=b''):
    """Put a track of (time in s, bytes) into an MP4 file, and boxes into its user data."""
    path = Path(path)
    data = path.read_bytes()
    moov = next(box for box in boxes(data) if box.name == b'moov')
    index = data[moov.content:moov.end]
    ticks = [round(time_s * timescale) for time_s, _ in samples]
    lasting = np.diff(ticks, append=2 * ticks[-1] - ticks[-2] if len(ticks) > 1 else timescale)
    sizes = [len(payload) for _, payload in samples]
    empty = bytes(4)
    table = b''.join((
        packed(b'stsd', empty + pack('>I', 1) + packed(kind, bytes(6) + pack('>H', 1))),
        packed(b'stts', empty + pack('>I', len(sizes)) + b''.join(
            pack('>II', 1, int(one)) for one in lasting)),
        packed(b'stsc', empty + pack('>IIII', 1, 1, len(sizes), 1)),
        packed(b'stsz', empty + pack(f'>II{len(sizes)}I', 0, len(sizes), *sizes)),
        packed(b'co64', empty + pack('>IQ', 1, len(data) + 8))))
    media = packed(b'mdhd', empty + pack('>IIIIHH', 0, 0, timescale, int(sum(lasting)), 0, 0))
    media += packed(b'hdlr', bytes(8) + b'meta' + bytes(12) + b'a camera\0')
    media += packed(b'minf', packed(b'nmhd', empty) + packed(b'dinf', packed(
        b'dref', empty + pack('>I', 1) + packed(b'url ', pack('>I', 1)))) + packed(b'stbl', table))
    header = empty + pack('>IIII', 0, 0, 99, 0) + bytes(64)
    track = packed(b'trak', packed(b'tkhd', header) + packed(b'mdia', media))
    # The old index stays behind as free space, so that no picture moves.
    path.write_bytes(b''.join((
        data[:moov.start + 4], b'free', data[moov.start + 8:],
        packed(b'mdat', b''.join(payload for _, payload in samples)),
        packed(b'moov', index + track + (packed(b'udta', settings) if settings else b'')))))
    return path


def item(key, kind, values, columns=1):
    """Return a record of GPMF: of text, of nested records, or of numbers."""
    if kind == 'c':
        content, size, repeat = values.encode(), len(values), 1
    elif kind == '\0':
        content, size, repeat = values, 1, len(values)
    else:
        content = np.asarray(values).astype({'s': '>i2', 'L': '>u4', 'J': '>u8', 'f': '>f4'}[kind])
        size, repeat = content.itemsize * columns, content.size // columns
        content = content.tobytes()
    return (key.encode() + kind.encode() + bytes([size]) + pack('>H', repeat) + content
            + bytes(-len(content) % 4))


def gopro(t, rates, forces, order='XzY', stamps=True, device='GoPro Max', says_order=True,
          name=''):
    """
    Return payloads of a second each, for samples (N, 3) at times (N,); the track knows seconds.

    With ``stamps`` they tell the time of their first sample, on a clock that began earlier.
    """
    def stream(key, vectors, first, last):
        left_back_up = np.column_stack((vectors[:, 1], -vectors[:, 0], vectors[:, 2]))
        channels = np.column_stack([
            left_back_up[:, 'XYZ'.index(one.upper())] * (1 if one.isupper() else -1)
            for one in order])[first:last]
        return item('STRM', '\0', b''.join((
            item('STMP', 'J', round((t[first] + 7) * 1e6)) if stamps else b'',
            item('TSMP', 'L', last), item('ORIN', 'c', order) if says_order else b'',
            item('STNM', 'c', name) if name else b'', item('SCAL', 's', SCALE),
            item(key, 's', np.round(SCALE * channels), 3))))

    payloads = []
    for second in range(int(np.floor(t[-1])) + 1):
        first, last = np.searchsorted(t, (second, second + 1))
        if first == last:
            continue
        exposures = item('STRM', '\0', (item('STMP', 'J', (second + 7) * 10**6) if stamps else b'')
                         + item('SHUT', 'f', [0.01]))
        payloads.append((float(second), item('DEVC', '\0', b''.join((
            item('DVNM', 'c', device), stream('ACCL', forces, first, last),
            stream('GYRO', rates, first, last), exposures)))))
    return payloads


def gopro_settings(stabilized):
    """Return a box with the settings of a recording."""
    return packed(b'GPMF', item('DEVC', '\0', item('DVNM', 'c', 'Global Settings') + item(
        'EISE', 'c', 'Y' if stabilized else 'N') + item('EISA', 'c', 'HS High')))


def camm(t, rates=None, forces=None, R_world_camera=None):
    """Return packets for samples (N, 3) at times (N,), a kind after the other at each."""
    packets = []
    for i, time_s in enumerate(t):
        for kind, vectors in (
                (2, rates), (3, forces),
                (0, R_world_camera and R_BODY_CAMERA.apply(R_world_camera.as_rotvec()))):
            if vectors is not None:
                packets.append((float(time_s), pack(
                    '<HH3f', 0, kind, *R_CAMERA_BODY.apply(vectors[i]))))
    return packets


def insta360(t, rates, forces, raw=False, places=False, stabilized=False, camera='Insta360 X3'):
    """Return a trailer; by its axes (a third version of offsets) x is up, y right, z forward."""
    in_sensor = [np.column_stack((one[:, 2], -one[:, 1], one[:, 0])) for one in (forces, rates)]
    first_ms = 12345
    if raw:
        kind = np.dtype([('t', '<u8'), ('force', '<u2', 3), ('rate', '<u2', 3)])
        unit, scales = 1e6, (32768 / (16 * GRAVITY_M_S2), 32768 / np.deg2rad(2000))
        first = first_ms * 1000
    else:
        kind = np.dtype([('t', '<u8'), ('force', '<f8', 3), ('rate', '<f8', 3)])
        unit, scales, first = 1e3, (1 / GRAVITY_M_S2, 1), first_ms
    samples = np.zeros(len(t), kind)
    samples['t'] = np.round(np.asarray(t) * unit) + first
    for name, vectors, scale in zip(('force', 'rate'), in_sensor, scales):
        samples[name] = np.round(32768 + scale * vectors) if raw else scale * vectors
    offset = '_'.join(['1'] * 21)
    about = b''.join((
        field(2, camera.encode()), field(24, first), field(42, int(stabilized)),
        field(54, offset.encode()), field(62, int(raw)),
        field(65, field(1, 16) + field(2, 2000))))
    records, listed = b'', b''
    for number, content in ((1, about), (3, samples.tobytes())):
        listed += pack('<BBII', number, 0, len(content), len(records))
        records += content + pack('<BBI', 0, number, len(content))
    if places:
        records += listed + pack('<BBI', 0, 0, len(listed))
    size = len(records) + 72
    return records + bytes(32) + pack('<II', size, 3) + MAGIC


def field(number, value):
    """Return a field of a protocol buffer, an integer or bytes."""
    if isinstance(value, int):
        return varint(number << 3) + varint(value)
    return varint(number << 3 | 2) + varint(len(value)) + value


def varint(value):
    """Return an integer in bytes of seven bits."""
    data = bytearray()
    while value > 0x7f:
        data.append(value & 0x7f | 0x80)
        value >>= 7
    return bytes(data + bytes([value]))
