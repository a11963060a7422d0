# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Frames, and those in JPEG files: what is decoded of them, and what is refused."""

from dataclasses import replace
from types import SimpleNamespace
from unittest import mock

import cv2
import numpy as np
import pytest
from sph_stab_ros.geometry.projection import Equirect
from sph_stab_ros.images.codec import decoded, encode_jpeg, image_from_compressed, ImageError
from sph_stab_ros.images.frame import Frame, frame_from_message
from sph_stab_ros.images.jpeg_file import JpegFile
from sph_stab_ros.images.picture_size import jpeg_size
from tiny_recordings import textured_sphere

PROGRESSIVE = cv2.IMWRITE_JPEG_PROGRESSIVE, 1
RESTARTS = cv2.IMWRITE_JPEG_RST_INTERVAL, 4


def jpeg(image, *options):
    """Return a JPEG file of an image."""
    return cv2.imencode('.jpg', image, options)[1].tobytes()


def message(data):
    """Return what looks like a CompressedImage."""
    return SimpleNamespace(format='jpeg', data=data)


@pytest.mark.parametrize('options', [(), PROGRESSIVE, RESTARTS], ids=str)
@pytest.mark.parametrize('size_wh', [(640, 320), (642, 321), (17, 333)], ids=str)
@pytest.mark.parametrize('channels', [1, 3])
def test_size_is_that_of_the_image(size_wh, channels, options):
    image = np.zeros((*size_wh[::-1], channels), np.uint8)
    data = jpeg(image, *options)
    assert jpeg_size(data) == size_wh
    frame = Frame(JpegFile(data), 0)
    assert frame.size_wh == size_wh == Frame(frame.image, 0).size_wh
    # Comments and fill bytes may come before what says the size.
    comment = b'\xff\xff\xff\xfe\x00\x06\xff\xc0\x00\x00'
    assert jpeg_size(data[:2] + comment + data[2:]) == size_wh


@pytest.mark.parametrize('image_width, width, expected', [
    (640, 640, 640), (1278, 640, 1278), (1280, 640, 640), (1920, 640, 960), (1920, 480, 480),
    (512, 640, 512), (5376, 640, 672)])
def test_no_more_is_decoded_than_is_wanted(image_width, width, expected):
    data = jpeg(textured_sphere(image_width))
    reduced = Frame(JpegFile(data), 0).grey(width)
    assert reduced.shape == (expected // 2, expected)
    # Where it cannot be reduced grey is that of the colours.
    colours = cv2.cvtColor(image_from_compressed(data), cv2.COLOR_BGR2GRAY)
    assert np.array_equal(reduced, colours) == (expected == image_width)


def test_reduced_spheres_are_those_of_the_whole():
    """Reduced in two steps instead of one they are hardly less sharp, and nothing moves."""
    width, data = 320, jpeg(textured_sphere(1920), cv2.IMWRITE_JPEG_QUALITY, 95)
    frame, loaded = (Frame(JpegFile(data), 7, 'camera') for _ in range(2))
    loaded.load()
    assert np.array_equal(loaded.image, image_from_compressed(data))
    assert loaded.grey(width).shape == loaded.image.shape[:2]
    whole, reduced = (np.float64(Equirect(1920).grey_sphere(one, width))
                      for one in (loaded, frame))
    assert np.corrcoef(whole.ravel(), reduced.ravel())[0, 1] > 0.99
    assert np.hypot(*cv2.phaseCorrelate(whole, reduced)[0]) < 0.02


def test_messages_become_frames():
    image = textured_sphere(128)
    frame = frame_from_message(message(jpeg(image)), 5, 'camera')
    assert (frame.stamp_ns, frame.frame_id, frame.size_wh) == (5, 'camera', (128, 64))
    png = frame_from_message(message(cv2.imencode('.png', image)[1].tobytes()), 5, 'camera')
    assert np.array_equal(png.image, image)
    assert np.array_equal(png.grey(64), cv2.cvtColor(image, cv2.COLOR_BGR2GRAY))
    raw = SimpleNamespace(height=64, width=128, encoding='bgr8', step=384, data=image.ravel())
    assert np.array_equal(frame_from_message(raw, 5).image, image)


@pytest.mark.parametrize('image', [textured_sphere(128), JpegFile(jpeg(textured_sphere(128)))])
def test_a_frame_can_be_changed_whatever_it_is_made_of(image):
    frame = Frame(image, 5, 'camera')
    later = replace(frame, stamp_ns=6)
    assert (later.stamp_ns, later.frame_id) == (6, 'camera')
    assert np.array_equal(later.image, frame.image)
    grey = np.zeros((32, 64), np.uint8)
    other = replace(frame, source=grey)
    assert other.image is grey and other.grey(16) is grey and other.size_wh == (64, 32)
    assert frame.size_wh == (128, 64)


def test_a_frame_is_decoded_once_and_when_it_is_asked_for():
    frame = Frame(JpegFile(jpeg(textured_sphere(128))), 5)
    with mock.patch('sph_stab_ros.images.jpeg_file.decoded', wraps=decoded) as decode:
        assert frame.size_wh == (128, 64)
        decode.assert_not_called()
        assert frame.image is frame.image is replace(frame, frame_id='camera').image
        decode.assert_called_once()


def without_frame_header():
    """Return a JPEG file that ends before it says its size, and an end marker after all."""
    data = encode_jpeg(textured_sphere(128)).tobytes()
    return data[:data.index(b'\xff\xc0')] + b'\xff\xda' + b'\xff\xd9'


@pytest.mark.parametrize('data, reason', [
    (encode_jpeg(textured_sphere(128)).tobytes()[:-200], 'truncated JPEG'),
    (without_frame_header(), 'corrupt JPEG'),
    (b'\xff\xd8\xff\xda\xff\xd9', 'corrupt JPEG'),
    (b'GIF89a', 'not JPEG or PNG')])
def test_what_is_not_a_whole_file_is_refused_at_once(data, reason):
    with pytest.raises(ImageError) as error:
        frame_from_message(message(data), 0)
    assert error.value.reason == reason


def test_what_cannot_be_decoded_is_refused_when_it_is_asked_for():
    # Its tables become comments.
    data = jpeg(textured_sphere(128)).replace(b'\xff\xdb', b'\xff\xfe')
    frame = frame_from_message(message(data), 0)
    for asked in (frame.load, lambda: frame.grey(64)):
        with pytest.raises(ImageError, match='corrupt JPEG'):
            asked()
