# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Videos, damaged in every way, and what is read of their boxes without FFmpeg."""

from functools import cache
from pathlib import Path
import re
import struct
import tempfile

from fuzzing import examples, mutated, tried
from hypothesis import given, strategies as st
import pytest
from sph_stab_ros.images.codec import ImageError
from sph_stab_ros.recording import open_recording, RecordingError
from sph_stab_ros.recording.spherical import boxes_say
from sph_stab_ros.recording.spherical_boxes import write_spherical
from sph_stab_ros.recording.tilt import tilt_removed_in_camera, zenith_correction_applied
from tiny_recordings import turning_spheres, write_video

pytest.importorskip('av')


@cache
def folder():
    """Return a folder for videos, as long as the tests run."""
    return tempfile.TemporaryDirectory(prefix='fuzz_')


@cache
def videos():
    path = write_video(Path(folder().name) / 'video.mp4', turning_spheres(4, 128)[0])
    return path.read_bytes(),


def boxes(data):
    """Return where the boxes of an MP4 file begin, about."""
    return [match.start() - 4 for match in re.finditer(rb'[a-z][a-z0-9]{3}', data)
            if match.start() >= 4] or [0]


@given(st.deferred(lambda: mutated(*videos(), hot=boxes)))
@examples(30)
def test_videos(data):
    path = Path(folder().name) / 'input.mp4'
    with tried('mp4', data):
        path.write_bytes(data)
        boxes_say(path)
        tilt_removed_in_camera(path)
        try:
            for frame in open_recording(path).frames():
                try:
                    frame.load()
                except ImageError:
                    pass
        except RecordingError as error:
            assert str(error)
        try:
            write_spherical(path)
        except ValueError as error:
            assert str(error)


EXIF = (b'II*\0' + b'\x08\0\0\0' + b'\x01\0' + b'\x69\x87\x04\0\x01\0\0\0\x1a\0\0\0' + bytes(4)
        + b'\x01\0' + b'\x7c\x92\x07\0\x20\0\0\0\x30\0\0\0' + bytes(8)
        + b'Ricoh\0\0\0' + b'\x01\0' + b'\x01\x40\x04\0\x01\0\0\0\x48\0\0\0' + bytes(4)
        + b'\x01\0' + b'\x07\0\x03\0\x01\0\0\0\x01\0\0\0')


@given(mutated(EXIF, EXIF.replace(b'II', b'MM')))
@examples(100)
def test_the_flag_of_a_theta(data):
    with tried('exif', data):
        try:
            zenith_correction_applied(data)
        except Exception as error:
            # As tilt_removed_in_camera takes it.
            assert isinstance(error, struct.error)
