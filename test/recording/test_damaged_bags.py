# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
"""Whatever happened to a bag: all that is whole comes out, before the damage and behind."""

from contextlib import suppress
import sqlite3

import numpy as np
import pytest
from small_bags import (
    image_messages, mcap, overwritten, random_places, rosbag1, sqlite)
from sph_stab_ros.recording import open_recording, RecordingError
from sph_stab_ros.recording.containers import Containers
from tiny_recordings import IMAGE_TOPIC, stamps_of

COUNT = 24
MCAP_KINDS = {
    'plain': {'compression': ''}, 'lz4': {'compression': 'lz4'}, 'zstd': {},
    'without_checksums': {'compression': 'zstd', 'checksums': False},
    'without_index': {'index': False}, 'without_chunks': {'per_chunk': 0}}


@pytest.fixture(scope='module')
def messages():
    return image_messages(COUNT)


@pytest.fixture(scope='module')
def messages_ros1():
    return image_messages(COUNT, generation=1)


def read(path):
    """Return (time of receipt, data) of what is read, and what was found damaged."""
    damage = []
    containers = Containers(path)
    # Without checksums nothing tells that the name of a topic is damaged.
    topics = {channel.topic for channel in containers.channels} or {IMAGE_TOPIC}
    return [(received_ns, data) for topic in topics
            for _, received_ns, data in containers.messages(topic, damage)], damage


def is_subsequence(some, others):
    """Tell whether ``some`` stand among the others, in this order."""
    others = iter(others)
    return all(one in others for one in some)


def check_overwritten(path, written, messages, seed, places, first=0):
    """Eight bytes changed anywhere (from ``first`` on) cost only the chunk that they are in."""
    rng, positions = random_places(seed, len(written.data) - first, places)
    for at in (first + one for one in positions):
        path.write_bytes(overwritten(written.data, at, rng))
        found, damage = read(path)
        outside = written.untouched(messages, at, at + 7)
        assert is_subsequence(outside, found), at
        assert len(outside) == COUNT or damage or len(found) == COUNT, at


@pytest.mark.parametrize('kind', MCAP_KINDS)
def test_overwritten_mcap(kind, messages, tmp_path):
    written = mcap(messages, **MCAP_KINDS[kind])
    path = tmp_path / 'bag.mcap'
    path.write_bytes(written.data)
    assert read(path)[0] == messages
    # Without an index the first chunk is the only one that says what the messages are.
    check_overwritten(
        path, written, messages, 1, 160, written.spans[1][0] if kind == 'without_index' else 0)


@pytest.mark.parametrize('compression', [None, 'bz2', 'lz4'])
def test_overwritten_ros1(compression, messages_ros1, tmp_path):
    path = tmp_path / 'written.bag'
    written = rosbag1(path, messages_ros1, compression)
    assert len(written.spans) > 4
    assert read(path) == (messages_ros1, [])
    check_overwritten(tmp_path / 'bag.bag', written, messages_ros1, 2, 160)


@pytest.mark.parametrize('kind', MCAP_KINDS)
def test_cut_mcap(kind, messages, tmp_path):
    written = mcap(messages, **MCAP_KINDS[kind])
    check_cut(tmp_path / 'bag.mcap', written, messages, 3)


@pytest.mark.parametrize('compression', [None, 'bz2', 'lz4'])
def test_cut_ros1(compression, messages_ros1, tmp_path):
    written = rosbag1(tmp_path / 'written.bag', messages_ros1, compression)
    check_cut(tmp_path / 'bag.bag', written, messages_ros1, 4)


def check_cut(path, written, messages, seed):
    """Every chunk before the cut comes out whole, and nothing that was not there."""
    for end in random_places(seed, len(written.data), 80)[1]:
        path.write_bytes(written.data[:end])
        try:
            found, _ = read(path)
        except RecordingError:
            found = []
        assert found == messages[:len(found)], end
        assert is_subsequence(written.untouched(messages, end, len(written.data)), found), end


@pytest.mark.parametrize('kind', ['plain', 'zstd'])
@pytest.mark.parametrize('hole', [512, 4096])
def test_lost_sectors_of_a_card(kind, hole, messages, tmp_path):
    """Zeros instead of a sector, or the sector gone: what follows is read."""
    written = mcap(messages, **MCAP_KINDS[kind])
    path = tmp_path / 'bag.mcap'
    for first in range(512, len(written.data) - hole, 3 * 512):
        outside = written.untouched(messages, first, first + hole - 1)
        for instead in (bytes(hole), b''):
            path.write_bytes(written.data[:first] + instead + written.data[first + hole:])
            found, _ = read(path)
            assert is_subsequence(outside, found), (first, len(instead))


@pytest.mark.parametrize('per_chunk', [0, 1, 3])
@pytest.mark.parametrize('darkness', [0., 0.8, 1.])
def test_raw_pictures_are_not_taken_for_records(per_chunk, darkness, tmp_path):
    """In the dark they are full of small numbers and zeros, as the heads of records are."""
    rng, _ = random_places(7, 1, 1)
    messages = [(ns, (rng.integers(0, 16, 40_000) * (rng.random(40_000) > darkness)
                      ).astype(np.uint8).tobytes()) for ns in stamps_of(COUNT).tolist()]
    written = mcap(messages, compression='', per_chunk=per_chunk)
    for at in rng.integers(0, len(written.data), 30).tolist():
        hole = bytes(int(rng.integers(8, 50_000)))
        data = written.data[:at] + hole + written.data[at + len(hole):]
        (tmp_path / 'bag').write_bytes(data[:len(written.data)])
        found, _ = read(tmp_path / 'bag')
        outside = written.untouched(messages, at, at + len(hole) - 1)
        # Where the definitions are lost, and the index with them, nothing can be read.
        assert is_subsequence(outside, found) or not found and len(hole) > at, at


def test_damaged_pages_of_sqlite(messages, tmp_path):
    """Overwritten pages cost the rows that they hold; those before and behind are read."""
    file = sqlite(tmp_path / 'bag', messages)
    data = file.read_bytes()
    page_bytes = int.from_bytes(data[16:18], 'big')
    with sqlite3.connect(file) as database:
        first_page, = database.execute(
            "SELECT max(rootpage) FROM sqlite_master WHERE name != 'messages'").fetchone()
    rng, _ = random_places(6, 1, 1)
    most = 0
    # Of small messages many stand in a page; the first pages say what tables there are.
    for page in range(first_page + 1, len(data) // page_bytes):
        file.write_bytes(overwritten(data, page * page_bytes, rng, page_bytes))
        found, damage = read(file)
        lost = [one for one in messages if one not in found]
        assert damage or not lost
        assert is_subsequence(found, messages) or damage
        most = max(most, len(lost))
    assert 0 < most < COUNT / 2


@pytest.mark.parametrize('seed', range(40))
def test_nothing_ends_in_a_traceback(seed, messages, messages_ros1, tmp_path):
    """Any number of changed, lost and inserted bytes, under any name."""
    rng, _ = random_places(seed, 1, 1)
    file = tmp_path / ('bag', 'bag.mcap', 'bag.bag', 'bag.db3', 'bag.mcap.zstd')[seed % 5]
    rosbag1(tmp_path / 'one.ros', messages_ros1)
    for data in (
            mcap(messages).data, mcap(messages, compression='').data,
            (tmp_path / 'one.ros').read_bytes(), sqlite(tmp_path / 'x', messages).read_bytes()):
        for _ in range(int(rng.integers(1, 12))):
            at = int(rng.integers(len(data)))
            count = int(rng.integers(1, 200))
            data = (overwritten(data, at, rng, count), data[:at] + data[at + count:],
                    data[:at] + rng.bytes(count) + data[at:])[int(rng.integers(3))]
        file.write_bytes(data)
        with suppress(RecordingError):
            for _ in open_recording(file).frames():
                pass
