# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
"""
What cameras send as sensor_msgs Image, by the names of sensor_msgs/image_encodings.

Of 16 bits the upper eight are used: cameras that fill fewer give dark pictures here as anywhere.
YUV is taken for BT.601 of limited range, as OpenCV and cv_bridge do.
"""

from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from sph_stab_ros.geometry.arrays import Image
from sph_stab_ros.images.colour import bgr_from_yuv, SMPTE170M
from sph_stab_ros.images.image_error import ImageError


class Encoding(NamedTuple):
    """How pixels lie in a row, and what makes BGR or grey of them."""

    channels: int
    conversion: int | None = None
    bytes_per_value: int = 1


EIGHT_BITS = {
    'bgr8': Encoding(3),
    'rgb8': Encoding(3, cv2.COLOR_RGB2BGR),
    'bgra8': Encoding(4, cv2.COLOR_BGRA2BGR),
    'rgba8': Encoding(4, cv2.COLOR_RGBA2BGR),
    'mono8': Encoding(1),
    # OpenCV names its patterns by the second row and column.
    'bayer_rggb8': Encoding(1, cv2.COLOR_BayerBG2BGR),
    'bayer_bggr8': Encoding(1, cv2.COLOR_BayerRG2BGR),
    'bayer_gbrg8': Encoding(1, cv2.COLOR_BayerGR2BGR),
    'bayer_grbg8': Encoding(1, cv2.COLOR_BayerGB2BGR),
    # OpenCV's names, which say nothing of colour; it is in OpenCV's order then.
    '8UC1': Encoding(1),
    '8UC3': Encoding(3),
    '8UC4': Encoding(4, cv2.COLOR_BGRA2BGR),
}
SIXTEEN_BITS = {
    name.replace('8', '16', 1): encoding._replace(bytes_per_value=2)
    for name, encoding in EIGHT_BITS.items()}
YUV_422 = {
    'yuv422': Encoding(2, cv2.COLOR_YUV2BGR_UYVY),
    'uyvy': Encoding(2, cv2.COLOR_YUV2BGR_UYVY),
    'yuv422_yuy2': Encoding(2, cv2.COLOR_YUV2BGR_YUY2),
    'yuyv': Encoding(2, cv2.COLOR_YUV2BGR_YUY2),
}
ENCODINGS: dict[str, Encoding] = {**EIGHT_BITS, **SIXTEEN_BITS, **YUV_422}

# A plane of Y and one of both U and V behind it: the conversion, where U and V are fewer.
PLANES: dict[str, int | None] = {
    'nv12': cv2.COLOR_YUV2BGR_NV12, 'nv21': cv2.COLOR_YUV2BGR_NV21, 'nv24': None}


def image_from_raw(msg: Any) -> Image:
    """Return the picture in an Image message, BGR or grey; rows may be padded."""
    if msg.encoding not in ENCODINGS and msg.encoding not in PLANES:
        raise ImageError('unknown encoding', f'{msg.encoding!r} is none of colour or grey: '
                         f'{", ".join((*ENCODINGS, *PLANES))}')
    if not (msg.width and msg.height):
        raise ImageError('zero size', f'{msg.width}x{msg.height}')
    data = np.frombuffer(msg.data, np.uint8)
    try:
        if msg.encoding in PLANES:
            return _from_planes(msg, data)
        return _from_rows(msg, data, ENCODINGS[msg.encoding])
    except cv2.error:
        # Two pixels share their colour in YUV, four in a Bayer pattern.
        raise ImageError(
            'odd size', f'{msg.width}x{msg.height} ({msg.encoding})') from None


def _from_rows(msg: Any, data: NDArray[np.uint8], encoding: Encoding) -> Image:
    """Return the picture in rows of whole pixels."""
    channels, conversion, bytes_per_value = encoding
    rows = _plane(msg, data, msg.height, msg.width * channels * bytes_per_value, msg.step)
    if bytes_per_value == 2:
        # The upper byte comes first or last.
        rows = rows[:, 0 if msg.is_bigendian else 1::2]
    image = np.ascontiguousarray(rows)
    if channels > 1:
        image = image.reshape(msg.height, msg.width, channels)
    return image if conversion is None else cv2.cvtColor(image, conversion)


def _from_planes(msg: Any, data: NDArray[np.uint8]) -> Image:
    """Return the picture in a plane of Y and one of U and V, pixel by pixel."""
    height, width, conversion = msg.height, msg.width, PLANES[msg.encoding]
    if conversion is not None and (height % 2 or width % 2):
        raise ImageError('odd size', f'{width}x{height} ({msg.encoding})')
    # In rows of Y's width. The step is Y's; some senders give what a row takes in all planes.
    row_count = height * 3 if conversion is None else height * 3 // 2
    step = width if data.size == row_count * width else msg.step
    rows = _plane(msg, data, row_count, width, step)
    if conversion is not None:
        return cv2.cvtColor(np.ascontiguousarray(rows), conversion)
    colour = data[height * step:].reshape(height, 2 * step)[:, :2 * width]
    return cv2.transform(np.dstack((rows[:height], colour.reshape(height, width, 2))),
                         bgr_from_yuv(SMPTE170M, is_full_range=False))


def _plane(msg: Any, data: NDArray[np.uint8], row_count: int, row_bytes: int, step: int
           ) -> NDArray[np.uint8]:
    """Return the rows in ``data`` without what pads them; ImageError if it is not all there."""
    if step < row_bytes:
        raise ImageError('wrong step', f'{step} bytes for rows of {row_bytes} ({msg.encoding})')
    if data.size != step * row_count:
        reason = 'truncated data' if data.size < step * row_count else 'wrong step'
        raise ImageError(reason, f'{data.size} bytes for {row_count} rows of {step}')
    return data.reshape(row_count, step)[:, :row_bytes]
