# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""
sensor_msgs Image and CompressedImage to numpy and back, without ROS.

Messages are used by their field names only, so that those of rclpy and those of a bag reader
both work.
"""

from array import array
from collections.abc import Mapping
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from sph_stab_ros.geometry.arrays import Image

JPEG_QUALITY = 90
JPEG, PNG = 'JPEG', 'PNG'

# Encoding: channels, and the conversion into BGR or grey where one is needed.
ENCODINGS: dict[str, tuple[int, int | None]] = {
    'bgr8': (3, None),
    'rgb8': (3, cv2.COLOR_RGB2BGR),
    'bgra8': (4, cv2.COLOR_BGRA2BGR),
    'rgba8': (4, cv2.COLOR_RGBA2BGR),
    'mono8': (1, None),
}


class ImageError(ValueError):
    """
    A picture that cannot be used.

    ``reason`` is one of a few fixed phrases, by which such pictures are counted; the text adds
    what is wrong with this one.
    """

    def __init__(self, reason: str, detail: str) -> None:
        super().__init__(f'{reason}: {detail}')
        self.reason = reason


def image_from_message(msg: Any) -> Image:
    """
    Return the picture (H, W, 3) BGR or (H, W) grey, uint8, of an Image or CompressedImage message.

    The array may share its memory with the message and is not to be written to. ImageError where
    the message is not a whole picture.
    """
    return image_from_raw(msg) if hasattr(msg, 'encoding') else image_from_compressed(msg.data)


def image_from_raw(msg: Any) -> Image:
    """Return the picture in an Image message; rows may be padded."""
    if msg.encoding not in ENCODINGS:
        raise ImageError('unknown encoding',
                         f'{msg.encoding!r} is none of {", ".join(ENCODINGS)}')
    channels, conversion = ENCODINGS[msg.encoding]
    if not (msg.width and msg.height):
        raise ImageError('zero size', f'{msg.width}x{msg.height}')
    row_bytes = msg.width * channels
    if msg.step < row_bytes:
        raise ImageError('wrong step',
                         f'{msg.step} bytes for rows of {row_bytes} ({msg.encoding})')
    data = np.frombuffer(msg.data, np.uint8)
    if data.size != msg.step * msg.height:
        reason = 'truncated data' if data.size < msg.step * msg.height else 'wrong step'
        raise ImageError(reason, f'{data.size} bytes for {msg.height} rows of {msg.step}')
    rows = data.reshape(msg.height, msg.step)[:, :row_bytes]
    if channels == 1:
        return np.ascontiguousarray(rows)
    image = np.ascontiguousarray(rows).reshape(msg.height, msg.width, channels)
    return image if conversion is None else cv2.cvtColor(image, conversion)


def image_from_compressed(data: Any) -> Image:
    """
    Return the picture in JPEG or PNG ``data``.

    A file cut short is refused; OpenCV would return it with its lower part grey.
    """
    data = bytes(data)
    return decoded(data, kind_of_whole_file(data))


def kind_of_whole_file(data: bytes) -> str:
    """Return JPEG or PNG, whichever ``data`` (bytes) are, or raise ImageError."""
    if data.startswith(b'\xff\xd8'):
        kind = JPEG
        # Neither marker occurs within a scan, and a thumbnail precedes the last scan.
        whole = data.rfind(b'\xff\xd9') > data.rfind(b'\xff\xda') > 0
    elif data.startswith(b'\x89PNG\r\n\x1a\n'):
        kind, whole = PNG, b'IEND' in data[-64:]
    else:
        raise ImageError('not JPEG or PNG', f'{len(data)} bytes of something else')
    if not whole:
        raise ImageError(f'truncated {kind}', f'{len(data)} bytes without the end marker')
    return kind


def decoded(data: bytes, kind: str, flags: int = cv2.IMREAD_ANYCOLOR) -> Image:
    """Return the picture in a file (bytes) by flags of cv2.imdecode; ImageError names its kind."""
    image = cv2.imdecode(np.frombuffer(data, np.uint8), flags | cv2.IMREAD_IGNORE_ORIENTATION)
    if image is None:
        raise ImageError(f'corrupt {kind}', f'{len(data)} bytes cannot be decoded')
    return image


def encoding_of(image: Image) -> str:
    """Return the Image encoding of a BGR or grey array."""
    return 'mono8' if image.ndim == 2 else 'bgr8'


def image_fields(image: Image) -> dict[str, Any]:
    """Return the fields of the Image message of ``image``, BGR or grey, but for its header."""
    height, width = image.shape[:2]
    return {'height': height, 'width': width, 'encoding': encoding_of(image), 'is_bigendian': 0,
            'step': image.size // height, 'data': np.ascontiguousarray(image).ravel()}


def compressed_fields(image: Image, quality: int = JPEG_QUALITY) -> dict[str, Any]:
    """Return the fields of the CompressedImage message of ``image`` but for its header."""
    return {'format': jpeg_format(image), 'data': encode_jpeg(image, quality)}


def fill_image(msg: Any, image: Image) -> Any:
    """Fill a fresh rclpy Image message with ``image``, BGR or grey, and return it."""
    return fill_message(msg, image_fields(image))


def fill_compressed(msg: Any, image: Image, quality: int = JPEG_QUALITY) -> Any:
    """Fill a fresh rclpy CompressedImage message with ``image`` as JPEG and return it."""
    return fill_message(msg, compressed_fields(image, quality))


def fill_message(msg: Any, fields: Mapping[str, Any]) -> Any:
    """Fill a fresh rclpy message with values and arrays by the names of its fields; return it."""
    for name, value in fields.items():
        sequence = getattr(msg, name)
        if isinstance(sequence, array):
            # Assigning to it checks each element: 1000 ms against 0.4 ms for 5.5 MB of image.
            sequence.frombytes(value.data.cast('B'))
        else:
            setattr(msg, name, value)
    return msg


def encode_jpeg(image: Image, quality: int = JPEG_QUALITY) -> NDArray[np.uint8]:
    """Return the JPEG file (N,) uint8 of ``image``, BGR or grey."""
    ok, data = cv2.imencode('.jpg', image, (cv2.IMWRITE_JPEG_QUALITY, quality))
    if not ok:
        raise ImageError('cannot encode', f'{image.shape} {image.dtype} as JPEG')
    return data.reshape(-1)


def jpeg_format(image: Image) -> str:
    """Return the ``format`` of a JPEG CompressedImage as image_transport writes it."""
    encoding = encoding_of(image)
    return f'{encoding}; jpeg compressed {encoding if encoding == "bgr8" else ""}'
