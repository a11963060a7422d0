# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Image messages to arrays and back."""

from array import array
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from sph_stab_ros.images.codec import (
    encode_jpeg, fill_compressed, fill_image, image_from_message, ImageError, jpeg_format)
from tiny_recordings import textured_sphere

BGR = textured_sphere(128)
TO_ENCODING = {
    'bgr8': lambda image: image,
    'rgb8': lambda image: cv2.cvtColor(image, cv2.COLOR_BGR2RGB),
    'bgra8': lambda image: cv2.cvtColor(image, cv2.COLOR_BGR2BGRA),
    'rgba8': lambda image: cv2.cvtColor(image, cv2.COLOR_BGR2RGBA),
    'mono8': lambda image: cv2.cvtColor(image, cv2.COLOR_BGR2GRAY),
}


def raw_message(pixels, encoding, padding=0):
    """Return what looks like an Image, with ``padding`` bytes of garbage behind each row."""
    rows = pixels.reshape(len(pixels), -1)
    rows = np.hstack((rows, np.full((len(rows), padding), 77, np.uint8)))
    return SimpleNamespace(height=pixels.shape[0], width=pixels.shape[1], encoding=encoding,
                           step=rows.shape[1], data=rows.ravel())


def compressed_message(data):
    """Return what looks like a CompressedImage."""
    return SimpleNamespace(format='jpeg', data=np.frombuffer(bytes(data), np.uint8))


def expected(encoding):
    """Return what the picture is to be read as."""
    return TO_ENCODING['mono8'](BGR) if encoding == 'mono8' else BGR


@pytest.mark.parametrize('padding', [0, 5])
@pytest.mark.parametrize('encoding', TO_ENCODING)
def test_raw_encodings_are_read_exactly(encoding, padding):
    """Each encoding gives BGR or grey; what pads the rows is not seen."""
    message = raw_message(TO_ENCODING[encoding](BGR), encoding, padding)
    assert np.array_equal(image_from_message(message), expected(encoding))


@pytest.mark.parametrize('container', [bytes, bytearray, lambda data: array('B', data), list])
def test_any_buffer_of_bytes_will_do(container):
    """Messages of rclpy hold arrays, those of bag readers NumPy arrays or bytes."""
    message = raw_message(BGR, 'bgr8')
    message.data = container(message.data.tobytes())
    if container is list:
        message.data = array('B', message.data)
    assert np.array_equal(image_from_message(message), BGR)


@pytest.mark.parametrize('suffix', ['.jpg', '.png'])
@pytest.mark.parametrize('grey', [False, True])
def test_compressed_images_are_read(suffix, grey):
    """JPEG and PNG, colour and grey."""
    image = expected('mono8') if grey else BGR
    data = cv2.imencode(suffix, image)[1]
    read = image_from_message(compressed_message(data))
    assert read.shape == image.shape
    assert np.abs(read.astype(int) - image).mean() < (6 if suffix == '.jpg' else 1e-9)


def test_padding_behind_a_jpeg_is_harmless():
    """Some cameras send buffers of fixed size."""
    data = encode_jpeg(BGR).tobytes()
    assert image_from_message(compressed_message(data + bytes(100))).shape == BGR.shape


def broken(**changes):
    """Return a raw message with some fields changed."""
    message = raw_message(BGR, 'bgr8')
    for name, value in changes.items():
        setattr(message, name, value)
    return message


def cut(suffix, fraction):
    """Return a compressed message that was cut short."""
    data = cv2.imencode(suffix, BGR)[1].tobytes()
    return compressed_message(data[:int(len(data) * fraction)])


def jpeg_with_damaged_header():
    """Return a JPEG that ends well but whose tables are overwritten."""
    data = bytearray(encode_jpeg(BGR).tobytes())
    data[2:200] = bytes(198)
    return compressed_message(data)


def png_with_a_long_chunk():
    """Return a PNG whose data are said to take 2 GB, for which OpenCV would take the memory."""
    data = cv2.imencode('.png', BGR)[1].tobytes()
    at = data.index(b'IDAT')
    return compressed_message(data[:at - 4] + b'\x7f\xff\0\0' + data[at:])


@pytest.mark.parametrize('message, reason', [
    (broken(encoding='32FC1'), 'unknown encoding'),
    (broken(width=0, step=0), 'zero size'),
    (broken(height=0), 'zero size'),
    (broken(step=128 * 3 - 1), 'wrong step'),
    (broken(step=128 * 3 - 32), 'wrong step'),
    (broken(step=128 * 3 + 1), 'truncated data'),
    (broken(data=BGR.ravel()[:-1]), 'truncated data'),
    (broken(data=BGR.ravel()[:0]), 'truncated data'),
    (broken(data=np.append(BGR.ravel(), 0).astype(np.uint8)), 'wrong step'),
    (cut('.jpg', 0.5), 'truncated JPEG'),
    (cut('.jpg', 0.95), 'truncated JPEG'),
    (cut('.png', 0.5), 'truncated PNG'),
    (cut('.png', 0.999), 'truncated PNG'),
    (png_with_a_long_chunk(), 'truncated PNG'),
    (jpeg_with_damaged_header(), 'corrupt JPEG'),
    (compressed_message(b''), 'not JPEG or PNG'),
    (compressed_message(b'RIFF....WEBP'), 'not JPEG or PNG'),
])
def test_what_is_not_a_whole_picture_is_named(message, reason):
    """Each fault has its reason, and one line that tells it."""
    with pytest.raises(ImageError) as error:
        image_from_message(message)
    assert error.value.reason == reason
    assert str(error.value).startswith(reason) and '\n' not in str(error.value)


@pytest.mark.parametrize('encoding', ['bgr8', 'mono8'])
def test_filled_messages_are_read_back(encoding):
    """Real messages, where rclpy is installed, are filled and read without loss."""
    messages = pytest.importorskip('sensor_msgs.msg')
    image = expected(encoding)
    message = fill_image(messages.Image(), image)
    assert (message.encoding, message.step) == (encoding, image.size // 64)
    assert np.array_equal(image_from_message(message), image)
    compressed = fill_compressed(messages.CompressedImage(), image)
    assert compressed.format == jpeg_format(image)
    assert image_from_message(compressed).shape == image.shape


def test_a_view_into_a_larger_image_can_be_sent():
    """Slices are not contiguous in memory."""
    messages = pytest.importorskip('sensor_msgs.msg')
    window = BGR[4:20, 8:40]
    assert np.array_equal(image_from_message(fill_image(messages.Image(), window)), window)


def test_jpeg_format_is_that_of_image_transport():
    """Subscribers of image_transport read the encoding out of it."""
    assert jpeg_format(BGR) == 'bgr8; jpeg compressed bgr8'
    assert jpeg_format(expected('mono8')) == 'mono8; jpeg compressed '
