# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
"""Pictures as cameras send them: every raw encoding, and files that are not quite by the book."""

from io import BytesIO
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from sph_stab_ros.images.codec import image_from_message, ImageError
from sph_stab_ros.images.frame import frame_from_message
from sph_stab_ros.images.raw import ENCODINGS, PLANES
from tiny_recordings import textured_sphere

WIDTH, HEIGHT = 128, 64
BGR = cv2.GaussianBlur(textured_sphere(WIDTH), (0, 0), 3)
GREY = cv2.cvtColor(BGR, cv2.COLOR_BGR2GRAY)
# Y, U and V of each pixel, with the same colour wherever 4:2:0 has one value only.
I420 = cv2.cvtColor(BGR, cv2.COLOR_BGR2YUV_I420)
Y = I420[:HEIGHT]
U, V = (plane.reshape(HEIGHT // 2, WIDTH // 2) for plane in np.split(I420[HEIGHT:], 2))
BGR_OF_I420 = cv2.cvtColor(I420, cv2.COLOR_YUV2BGR_I420)


def mosaic(bgr, pattern):
    """Return what a sensor sees under a Bayer filter, its first two rows named by ``pattern``."""
    seen = np.empty(bgr.shape[:2], np.uint8)
    for number, colour in enumerate(pattern):
        row, column = divmod(number, 2)
        seen[row::2, column::2] = bgr[row::2, column::2, 'bgr'.index(colour)]
    return seen


def packed_422(first, second, y_at):
    """Return rows of two pixels in four bytes; Y at offset ``y_at`` of each two."""
    rows = np.empty((HEIGHT, WIDTH, 2), np.uint8)
    rows[:, :, y_at] = Y
    rows[:, ::2, 1 - y_at], rows[:, 1::2, 1 - y_at] = first.repeat(2, 0), second.repeat(2, 0)
    return rows.reshape(HEIGHT, -1)


def flat(*channels):
    return np.dstack(channels).reshape(HEIGHT, -1)


RGB, ALPHA = BGR[..., ::-1], np.full((HEIGHT, WIDTH), 200, np.uint8)
# Encoding: the rows that are sent, and what is to be read.
EIGHT_BITS = {
    'bgr8': (flat(BGR), BGR), 'rgb8': (flat(RGB), BGR), 'mono8': (GREY, GREY),
    'bgra8': (flat(BGR, ALPHA), BGR), 'rgba8': (flat(RGB, ALPHA), BGR),
    '8UC1': (GREY, GREY), '8UC3': (flat(BGR), BGR), '8UC4': (flat(BGR, ALPHA), BGR),
    **{f'bayer_{pattern}8': (mosaic(BGR, pattern), BGR)
       for pattern in ('rggb', 'bggr', 'gbrg', 'grbg')}}
SIXTEEN_BITS = {name.replace('8', '16', 1): both for name, both in EIGHT_BITS.items()}
YUV = {
    'uyvy': packed_422(U, V, 1), 'yuv422': packed_422(U, V, 1),
    'yuyv': packed_422(U, V, 0), 'yuv422_yuy2': packed_422(U, V, 0),
    'nv12': np.vstack((Y, np.dstack((U, V)).reshape(HEIGHT // 2, WIDTH))),
    'nv21': np.vstack((Y, np.dstack((V, U)).reshape(HEIGHT // 2, WIDTH))),
    'nv24': np.vstack((Y, np.dstack((
        U.repeat(2, 0).repeat(2, 1), V.repeat(2, 0).repeat(2, 1))).reshape(2 * HEIGHT, WIDTH)))}


def message(encoding, rows, step, is_bigendian=0):
    """Return what looks like an Image message."""
    return SimpleNamespace(height=HEIGHT, width=WIDTH, encoding=encoding, step=step,
                           is_bigendian=is_bigendian, data=rows.tobytes())


def padded(rows, padding):
    """Return rows with garbage behind each."""
    return np.hstack((rows, np.full((len(rows), padding), 77, np.uint8)))


def test_every_encoding_is_tried_here():
    assert {*EIGHT_BITS, *SIXTEEN_BITS, *YUV} == {*ENCODINGS, *PLANES}


@pytest.mark.parametrize('padding', [0, 6])
@pytest.mark.parametrize('encoding', EIGHT_BITS)
def test_eight_bits(encoding, padding):
    rows, expected = EIGHT_BITS[encoding]
    rows = padded(rows, padding)
    image = image_from_message(message(encoding, rows, rows.shape[1]))
    check(image, expected, encoding)


@pytest.mark.parametrize('padding', [0, 6])
@pytest.mark.parametrize('order', ['<', '>'])
@pytest.mark.parametrize('encoding', SIXTEEN_BITS)
def test_sixteen_bits_in_either_order(encoding, order, padding):
    rows, expected = SIXTEEN_BITS[encoding]
    # The lower byte is of no account.
    rows = (rows.astype(np.uint16) * 256 + 255 - rows).astype(f'{order}u2').view(np.uint8)
    rows = padded(rows, padding)
    image = image_from_message(message(encoding, rows, rows.shape[1], int(order == '>')))
    check(image, expected, encoding)


def check(image, expected, encoding):
    """Compare; between the pixels of a Bayer pattern colours are interpolated."""
    assert image.dtype == np.uint8 and image.shape == expected.shape
    error = np.abs(image.astype(int) - expected)
    assert error.max() == 0 or 'bayer' in encoding and error[2:-2, 2:-2].max() < 12


@pytest.mark.parametrize('padding', [0, 6])
@pytest.mark.parametrize('encoding', YUV)
def test_yuv(encoding, padding):
    """Compared with what OpenCV makes of the same planes; padded as the rows of Y are."""
    rows = YUV[encoding]
    if encoding == 'nv24' and padding:
        colour = padded(rows[HEIGHT:].reshape(HEIGHT, 2 * WIDTH), 2 * padding)
        data = np.concatenate((padded(rows[:HEIGHT], padding).ravel(), colour.ravel()))
    else:
        data = padded(rows, padding)
    step = rows.shape[1] + padding
    image = image_from_message(message(encoding, data, step))
    assert np.abs(image.astype(int) - BGR_OF_I420).max() <= 1


@pytest.mark.parametrize('encoding', PLANES)
def test_planes_whose_step_counts_all_of_them(encoding):
    rows = YUV[encoding]
    image = image_from_message(message(encoding, rows, rows.size // HEIGHT))
    assert np.abs(image.astype(int) - BGR_OF_I420).max() <= 1


@pytest.mark.parametrize('encoding', [*ENCODINGS, *PLANES])
@pytest.mark.parametrize('size_wh', [(1, 1), (1, 2), (2, 1), (3, 3), (5, 2)], ids=str)
def test_small_and_odd_sizes_are_read_or_refused(encoding, size_wh):
    width, height = size_wh
    bytes_per_pixel = 3 if encoding in PLANES else (
        ENCODINGS[encoding].channels * ENCODINGS[encoding].bytes_per_value)
    step = width if encoding in PLANES else width * bytes_per_pixel
    rows = height * {'nv24': 6, 'nv12': 3, 'nv21': 3}.get(encoding, 2) // 2
    msg = SimpleNamespace(height=height, width=width, encoding=encoding, step=step,
                          is_bigendian=0, data=bytes(step * rows))
    try:
        assert image_from_message(msg).shape[:2] == (height, width)
    except ImageError as error:
        assert error.reason == 'odd size'


@pytest.mark.parametrize('encoding', [*ENCODINGS, *PLANES])
def test_what_is_not_all_there_is_refused(encoding):
    rows = {**{name: rows for name, (rows, _) in EIGHT_BITS.items()}, **YUV}.get(encoding)
    if rows is None:
        rows = padded(SIXTEEN_BITS[encoding][0], SIXTEEN_BITS[encoding][0].shape[1])
    for data, reason in ((rows.ravel()[:-1], 'truncated data'), (rows.ravel()[:0], 'truncated'),
                         (np.append(rows.ravel(), np.uint8(0)), 'wrong step')):
        with pytest.raises(ImageError, match=reason):
            image_from_message(message(encoding, data, rows.shape[1]))


def jpeg(image, *options):
    return cv2.imencode('.jpg', image, options)[1].tobytes()


def segments(data):
    """Yield (marker, segment) of a JPEG file, the scan with all that follows."""
    at = 2
    while data[at + 1] != 0xda:
        end = at + 2 + int.from_bytes(data[at + 2:at + 4], 'big')
        yield data[at + 1], data[at:end]
        at = end
    yield 0xda, data[at:]


def compressed(data):
    """Return what looks like a CompressedImage."""
    return SimpleNamespace(format='jpeg', data=data)


def check_both(data, expected):
    """Compare what bags and the live node read."""
    assert np.array_equal(image_from_message(compressed(data)), expected)
    frame = frame_from_message(compressed(data), 0)
    assert frame.grey(32).shape[1] >= 32
    frame.load()
    assert np.array_equal(frame.image, expected)


def test_jpeg_without_huffman_tables():
    """As MJPEG from USB cameras: the standard ones are meant."""
    data = jpeg(BGR)
    without = data[:2] + b''.join(part for marker, part in segments(data) if marker != 0xc4)
    assert len(without) < len(data)
    check_both(without, image_from_message(compressed(data)))


RESTARTS = cv2.IMWRITE_JPEG_RST_INTERVAL, 4
OPTIMIZED = cv2.IMWRITE_JPEG_OPTIMIZE, 1


@pytest.mark.parametrize('options', [(), RESTARTS, OPTIMIZED], ids=str)
@pytest.mark.parametrize('image', [textured_sphere(WIDTH), GREY, BGR * 0], ids=len)
def test_jpeg_without_end_marker(image, options, capfd):
    """Read where all is there; and no half-grey picture comes through."""
    data = jpeg(image, *options)
    expected = image_from_message(compressed(data))
    check_both(data[:-2], expected)
    check_both(data[:-1], expected)
    # The decoder has nothing to complain of.
    assert capfd.readouterr().err == ''
    # Some fill a buffer of fixed size.
    check_both(data[:-2] + bytes(500), expected)
    for end in range(data.rfind(b'\xff\xda'), len(data) - 2):
        try:
            found = image_from_message(compressed(data[:end]))
        except ImageError as error:
            assert error.reason == 'truncated JPEG'
            continue
        # Nothing may be missing but in the last block; what is between is interpolated.
        differ = np.argwhere((found != expected).reshape(HEIGHT, WIDTH, -1).any(-1))
        assert (differ >= (HEIGHT - 18, WIDTH - 18)).all(), len(data) - end


def test_progressive_jpeg():
    data = jpeg(BGR, cv2.IMWRITE_JPEG_PROGRESSIVE, 1)
    check_both(data, cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR))
    # Which scans are still to come cannot be known.
    with pytest.raises(ImageError, match='truncated JPEG'):
        image_from_message(compressed(data[:-2]))


@pytest.mark.parametrize('progressive', [False, True])
def test_cmyk_jpeg(progressive):
    pillow = pytest.importorskip('PIL.Image')
    file = BytesIO()
    pillow.fromarray(np.ascontiguousarray(RGB)).convert('CMYK').save(
        file, 'JPEG', quality=95, progressive=progressive)
    image = image_from_message(compressed(file.getvalue()))
    assert np.abs(image.astype(int) - BGR).mean() < 3
    check_both(file.getvalue(), image)


@pytest.mark.parametrize(
    'image', [BGR, GREY, np.dstack((BGR, ALPHA))], ids=['bgr', 'grey', 'alpha'])
def test_png_of_sixteen_bits(image):
    data = cv2.imencode('.png', image.astype(np.uint16) * 257)[1].tobytes()
    expected = image if image.ndim == 2 else image[..., :3]
    assert np.array_equal(image_from_message(compressed(data)), expected)
    assert np.array_equal(frame_from_message(compressed(data), 0).image, expected)
