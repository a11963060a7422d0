# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Video in the messages of bags: of every type, in either generation of ROS."""

from unittest import mock

from encoded_video import KEY_PERIOD, pictures, stream
import numpy as np
import pytest
from rosbags.rosbag2 import StoragePlugin
from sph_stab_ros.recording import open_recording, RecordingError
from sph_stab_ros.replay import main as replay
from tiny_recordings import stamps_of
from video_bags import (
    COMPRESSED_IMAGE, COMPRESSED_VIDEO, DEFINITIONS, DEFINITIONS_ROS1, FFMPEG_PACKET,
    write_video_bag)


def check(path, name, expected):
    """Check that a bag has these pictures, in the order of presentation, each with its stamp."""
    frames = list(open_recording(path).frames())
    assert [frame.stamp_ns for frame in frames] == stamps_of(max(expected) + 1)[expected].tolist()
    assert {frame.frame_id for frame in frames} == {'theta_camera'}
    for index, frame in zip(expected, frames):
        assert np.array_equal(frame.image, pictures(name)[index])


@pytest.mark.parametrize('kind', ['mcap', 'sqlite', 'ros1'])
@pytest.mark.parametrize('msgtype', [COMPRESSED_IMAGE, COMPRESSED_VIDEO, FFMPEG_PACKET])
@pytest.mark.parametrize('name', ['h264 B', 'h265 B', 'av1 hidden'])
def test_bags_give_the_pictures_of_the_stream(tmp_path, name, msgtype, kind, caplog):
    storage = StoragePlugin.SQLITE3 if kind == 'sqlite' else StoragePlugin.MCAP
    path = write_video_bag(tmp_path / 'bag', stream(name), msgtype, name.split()[0],
                           1 if kind == 'ros1' else 2, storage=storage)
    check(path, name, [*range(len(stream(name)))])
    assert not caplog.records


@pytest.mark.parametrize('ros', [1, 2])
def test_packets_of_the_other_generation_are_read(tmp_path, ros):
    """As in bags converted from one to the other."""
    path = write_video_bag(tmp_path / 'bag', stream('h264'), FFMPEG_PACKET, 'libx264', ros,
                           DEFINITIONS if ros == 1 else DEFINITIONS_ROS1)
    check(path, 'h264', [*range(len(stream('h264')))])


@pytest.mark.parametrize('name', ['h264 B', 'h265 B', 'av1'])
def test_a_bag_that_begins_anywhere_waits_for_a_key_picture(tmp_path, name, caplog, capsys):
    """One line says how many pictures passed, and they are counted."""
    path = write_video_bag(tmp_path / 'bag', stream(name)[3:], FFMPEG_PACKET, name.split()[0])
    recording = open_recording(path)
    assert len(list(recording.frames())) == len(stream(name)) - KEY_PERIOD
    assert [record.getMessage() for record in caplog.records] == [
        f'bag: {recording_name(name)}: pictures passed over before a key picture: '
        f'{KEY_PERIOD - 3}']
    assert recording.skipped == {'no key picture': KEY_PERIOD - 3}
    assert replay([str(path), '--trajectory', str(tmp_path / 'a.tum')]) == 0
    assert len((tmp_path / 'a.tum').read_text().splitlines()) == len(stream(name)) - KEY_PERIOD
    assert f'{KEY_PERIOD - 3}x no key picture' in capsys.readouterr().out


def recording_name(name):
    return {'h264': 'H.264', 'h265': 'H.265', 'av1': 'AV1'}[name.split()[0]]


def test_a_bag_without_a_key_picture_is_refused_in_one_line(tmp_path, capsys):
    packets = stream('h264')[1:KEY_PERIOD]
    path = write_video_bag(tmp_path / 'bag', packets, COMPRESSED_IMAGE, 'h264')
    assert replay([str(path), '--trajectory', str(tmp_path / 'a.tum')]) == 1
    assert 'no usable picture (no key picture: 7)' in capsys.readouterr().err


def test_a_lost_message_is_told_of(tmp_path, caplog):
    packets = stream('h264')
    path = write_video_bag(tmp_path / 'bag', packets[:3] + packets[4:], COMPRESSED_VIDEO, 'h264')
    check(path, 'h264', [0, 1, 2, *range(KEY_PERIOD, len(packets))])
    said = [record.getMessage() for record in caplog.records]
    assert len(said) == 2
    assert 'picture left out, missing picture: one or more before it are missing' in said[0]
    assert said[1].endswith('H.264: pictures passed over before a key picture: 4')


def test_without_pyav_a_bag_is_refused_in_one_line(tmp_path, capsys):
    path = write_video_bag(tmp_path / 'bag', stream('h264'), FFMPEG_PACKET, 'libx264')
    with mock.patch.dict('sys.modules', {'av': None}):
        with pytest.raises(RecordingError, match='H.264 in messages needs PyAV: pip install'):
            next(open_recording(path).frames())
        assert replay([str(path), '--trajectory', str(tmp_path / 'a.tum')]) == 1
    assert len(capsys.readouterr().err.splitlines()) == 1


@pytest.mark.parametrize('kind', ['compressedimage_h264', 'ffmpegpacket'])
def test_what_users_reported_is_read(shared_data, tmp_path, kind):
    """Simulated: forty pictures of a drone's flight, of which an undamaged recording has lines."""
    recording = shared_data / 'reports' / 'h264_messages' / kind
    assert replay([str(recording), '--trajectory', str(tmp_path / 'a.tum')]) == 0
    stamps = [line.split()[0] for line in (tmp_path / 'a.tum').read_text().splitlines()]
    reference = (shared_data / 'reports' / 'base.tum').read_text().splitlines()
    assert stamps == [line.split()[0] for line in reference]
