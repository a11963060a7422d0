# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
"""What a recording is, is told by its content: any name, parts, compression, logs beside it."""

import bz2
import gzip
import hashlib
import lzma
import os
import shutil
import sqlite3
import tempfile

from backports import zstd
import lz4.frame
import pytest
from rosbags.rosbag2 import StoragePlugin, Writer as Rosbag2Writer
from rosbags.rosbag2.enums import CompressionFormat, CompressionMode
from rosbags.typesys import get_typestore, Stores
from small_bags import COMPRESSED_IMAGE, image_messages, mcap, rosbag1, sqlite
from sph_stab_ros.recording import open_recording, RecordingError
from tiny_recordings import IMAGE_TOPIC, stamps_of

COUNT = 12
STAMPS_NS = stamps_of(COUNT).tolist()
PACK = {'.zstd': zstd.compress, '.lz4': lz4.frame.compress, '.gz': gzip.compress,
        '.bz2': bz2.compress, '.xz': lzma.compress}


@pytest.fixture(scope='module')
def messages():
    return image_messages(COUNT)


@pytest.fixture(scope='module')
def bag_bytes(messages, tmp_path_factory):
    """Return a bag of each kind as bytes."""
    folder = tmp_path_factory.mktemp('bags')
    rosbag1(folder / 'one.bag', image_messages(COUNT, generation=1))
    return {'mcap': mcap(messages).data, 'ros1': (folder / 'one.bag').read_bytes(),
            'sqlite': sqlite(folder / 'two', messages).read_bytes()}


def stamps_in(path):
    """Return the stamps of the frames of a recording."""
    return [frame.stamp_ns for frame in open_recording(path).frames()]


def fingerprint(folder):
    """Return what a folder holds, names and bytes."""
    return {str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
            for path in sorted(folder.rglob('*')) if path.is_file()}


@pytest.mark.parametrize('kind', ['mcap', 'ros1', 'sqlite'])
@pytest.mark.parametrize('name', ['bag', 'a.bag.active', 'a.mcap.active', 'a.mp4', 'a.db3', 'a.x'])
def test_any_name_will_do(kind, name, bag_bytes, tmp_path, caplog):
    (tmp_path / name).write_bytes(bag_bytes[kind])
    assert stamps_in(tmp_path / name) == STAMPS_NS
    assert not caplog.records


@pytest.mark.parametrize('pack', PACK)
@pytest.mark.parametrize('kind', ['mcap', 'ros1', 'sqlite'])
@pytest.mark.parametrize('streams', [1, 3])
def test_compressed_files_are_read(pack, kind, streams, bag_bytes, tmp_path, monkeypatch):
    """Also of several streams one behind the other; what was unpacked does not stay."""
    monkeypatch.setattr(tempfile, 'tempdir', str(tmp_path / 'temporary'))
    (tmp_path / 'temporary').mkdir()
    path, data = tmp_path / f'bag{pack}', bag_bytes[kind]
    step = -(-len(data) // streams)
    path.write_bytes(b''.join(
        PACK[pack](data[first:first + step]) for first in range(0, len(data), step)))
    assert stamps_in(path) == STAMPS_NS
    assert not any((tmp_path / 'temporary').iterdir())


@pytest.mark.parametrize('pack', PACK)
def test_of_a_compressed_file_cut_short_the_first_part_is_read(
        pack, messages, tmp_path, caplog):
    # Large enough for several blocks of each compression.
    many = [(ns + 10**9 * turn, data) for turn in range(300) for ns, data in messages]
    data = PACK[pack](mcap(many, compression='').data)
    (tmp_path / 'bag').write_bytes(data[:len(data) * 3 // 4])
    found = len(stamps_in(tmp_path / 'bag'))
    assert 0 < found < len(many)
    assert 'truncated' in caplog.text


def write_parts(folder, messages, count, name='rosbag2_{}.mcap'):
    """Write a recording in parts as a recorder does, without metadata."""
    folder.mkdir()
    size = -(-len(messages) // count)
    for number in range(count):
        part = messages[number * size:(number + 1) * size]
        (folder / name.format(number)).write_bytes(mcap(part).data)


def test_parts_come_in_the_order_of_their_times(messages, tmp_path):
    """Not in that of their names: 0, 1, 10, 11, 2."""
    write_parts(tmp_path / 'bag', messages, COUNT)
    assert stamps_in(tmp_path / 'bag') == STAMPS_NS
    assert open_recording(tmp_path / 'bag').frame_count == COUNT


def test_a_part_that_was_never_written_is_told(messages, tmp_path, caplog):
    write_parts(tmp_path / 'bag', messages, 3)
    (tmp_path / 'bag' / 'rosbag2_3.mcap').write_bytes(b'')
    assert stamps_in(tmp_path / 'bag') == STAMPS_NS
    assert 'truncated' in caplog.text


def metadata(*names):
    """Return a minimal metadata.yaml that lists these files."""
    return 'rosbag2_bagfile_information:\n  relative_file_paths:\n' + ''.join(
        f'    - {name}\n' for name in names)


def test_what_the_metadata_do_not_list_is_left_out_and_named(messages, tmp_path, caplog):
    write_parts(tmp_path / 'bag', messages, 3)
    (tmp_path / 'bag' / 'metadata.yaml').write_text(metadata('rosbag2_1.mcap', 'rosbag2_2.mcap'))
    assert stamps_in(tmp_path / 'bag') == STAMPS_NS[4:]
    assert 'rosbag2_0.mcap' in caplog.text


@pytest.mark.parametrize('text', [
    '', 'a: [', '- 1', '\0', metadata('gone.mcap'), 'rosbag2_bagfile_information: {version: 99}'])
def test_metadata_that_are_wrong_are_done_without(text, messages, tmp_path):
    write_parts(tmp_path / 'bag', messages, 3)
    (tmp_path / 'bag' / 'metadata.yaml').write_text(text)
    assert stamps_in(tmp_path / 'bag') == STAMPS_NS


def test_what_was_unpacked_beside_its_archive_is_read_once(messages, tmp_path):
    write_parts(tmp_path / 'bag', messages, 2)
    for file in list((tmp_path / 'bag').iterdir()):
        file.with_name(f'{file.name}.zstd').write_bytes(zstd.compress(file.read_bytes()))
    assert stamps_in(tmp_path / 'bag') == STAMPS_NS


def test_copies_in_a_folder_are_read_once(messages, tmp_path, caplog):
    """As a tool that repairs bags leaves them: the one that was cut, and another one."""
    whole = mcap(messages).data
    (tmp_path / 'a.orig.mcap').write_bytes(whole[:len(whole) // 2])
    (tmp_path / 'a.mcap').write_bytes(whole)
    (tmp_path / 'copy of a.mcap').write_bytes(whole)
    assert stamps_in(tmp_path) == STAMPS_NS
    assert len(caplog.records) == 1 and 'copies' in caplog.text


def test_bags_of_several_kinds_in_a_folder_are_refused(bag_bytes, tmp_path):
    for kind, data in bag_bytes.items():
        (tmp_path / kind).write_bytes(data)
    with pytest.raises(RecordingError, match='several kinds, give one of them: mcap, ros1, sqli'):
        open_recording(tmp_path)


@pytest.mark.parametrize('mode', ['STORAGE', 'FILE', 'MESSAGE'])
@pytest.mark.parametrize('storage', ['MCAP', 'SQLITE3'])
@pytest.mark.parametrize('with_metadata', [True, False])
def test_compression_is_seen_in_the_content(mode, storage, with_metadata, messages, tmp_path):
    """Chunks, whole files or each message: metadata that say so need not be there."""
    if (mode, storage) == ('STORAGE', 'SQLITE3'):
        pytest.skip('SQLite has no compression of its own')
    writer = Rosbag2Writer(tmp_path / 'bag', version=9, storage_plugin=StoragePlugin[storage])
    writer.set_compression(CompressionMode[mode], CompressionFormat.ZSTD)
    with writer:
        connection = writer.add_connection(
            IMAGE_TOPIC, COMPRESSED_IMAGE, typestore=get_typestore(Stores.ROS2_JAZZY))
        for received_ns, data in messages:
            writer.write(connection, received_ns, data)
    if not with_metadata:
        (tmp_path / 'bag' / 'metadata.yaml').unlink()
    assert stamps_in(tmp_path / 'bag') == STAMPS_NS


def killed_recorder(folder, messages, journal_mode):
    """Leave the files of a recorder that is killed, with a log beside the database."""
    file = sqlite(folder.parent / 'written', messages[:4])
    database = sqlite3.connect(file, isolation_level=None)
    database.execute(f'PRAGMA journal_mode={journal_mode}')
    database.execute('PRAGMA cache_size=2')
    insert = 'INSERT INTO messages (topic_id, timestamp, data) VALUES (1, ?, ?)'
    if journal_mode == 'WAL':
        database.executemany(insert, messages[4:])
    else:
        # A transaction under way, which has reached the file in part.
        database.execute('BEGIN')
        database.execute('DELETE FROM messages')
        database.executemany(insert, 20 * messages)
    folder.mkdir()
    for one in file.parent.glob('*.db3*'):
        shutil.copy(one, folder)
    database.close()
    return folder / file.name


@pytest.mark.parametrize('bare', [True, False])
@pytest.mark.parametrize('with_shm', [True, False])
def test_a_write_ahead_log_is_read_and_nothing_is_changed(
        bare, with_shm, messages, tmp_path):
    """As on read-only media: nothing beside the recording is written, not for a moment."""
    folder = tmp_path / 'bag'
    file = killed_recorder(folder, messages, 'WAL')
    assert file.with_name(f'{file.name}-wal').stat().st_size
    if not with_shm:
        file.with_name(f'{file.name}-shm').unlink()
    before = fingerprint(folder)
    changed_ns = folder.stat().st_mtime_ns
    for one in (*folder.iterdir(), folder):
        one.chmod(one.stat().st_mode & ~0o222)
    assert stamps_in(file if bare else folder) == STAMPS_NS
    assert fingerprint(folder) == before
    # A file made and removed in between would show here.
    assert folder.stat().st_mtime_ns == changed_ns


def test_a_transaction_under_way_is_taken_back(messages, tmp_path):
    file = killed_recorder(tmp_path / 'bag', messages, 'DELETE')
    assert file.with_name(f'{file.name}-journal').stat().st_size
    before = fingerprint(tmp_path / 'bag')
    assert stamps_in(file) == STAMPS_NS[:4]
    assert fingerprint(tmp_path / 'bag') == before


@pytest.mark.parametrize('index', [True, False])
def test_ros1_messages_in_mcap(index, tmp_path):
    """As other tools convert bags: names of types as ROS 1 has them, messages left as they are."""
    (tmp_path / 'bag.mcap').write_bytes(mcap(
        image_messages(COUNT, generation=1), profile='ros1', msgtype='sensor_msgs/CompressedImage',
        encoding='ros1', index=index).data)
    recording = open_recording(tmp_path / 'bag.mcap')
    assert recording.topics == {IMAGE_TOPIC: COMPRESSED_IMAGE}
    assert [frame.stamp_ns for frame in recording.frames()] == STAMPS_NS
    assert {frame.frame_id for frame in recording.frames()} == {'theta_camera'}


@pytest.mark.parametrize('profile', ['', 'ros2', 'x-robot'])
def test_any_profile_of_mcap(profile, messages, tmp_path):
    (tmp_path / 'bag.mcap').write_bytes(mcap(messages, profile=profile).data)
    assert stamps_in(tmp_path / 'bag.mcap') == STAMPS_NS


def test_messages_of_another_encoding_are_refused_by_name(messages, tmp_path):
    (tmp_path / 'bag.mcap').write_bytes(mcap(messages, encoding='json').data)
    with pytest.raises(RecordingError, match='json'):
        stamps_in(tmp_path / 'bag.mcap')
    (tmp_path / 'bag.mcap').write_bytes(mcap(
        messages, encoding='protobuf', msgtype='foxglove.CompressedImage').data)
    with pytest.raises(RecordingError, match='no images; it has .*foxglove.CompressedImage'):
        open_recording(tmp_path / 'bag.mcap')


def test_an_encrypted_bag_is_refused_by_name(bag_bytes, tmp_path):
    data = bag_bytes['ros1']
    field = b'encryptor=rosbag/AesCbcEncryptor'
    size = int.from_bytes(data[13:17], 'little')
    (tmp_path / 'bag.bag').write_bytes(
        data[:13] + (size + 4 + len(field)).to_bytes(4, 'little') + data[17:17 + size] +
        len(field).to_bytes(4, 'little') + field + data[17 + size:])
    with pytest.raises(RecordingError, match='is encrypted by rosbag/AesCbcEncryptor'):
        open_recording(tmp_path / 'bag.bag')


@pytest.mark.parametrize('name', ['a', 'a.bag', 'a.mcap', 'a.db3', 'a.mp4'])
@pytest.mark.parametrize('content, what', [
    (b'', 'empty'), (b'PK\3\4' + bytes(99), 'ZIP'), (b'7z\xbc\xaf\x27\x1c' + bytes(99), '7z'),
    (b'#ROSBAG V1.2\n', 'before 2010'),
    (gzip.compress(b'notes', mtime=0), 'compressed, but not a bag'),
    (b'version https://git-lfs.github.com/spec/v1\n', 'Git LFS'), (b'<!DOCTYPE html>', 'web page'),
    (b'Salted__' + bytes(range(99)), 'encrypted'), (bytes(5000), 'nothing but zeros'),
    (b'rosbag2_bagfile_information:\n', 'give its folder'),
    (b'RIFF\x60\0\0\0WEBPVP8X\n\0\0\0\2' + bytes(99), 'animated WebP')])
def test_what_is_no_recording_is_named(name, content, what, tmp_path):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(RecordingError, match=what) as error:
        open_recording(tmp_path / name)
    assert '\n' not in str(error.value) and name in str(error.value)


@pytest.mark.parametrize('content', [
    os.urandom(5000), b'x', b'\x89MCAP0\r\n', 2 * b'\x89MCAP0\r\n', b'#ROSBAG V2.0\n',
    b'SQLite format 3\0'], ids=['random', 'short', 'mcap', 'mcap_ends', 'ros1', 'sqlite'])
@pytest.mark.parametrize('suffix', ['.bag', '.mcap', '.db3'])
def test_bytes_of_nothing_are_refused(suffix, content, tmp_path):
    """Random ones are what encrypted files look like; the others hold no more than a beginning."""
    (tmp_path / f'a{suffix}').write_bytes(content)
    with pytest.raises(RecordingError, match='holds no messages; damaged, encrypted or'):
        open_recording(tmp_path / f'a{suffix}')


@pytest.mark.parametrize('name, count', [
    ('split_without_metadata/split', 39), ('bag_active/2018-02-16-10-00-00_0.bag.active', 38),
    ('sqlite_wal/killed', 40), ('sqlite_wal/killed/rosbag2_0.db3', 40),
    ('damaged_chunk/flip_good.mcap', 37), ('zstd_messages/nometa', 40),
    ('mcap_zstd/nometa', 40), ('mcap_zstd/nometa/bag.mcap.zstd', 40)])
def test_what_others_have_reported(name, count, shared_data):
    """Real inputs of these kinds, where they are present."""
    path = shared_data / 'reports' / name
    if not path.exists():
        pytest.skip('no reports beside the checkout')
    stamps_ns = stamps_in(path)
    assert len(stamps_ns) == count
    assert stamps_ns == sorted(stamps_ns) and stamps_ns[0] == 1_700_000_000 * 10**9


@pytest.mark.parametrize('names, message', [
    ([], 'the folder is empty'),
    (['IMG_0001.JPG', 'IMG_0002.JPG'], 'of 2 files in .*IMG_0002.JPG.*: make a video of'),
    (['notes.txt', 'ride.mp4'], 'of 2 files in .*ride.mp4.*: give what is to be read')])
def test_a_folder_without_a_bag_is_told_what_it_holds(tmp_path, names, message):
    for name in names:
        (tmp_path / name).write_bytes(b'something')
    with pytest.raises(RecordingError, match=f'{tmp_path.name} is not a readable bag: {message}'):
        open_recording(tmp_path)
