# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Pictures in messages, damaged in every way: a picture, or an ImageError."""

from functools import cache
from types import SimpleNamespace

import cv2
from fuzzing import examples, mutated, tried
from hypothesis import given, strategies as st
import numpy as np
import pytest
from sph_stab_ros.images.appearance import reduced, seen_in
from sph_stab_ros.images.codec import ImageError
from sph_stab_ros.images.frame import frame_from_message
from sph_stab_ros.images.message_decoder import MessageDecoder
from sph_stab_ros.images.picture_time import Stamp
from sph_stab_ros.images.raw import ENCODINGS, PLANES
from tiny_recordings import textured_sphere


@cache
def files():
    """Return pictures of every kind of file."""
    image = textured_sphere(64)
    deep = np.uint16(image) * 257
    options = {
        '.jpg': ((), (cv2.IMWRITE_JPEG_PROGRESSIVE, 1), (cv2.IMWRITE_JPEG_RST_INTERVAL, 4)),
        '.png': ((), (cv2.IMWRITE_PNG_COMPRESSION, 0))}
    return tuple(
        cv2.imencode(suffix, picture, one)[1].tobytes()
        for suffix, found in options.items() for one in found
        for picture in (image, image[..., 0], *([deep] if suffix == '.png' else ())))


def markers(data):
    """Return where the segments of JPEG and the chunks of PNG begin, about."""
    return [at for at in range(len(data) - 8) if data[at] == 0xff and data[at + 1] not in (
        0, 0xff)] or [at for at in range(8, len(data) - 4) if data[at:at + 4].isalpha()]


def look_at(frame):
    """Ask for all that a frame can be asked for."""
    frame.grey(16)
    frame.load()
    seen_in(reduced(frame.image))


@given(st.deferred(lambda: mutated(*files(), hot=markers)))
@examples(150)
def test_compressed_images(data):
    with tried('compressed', data):
        try:
            look_at(frame_from_message(SimpleNamespace(format='jpeg', data=data), 0))
        except ImageError as error:
            assert error.reason and '\n' not in str(error)


SIZES = st.integers(0, 40) | st.sampled_from((2**16, 2**31 - 1, 2**32 - 1))


@given(st.builds(
    SimpleNamespace, width=SIZES, height=SIZES, step=SIZES, is_bigendian=st.integers(0, 255),
    encoding=st.sampled_from((*ENCODINGS, *PLANES, '', 'jpeg')),
    data=st.binary(max_size=300)))
@examples(150)
def test_raw_images(msg):
    with tried('raw', repr(msg)):
        try:
            look_at(frame_from_message(msg, 0))
        except ImageError as error:
            assert error.reason and '\n' not in str(error)


@given(st.sampled_from((*ENCODINGS, *PLANES)), st.integers(1, 20), st.integers(1, 20),
       st.integers(0, 9), st.integers(-2, 2), st.booleans())
@examples(150)
def test_raw_images_of_about_the_right_size(encoding, width, height, padding, more, order):
    per_pixel = ENCODINGS[encoding] if encoding in ENCODINGS else None
    row = width * (per_pixel.channels * per_pixel.bytes_per_value if per_pixel else 1) + padding
    rows = height if per_pixel else height * 3 if encoding == 'nv24' else height * 3 // 2
    msg = SimpleNamespace(
        width=width, height=height, step=row, is_bigendian=order, encoding=encoding,
        data=bytes(max(row * rows + more, 0)))
    with tried('raw_right', repr(msg)):
        try:
            look_at(frame_from_message(msg, 0))
        except ImageError as error:
            assert error.reason and '\n' not in str(error)


@given(st.data())
@examples(30)
def test_video_in_messages(data):
    encoded_video = pytest.importorskip('encoded_video')
    codec = data.draw(st.sampled_from(('h264', 'h264 B', 'h265', 'av1')))
    packets = [packet for _, packet in encoded_video.stream(codec)[:12]]
    for at in data.draw(st.lists(st.integers(0, len(packets) - 1), min_size=1, max_size=4)):
        packets[at] = data.draw(mutated(packets[at]))
    with tried('video', b'\0\0\0\0MESSAGE'.join(packets)):
        decoder = MessageDecoder(lambda line: None)
        outcomes = []
        for number, packet in enumerate(packets):
            message = encoded_video.message(packet, codec.split()[0], number)
            outcomes += decoder.decode(message, number, Stamp(number * 33_333_333))
        outcomes += decoder.flush()
        for _, outcome in outcomes:
            assert isinstance(outcome, ImageError) or outcome.image is not None


@given(st.tuples(st.integers(1, 300), st.integers(1, 300)), st.integers(0, 255))
@examples(50)
def test_a_look_at_any_picture(size, grey):
    """Whatever its shape."""
    seen_in(reduced(np.full(size, grey, np.uint8)))
