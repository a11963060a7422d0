# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Videos wherever they come from: through pipes, of any name, and pictures by themselves."""

import os
import subprocess
import sys
from threading import Thread

import cv2
import numpy as np
import pytest
from sph_stab_ros.recording import open_recording, RecordingError
from sph_stab_ros.replay import main as replay

videos = pytest.importorskip('tiny_videos')


def encode(path, images):
    """Write a video of BGR images; return the path."""
    return videos.encode(path, [videos.bgr_frame(image) for image in images])


def test_a_pipe_at_a_path_is_read_once(tmp_path, turning):
    """As a shell makes one of <(...)."""
    data = encode(tmp_path / 'ride.mkv', turning[0]).read_bytes()
    pipe = tmp_path / 'pipe'
    os.mkfifo(pipe)
    writer = Thread(target=pipe.write_bytes, args=(data,))
    writer.start()
    recording = open_recording(pipe)
    assert len(list(recording.frames())) == len(turning[0])
    writer.join()
    with pytest.raises(RecordingError, match='pipe can be read only once'):
        next(recording.frames())


def test_no_video_through_a_pipe_is_refused_at_once(tmp_path):
    """Nobody opens the pipe once more, to wait for another writer."""
    pipe = tmp_path / 'pipe'
    os.mkfifo(pipe)
    writer = Thread(target=pipe.write_bytes, args=(b'no video',))
    writer.start()
    command = [sys.executable, '-m', 'sph_stab_ros.replay', str(pipe), '--trajectory',
               str(tmp_path / 'out.tum')]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    writer.join()
    assert done.returncode == 1
    line, = done.stderr.splitlines()
    assert 'pipe is not a readable video' in line


@pytest.mark.parametrize('name', ['2026-01-02T03:04:05.mp4', 'file:a.mp4', 'sp ace %04d.mp4'])
def test_any_name_of_a_file_will_do(tmp_path, monkeypatch, turning, name):
    """Though FFmpeg takes what stands before a colon for a protocol."""
    monkeypatch.chdir(tmp_path)
    assert replay([str(encode('ride.mkv', turning[0])), name, '--max-frames', '5']) == 0
    assert len(list(open_recording(name).frames())) == 5
    assert replay([name, 'copy:of.mp4']) == 0
    assert replay(['--force', '--', name, '-copy.mp4']) == 0
    assert len(list(open_recording('-copy.mp4').frames())) == 5


def test_a_video_through_a_pipe_is_that_of_the_file(tmp_path, turning):
    """From a time on, too; once."""
    path = encode(tmp_path / 'ride.mkv', turning[0])
    script = ('from sph_stab_ros.recording import open_recording, RecordingError\n'
              'recording = open_recording("-", start_s=0.1)\n'
              'for frame in recording.frames():\n'
              '    print(frame.stamp_ns, frame.image.sum())\n'
              'try:\n    next(recording.frames())\n'
              'except RecordingError as error:\n    print(error)')
    with open(path, 'rb') as pipe:
        said = subprocess.run([sys.executable, '-c', script], stdin=pipe, text=True, check=True,
                              stdout=subprocess.PIPE, env={
                                  **os.environ, 'PYTHONPATH': os.pathsep.join(sys.path)})
    frames = [f'{one.stamp_ns} {one.image.sum()}'
              for one in open_recording(path, start_s=0.1).frames()]
    assert 5 < len(frames) < len(turning[0])
    assert said.stdout.splitlines() == [*frames, 'standard input can be read only once']


def test_pictures_by_themselves_are_videos(tmp_path, turning):
    """One is a recording of one picture; JPEG lies as its EXIF data say."""
    for name in ('a.png', 'a.jpg', 'a.tiff', 'a.bmp', 'a.webp'):
        assert cv2.imwrite(str(tmp_path / name), turning[0][0])
        frame, = open_recording(tmp_path / name).frames()
        assert np.abs(frame.image.astype(int) - turning[0][0]).mean() < 6, name
        assert replay([str(tmp_path / name), '--trajectory', str(tmp_path / f'{name}.tum')]) == 0
    # Another WebP with flags.
    assert cv2.imwrite(str(tmp_path / 'clear.webp'), np.dstack(
        (turning[0][0], np.full_like(turning[0][0][..., 0], 200))), [cv2.IMWRITE_WEBP_QUALITY, 80])
    assert b'VP8X' in (tmp_path / 'clear.webp').read_bytes()[:16]
    assert len(list(open_recording(tmp_path / 'clear.webp').frames())) == 1
    for name, pix_fmt in (('gif', 'rgb8'), ('apng', 'rgb24')):
        path = videos.encode(tmp_path / f'b.{name}', [
            videos.bgr_frame(image).reformat(format=pix_fmt) for image in turning[0]], codec=name)
        assert len(list(open_recording(path).frames())) == len(turning[0])
    jpeg = (tmp_path / 'a.jpg').read_bytes()
    # Orientation, tag 0x112: turned by half a revolution, 3.
    exif = b'Exif\0\0MM\0*\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0\x03\0\0\0\0\0\0'
    (tmp_path / 'turned.jpg').write_bytes(
        jpeg[:2] + b'\xff\xe1' + (2 + len(exif)).to_bytes(2, 'big') + exif + jpeg[2:])
    frame, = open_recording(tmp_path / 'turned.jpg').frames()
    assert np.abs(frame.image.astype(int) - turning[0][0][::-1, ::-1]).mean() < 6
