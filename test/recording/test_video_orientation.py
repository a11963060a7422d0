# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""How a container says that pictures are to be shown: turned, mirrored, cut by an edit list."""

from itertools import product
from struct import pack

import cv2
import numpy as np
import pytest
from sph_stab_ros.images.video.picture import orientation
from sph_stab_ros.recording import open_recording
from sph_stab_ros.recording.spherical_boxes import boxes, packed
from tiny_recordings import textured_sphere

av = pytest.importorskip('av')
videos = pytest.importorskip('tiny_videos')

IMAGE = textured_sphere()
# What a display matrix (a, b, c, d) makes of an image: (x, y) is shown at (a x + c y, b x + d y).
SHOWN = {
    (1, 0, 0, 1): lambda image: image,
    (0, 1, -1, 0): lambda image: np.rot90(image, -1),
    (-1, 0, 0, -1): lambda image: np.rot90(image, 2),
    (0, -1, 1, 0): lambda image: np.rot90(image, 1),
    (-1, 0, 0, 1): lambda image: image[:, ::-1],
    (1, 0, 0, -1): lambda image: image[::-1],
    (0, 1, 1, 0): lambda image: image.swapaxes(0, 1),
    (0, -1, -1, 0): lambda image: np.rot90(image, 2).swapaxes(0, 1)}


def with_matrix(path, matrix):
    """Write the display matrix (a, b, c, d) into an MP4 file's track header."""
    data = bytearray(path.read_bytes())
    # Behind the header: version and flags, times, ids, durations, layer, volume.
    start = data.index(b'tkhd') + 44
    a, b, c, d = (number * 0x10000 for number in matrix)
    data[start:start + 20] = pack('>5i', a, b, 0, c, d)
    path.write_bytes(data)
    return path


@pytest.mark.parametrize('matrix', SHOWN, ids=str)
@pytest.mark.parametrize('is_large', [False, True])
def test_pictures_are_turned_and_mirrored_as_the_container_says(tmp_path, matrix, is_large):
    """In colour and in grey; a mirrored sphere would turn the other way round."""
    pictures = 2 * [videos.bgr_frame(IMAGE)]
    path = with_matrix(videos.encode(tmp_path / 'a.mp4', pictures, options={'crf': '10'}), matrix)
    frame = next(open_recording(path).frames())
    expected = SHOWN[matrix](IMAGE)
    assert frame.size_wh == expected.shape[1::-1]
    if is_large:
        frame.load()
    assert np.abs(frame.image.astype(int) - expected).mean() < 4
    grey = cv2.cvtColor(np.ascontiguousarray(expected), cv2.COLOR_BGR2GRAY)
    assert np.abs(frame.grey(0).astype(int) - grey).mean() < 4


@pytest.mark.parametrize('rotation', [0, 90, 180, -90])
def test_what_pyav_says_of_the_rotation_serves_where_the_matrix_cannot_be_had(rotation):
    """Counter-clockwise, as FFmpeg has it."""
    class Picture:
        pass

    picture = Picture()
    picture.rotation = rotation
    upright, is_transposed = orientation(picture, None)
    assert np.array_equal(upright(IMAGE), np.rot90(IMAGE, rotation // 90))
    assert is_transposed == (rotation % 180 != 0)


def with_edit(path, skipped_s, empty_s=0.):
    """Let a file's video begin later in its media, and be shown later; return the path."""
    data = path.read_bytes()
    moov = next(box for box in boxes(data) if box.name == b'moov')
    assert moov.end == len(data)

    def edited(part, scale):
        parts = []
        for box in boxes(part):
            inner = part[box.content:box.end]
            if box.name == b'mvhd':
                scale = int.from_bytes(inner[12:16], 'big')
            if box.name in (b'moov', b'trak'):
                inner = edited(inner, scale)
            if box.name == b'edts':
                continue
            parts.append(packed(box.name, inner))
            if box.name == b'tkhd':
                edits = [(round(empty_s * scale), -1)] if empty_s else []
                edits.append((round((2 - skipped_s) * scale), round(skipped_s * 12800)))
                parts.append(packed(b'edts', packed(b'elst', pack('>II', 0, len(edits)) + b''.join(
                    pack('>Iihh', *edit, 1, 0) for edit in edits))))
        return b''.join(parts)
    path.write_bytes(data[:moov.start] + edited(data[moov.start:], None))
    return path


@pytest.mark.parametrize('skipped, empty_s', product((0, 5, 27), (0., 0.5)))
def test_what_an_edit_list_hides_is_not_there(tmp_path, skipped, empty_s):
    """Phones cut so: pictures before a cut are decoded but not shown, and times begin there."""
    levels = [np.full((64, 128, 3), 4 * number + 20, np.uint8) for number in range(50)]
    path = videos.encode(tmp_path / 'a.mp4', [videos.bgr_frame(image) for image in levels],
                         options={'g': '20', 'bf': '0'})
    with_edit(path, skipped / videos.RATE, empty_s)
    recording = open_recording(path)
    frames = list(recording.frames())
    assert [round(frame.image.mean()) for frame in frames] == pytest.approx(
        [4 * number + 20 for number in range(skipped, 50)], abs=2)
    expected_s = empty_s + np.arange(len(frames)) / videos.RATE
    assert np.abs(1e-9 * np.array([frame.stamp_ns for frame in frames]) - expected_s).max() < 1e-3
    # The same from the middle on.
    later = list(open_recording(path, None, 0.4).frames())
    assert [frame.stamp_ns for frame in later] == [frame.stamp_ns for frame in frames[10:]]
    assert all(np.array_equal(a.image, b.image) for a, b in zip(later, frames[10:], strict=True))
