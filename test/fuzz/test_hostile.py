# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""
Small files that were made to take all memory or all time: they end in a line, and soon.

Each is tried by a process that may have so much memory; a process that hangs is killed.
"""

import io
import os
import resource
import sqlite3
import struct
import subprocess
import sys
import zlib

from backports import zstd
import cv2
import lz4.frame
import numpy as np
import pytest
from rosbags.typesys import get_typestore, Stores
import small_bags
from sph_stab_ros.geometry.trajectory import read_tum

# Of what a process maps; half of it are libraries.
ADDRESS_SPACE = 2 * 2**30 + 2**29
HANG_S = 120
MIB = 2**20
TOPICS = ('CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT)',
          f"INSERT INTO topics VALUES(1, '/a', '{small_bags.COMPRESSED_IMAGE}')")
MESSAGES = 'CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id, timestamp, data BLOB{})'
FOREVER = 'WITH RECURSIVE c(n) AS (VALUES(1) UNION ALL SELECT n + 1 FROM c)'


def limit_memory():
    resource.setrlimit(resource.RLIMIT_AS, (ADDRESS_SPACE, ADDRESS_SPACE))


def ended(*argv, module='replay'):
    """Run a tool; return its exit status and its own lines on stderr."""
    process = subprocess.run(
        [sys.executable, '-m', f'sph_stab_ros.{module}', *map(str, argv)], text=True,
        capture_output=True, timeout=HANG_S, preexec_fn=limit_memory,
        env={**os.environ, 'OMP_NUM_THREADS': '1'})
    assert 'Traceback' not in process.stderr, process.stderr[-2000:]
    return process.returncode, [line for line in process.stderr.splitlines()
                                if line.startswith(f'{module}: ')]


def zeros(count, compression):
    """Return so many bytes of nothing, compressed."""
    packed, nothing = io.BytesIO(), bytes(MIB)
    stream = (zstd.ZstdFile(packed, 'w') if compression == 'zstd'
              else lz4.frame.open(packed, 'wb'))
    with stream:
        for _ in range(count // MIB):
            stream.write(nothing)
    return packed.getvalue()


def mcap_chunk(packed, compression, size):
    return small_bags.MCAP_MAGIC + small_bags.record(1, bytes(8)) + small_bags.record(
        6, struct.pack('<QQQI', 0, 0, size, 0) + small_bags.text(compression) +
        struct.pack('<Q', len(packed)) + packed)


def rosbag1_record(content, **fields):
    head = b''.join(struct.pack('<I', len(name) + 1 + len(value)) + name.encode() + b'=' + value
                    for name, value in fields.items())
    return struct.pack('<I', len(head)) + head + struct.pack('<I', len(content)) + content


ROSBAG1 = b'#ROSBAG V2.0\n' + rosbag1_record(
    b' ' * 100, op=b'\3', index_pos=bytes(8), conn_count=bytes(4), chunk_count=bytes(4))


def bag_of_picture(data):
    """Return an MCAP file with one CompressedImage."""
    types = get_typestore(Stores.ROS2_JAZZY)
    make = types.types
    msg = make[small_bags.COMPRESSED_IMAGE](
        header=make['std_msgs/msg/Header'](
            frame_id='', stamp=make['builtin_interfaces/msg/Time'](5, 0)),
        format='', data=np.frombuffer(data, np.uint8))
    encoded = bytes(types.serialize_cdr(msg, small_bags.COMPRESSED_IMAGE))
    return small_bags.mcap([(5, encoded)], compression='', per_chunk=1).data


def png(width, height, rows=None):
    """Return a black PNG file, or the first rows of it."""
    def part(name, data):
        return struct.pack('>I', len(data)) + name + data + struct.pack('>I', zlib.crc32(
            name + data))
    packer, row = zlib.compressobj(9), bytes(1 + 3 * width)
    data = b''.join(packer.compress(row) for _ in range(rows or height)) + packer.flush()
    return (b'\x89PNG\r\n\x1a\n' + part(b'IHDR', struct.pack(
        '>IIBBBBB', width, height, 8, 2, 0, 0, 0)) + part(b'IDAT', data) + part(b'IEND', b''))


def jpeg(width, height):
    """Return a JPEG file that says it is that large."""
    data = bytearray(cv2.imencode('.jpg', np.zeros((64, 128, 3), np.uint8))[1])
    at = data.find(b'\xff\xc0')
    data[at + 5:at + 9] = struct.pack('>HH', height, width)
    return bytes(data)


def many_scans():
    """Return a progressive JPEG file that goes over its picture three thousand times."""
    data = cv2.imencode('.jpg', np.zeros((2000, 4000, 3), np.uint8),
                        (cv2.IMWRITE_JPEG_PROGRESSIVE, 1))[1].tobytes()
    scan = data[data.rfind(b'\xff\xda'):-2]
    return data[:-2] + 3000 * scan + data[-2:]


def channel_heads():
    """Return what looks like the beginning of a channel again and again, each 3 MiB long."""
    head = struct.pack('<BQ', 4, 3 * MIB) + b'\1\0\1\0' + struct.pack('<I', 3) + b'/ab'
    return small_bags.MCAP_MAGIC + b'\xff' * 20 + head * (6 * MIB // len(head))


def chunk_heads():
    """Return the beginning of a chunk again and again, each longer than the file."""
    head = struct.pack('<QQQI', 0, 0, 10**9, 0) + small_bags.text('zstd')
    record = struct.pack('<BQ', 6, len(head) + 8 + 10**9) + head + struct.pack('<Q', 10**9)
    return small_bags.MCAP_MAGIC + small_bags.record(1, bytes(8)) + record * (
        6 * MIB // len(record))


def tiny_records():
    """Return a chunk of sixty million records of nothing."""
    nothing = small_bags.record(0x80, b'') * (MIB // 9)
    packed = io.BytesIO()
    with zstd.ZstdFile(packed, 'w') as stream:
        for _ in range(500):
            stream.write(nothing)
    return mcap_chunk(packed.getvalue(), 'zstd', 500 * len(nothing))


NOT_A_BAG, LEFT_OUT = 'is not a readable bag', 'has no usable picture'
FILES = {
    'a chunk that lies': (lambda: mcap_chunk(zeros(3000 * MIB, 'zstd'), 'zstd', 999), NOT_A_BAG),
    'a chunk of 3 GB': (
        lambda: mcap_chunk(zeros(3000 * MIB, 'zstd'), 'zstd', 3000 * MIB), NOT_A_BAG),
    'the same by lz4': (lambda: mcap_chunk(zeros(3000 * MIB, 'lz4'), 'lz4', 999), NOT_A_BAG),
    'a chunk of ROS 1': (lambda: ROSBAG1 + rosbag1_record(
        zeros(3000 * MIB, 'lz4'), op=b'\5', compression=b'lz4', size=struct.pack('<I', 999)),
        NOT_A_BAG),
    'a chunk of nothing': (tiny_records, NOT_A_BAG),
    'a message': (lambda: small_bags.mcap(
        [(5, zeros(3000 * MIB, 'zstd'))], compression='', per_chunk=1).data, LEFT_OUT),
    'a PNG': (lambda: bag_of_picture(png(32000, 16000, 2000)), LEFT_OUT),
    'a larger PNG': (lambda: bag_of_picture(png(60000, 30000, 100)), LEFT_OUT),
    'a JPEG': (lambda: bag_of_picture(jpeg(65000, 32500)), LEFT_OUT),
    'a JPEG of many scans': (lambda: bag_of_picture(many_scans()), LEFT_OUT),
    'heads of channels': (channel_heads, NOT_A_BAG),
    'heads of chunks': (chunk_heads, NOT_A_BAG),
    'operations of ROS 1': (
        lambda: ROSBAG1 + b'\xff' * 20 + b'\4\0\0\0op=\2' * (6 * MIB // 8), NOT_A_BAG),
}


@pytest.mark.parametrize('kind', FILES)
def test_a_file_that_was_made_to_mislead_is_refused(tmp_path, kind):
    make, reason = FILES[kind]
    path = tmp_path / 'file'
    path.write_bytes(make())
    status, lines = ended(path)
    assert status == 1
    assert reason in lines[-1]


@pytest.mark.parametrize('statements', [
    (*TOPICS, f'CREATE VIEW messages AS {FOREVER} SELECT n AS id, 1 AS topic_id, 5 AS timestamp, '
              "x'00' AS data FROM c"),
    (f"CREATE VIEW topics AS {FOREVER} SELECT n AS id, '/a' || n AS name, "
     f"'{small_bags.COMPRESSED_IMAGE}' AS type FROM c", MESSAGES.format('')),
    (*TOPICS, MESSAGES.format(' GENERATED ALWAYS AS (zeroblob(900000000)) VIRTUAL'),
     'INSERT INTO messages(id, topic_id, timestamp) VALUES(1, 1, 5), (2, 1, 6)'),
    ('CREATE TABLE topics(id, name, type)', "INSERT INTO topics VALUES('x', 5, NULL)",
     MESSAGES.format(''), "INSERT INTO messages VALUES(1, 'x', 'y', 7)"),
    ('CREATE TABLE topics(id, name, type)', TOPICS[1],
     'CREATE TABLE messages(id, topic_id, timestamp, data)',
     "INSERT INTO messages VALUES('x', 1, 5, x'00'), (x'01', 1, 5, x'00'), (NULL, 1, 5, x'00')"),
], ids=['messages without end', 'topics without end', 'computed data', 'other types', 'no ids'])
def test_tables_that_were_made_up(tmp_path, statements):
    with sqlite3.connect(tmp_path / 'bag.db3') as database:
        for statement in statements:
            database.execute(statement)
    database.close()
    status, lines = ended(tmp_path / 'bag.db3')
    assert status == 1 and len(lines) >= 1


NESTED = 20_000
PARAMETERS = {
    'aliases': ('/**:\n  ros__parameters:\n    a0: &a0 [x, x, x, x, x, x, x, x, x, x]\n' + ''.join(
        f'    a{n}: &a{n} [{", ".join([f"*a{n - 1}"] * 10)}]\n' for n in range(1, 10)),
        'an alias of line'),
    'a circle': ('/**:\n  ros__parameters: &a\n    b: *a\n', 'an alias of line'),
    'lists in lists': ('[' * NESTED, 'nested too deeply'),
    'mappings in mappings': ('{' * NESTED, 'nested too deeply'),
    'digits': ('/**:\n  ros__parameters:\n    working_width: ' + '1' * 5000, 'working_width'),
    'names that are none': ('/**:\n  ros__parameters:\n    ? [a]\n    : 1\n', 'no name in line'),
    'a large file': ('# ' + 'x' * 2**21, 'no file of parameters is that large'),
}


@pytest.mark.parametrize('kind', PARAMETERS)
def test_parameters_that_were_made_to_mislead(tmp_path, kind):
    text, reason = PARAMETERS[kind]
    (tmp_path / 'file.yaml').write_text(text)
    status, (line,) = ended('bag', '--params-file', tmp_path / 'file.yaml')
    assert status == 2 and reason in line


def test_metadata_that_were_made_to_mislead(tmp_path):
    path = small_bags.sqlite(tmp_path / 'bag', small_bags.image_messages(2, width=128))
    lists = ''.join(f'a{n}: &a{n} [{", ".join([f"*a{n - 1}"] * 10)}]\n' for n in range(1, 12))
    (path.parent / 'metadata.yaml').write_text(
        'a0: &a0 [x, x]\n' + lists +
        'rosbag2_bagfile_information:\n  relative_file_paths: [*a11]\n')
    status, _ = ended(path.parent)
    assert status == 0


def test_an_index_that_counts_what_is_not_there(tmp_path):
    messages = small_bags.image_messages(12, width=256)
    data = bytearray(small_bags.mcap(messages, checksums=False).data)
    statistics = data.rfind(struct.pack('<BQ', 11, 56))
    for at in (9, 57):
        data[statistics + at:statistics + at + 8] = struct.pack('<Q', 2**50)
    (tmp_path / 'bag.mcap').write_bytes(data)
    assert ended(tmp_path / 'bag.mcap') == (0, [])
    status, _ = ended(tmp_path / 'bag.mcap', '--inject', 1, '--estimators', 'anchored',
                      module='evaluate')
    assert status == 0


@pytest.mark.parametrize('stamp', ['1e999999999', '-1e999999', 'inf', 'nan', 'sNaN', '1e11'])
def test_stamps_beyond_all_clocks(tmp_path, stamp):
    (tmp_path / 'a.tum').write_text(f'{stamp} 0 0 0 0 0 0 1\n')
    with pytest.raises(ValueError, match='line 1: not "stamp'):
        read_tum(tmp_path / 'a.tum')
