# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Video in messages: what senders write of it, how they send it, and what can be asked for."""

import re
from types import SimpleNamespace
from unittest import mock

import cv2
from encoded_video import (
    av, codec_of, COUNT, encode, KEY_PERIOD, message, MESSAGES, outcomes, PERIOD_NS, pictures,
    reasons, stream)
import numpy as np
import pytest
from sph_stab_ros.images.codec import encode_jpeg, ImageError, video_codec
from sph_stab_ros.images.frame import Frame
from sph_stab_ros.images.image_error import DecoderMissing
from sph_stab_ros.images.message_decoder import MessageDecoder
from sph_stab_ros.images.picture_time import Stamp
from sph_stab_ros.images.video.decoder import MISSING, NO_KEY
from tiny_recordings import textured_sphere, turning_spheres


@pytest.mark.parametrize('name', ['h264', 'h265', 'av1'])
def test_parameters_may_come_by_themselves(name):
    """Some senders give them a message of their own, at the start or before each key picture."""
    packets = []
    for index, data in stream(name):
        head = parameters(data, name)
        packets += [head, data[len(head):]] if head else [data]
    assert len(packets) == COUNT + COUNT // KEY_PERIOD
    for start in (0, 2):
        decoder, found = MessageDecoder([].append), []
        for data in packets[start:]:
            found += decoder.decode(message(data, name), None, Stamp(0))
        shown = [source for _, source in found if not isinstance(source, ImageError)]
        expected = list(pictures(name).values())[0 if start == 0 else KEY_PERIOD:]
        assert all(np.array_equal(one.image, other) for one, other in zip(shown, expected))
        assert len(shown) == len(expected)


def parameters(data, name):
    """Return what stands before the picture in the message of a key picture."""
    if name == 'av1':
        # Temporal delimiter and sequence header, each with its size.
        at = 0
        while data[at] >> 3 in (1, 2):
            at += 2 + data[at + 1]
        return data[:at] if at > 2 else b''
    key = re.search(b'\0\0\1[\x65\x25]' if name == 'h264' else b'\0\0\1[\x26\x28\x2a]', data)
    return data[:key.start()] if key else b''


def test_a_stream_whose_parameters_are_missing_is_told_of():
    """As where they are sent once, and the recording began later."""
    packets = [(index, data[len(parameters(data, 'h264')):]) for index, data in stream('h264')]
    found = outcomes(packets, 'h264')
    assert len(found) == COUNT
    assert 'without their parameters' in str(found[KEY_PERIOD][1])


@pytest.mark.parametrize('codec, texts', {
    'h264': ['h264', 'H264', 'h.264', 'H.264', 'video/h264', 'libx264', 'h264_nvenc', 'avc1',
             'h264_vaapi', 'h264;yuv420p;bgr8;bgr8', 'bgr8; h264 compressed bgr8'],
    'h265': ['h265', 'H.265', 'hevc', 'HEVC', 'libx265', 'hevc_nvenc', 'hevc;nv12;bgr8;bgr8'],
    'av1': ['av1', 'AV1', 'libsvtav1', 'libaom-av1', 'av1_nvenc', 'av01'],
    None: ['jpeg', 'bgr8; jpeg compressed bgr8', 'png', '16UC1; compressedDepth', 'vp9', '',
           'rgb8; png compressed', 'mjpeg', 'mp4v', 'webp', 'theora']}.items())
def test_formats_are_known_by_what_senders_write(codec, texts):
    for text in texts:
        for make in MESSAGES.values():
            assert video_codec(make(b'\0\0\0\1abc', text)) == codec, text


def test_a_picture_by_itself_is_read_whatever_is_said_of_it():
    """As by drivers that write what they were asked for, not what they do."""
    jpeg = encode_jpeg(textured_sphere(64)).tobytes()
    for make in MESSAGES.values():
        found = outcomes([(0, jpeg)], 'h264', make)
        assert found[0][1].image.shape == (32, 64, 3)
    raw = SimpleNamespace(step=64, data=bytes(8), encoding='h264')
    assert video_codec(raw) is None


def test_other_formats_are_named():
    (_, error), = outcomes([(0, b'\x82IB')], 'vp9')
    assert str(error) == "not JPEG or PNG: 3 bytes of format 'vp9'"


def test_a_stream_may_change_its_size_and_codec():
    small, other = turning_spheres(4, 128)[0], turning_spheres(4, 256)[0]
    decoder, found = MessageDecoder([].append), []
    for images, name in ((small, 'h264'), (other, 'h264'), (other, 'h265 B'), (small, 'av1')):
        for index, data in encode(images, name):
            found += decoder.decode(message(data, codec_of(name)), index, Stamp(0))
    found += decoder.flush()
    assert [index for index, _ in found] == 4 * [*range(4)]
    assert [source.size_wh[0] for _, source in found] == 4 * [128] + 8 * [256] + 4 * [128]


@pytest.mark.parametrize('pause_s, is_gap', [(0.08, False), (2., True)])
def test_a_pause_after_which_numbers_may_have_begun_again_is_a_gap(pause_s, is_gap):
    """What follows looks like the next picture, but need not be."""
    packets = encode(turning_spheres(12, 128)[0], 'h264 refresh')
    decoder, found = MessageDecoder([].append), []
    for index, data in packets:
        late_ns = round(pause_s * 1e9) if index >= 10 else 0
        found += decoder.decode(
            message(data), index, Stamp(index * PERIOD_NS + late_ns, index * PERIOD_NS + late_ns))
    assert reasons(found) == ([MISSING, NO_KEY] if is_gap else [])


def test_a_clock_that_is_set_is_no_gap():
    """Times of receipt go on as before."""
    decoder, found = MessageDecoder([].append), []
    for index, data in encode(turning_spheres(12, 128)[0], 'h264'):
        stamp_ns = index * PERIOD_NS + (10**18 if index >= 9 else 0)
        found += decoder.decode(message(data), index, Stamp(stamp_ns, index * PERIOD_NS))
    assert not reasons(found) and len(found) == 12


def test_a_picture_is_given_as_is_asked_for():
    """Grey is the decoder's luma from black to white, whoever asks for colours besides."""
    found = outcomes(stream('h264'), 'h264')
    context = av.CodecContext.create('h264', 'r')
    direct = [frame for index, data in stream('h264') for frame in context.decode(av.Packet(data))]
    for (index, source), frame in zip(found, direct):
        picture = Frame(source, index)
        assert picture.size_wh == (128, 64)
        luma = frame.to_ndarray(format='yuv420p')[:64].astype(float)
        grey = picture.grey()
        np.testing.assert_allclose(grey, ((luma - 16) * 255 / 219).clip(0, 255), atol=0.51)
        small = picture.grey(40)
        assert small.shape == (22, 43)
        reduced = cv2.resize(grey, (43, 22), interpolation=cv2.INTER_AREA)
        np.testing.assert_allclose(small, reduced.astype(float), atol=2)
        picture.load()
        assert np.array_equal(picture.grey(), grey) and np.array_equal(picture.grey(40), small)
        # FFmpeg makes the coarse colours finer in another way.
        colours = frame.to_ndarray(format='bgr24')
        assert np.abs(picture.image.mean(axis=(0, 1)) - colours.mean(axis=(0, 1))).max() < 2
    bgr = cv2.cvtColor(pictures('h264')[0], cv2.COLOR_BGR2GRAY).astype(float)
    assert np.corrcoef(bgr.ravel(), found[0][1].grey().ravel())[0, 1] > 0.999


@pytest.mark.parametrize('pix_fmt', [
    'gray', 'yuv422p', 'yuv444p', 'yuv420p10le', 'gbrp', 'yuvj420p'])
def test_pictures_of_other_planes_are_grey_and_coloured_too(pix_fmt):
    image = turning_spheres(1, 128)[0][0]
    # H.264's decoder gives grey as colours.
    encoder = {'gray': 'libx265', 'gbrp': 'libx264rgb'}.get(pix_fmt, 'libx264')
    context = av.CodecContext.create(encoder, 'w')
    context.width, context.height = 128, 64
    context.pix_fmt = 'bgr24' if pix_fmt == 'gbrp' else pix_fmt
    context.time_base = 1
    context.options = {'crf': '0' if pix_fmt == 'gbrp' else '1', 'tune': 'zerolatency',
                       'x265-params': 'log-level=none'}
    picture = av.VideoFrame.from_ndarray(image, format='bgr24')
    packet, = [*context.encode(picture), *context.encode(None)]
    (_, source), = outcomes([(0, bytes(packet))], 'h265' if pix_fmt == 'gray' else 'h264')
    grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY).astype(float)
    assert source.grey().shape == (64, 128) and source.grey().dtype == np.uint8
    assert np.corrcoef(source.grey().ravel(), grey.ravel())[0, 1] > 0.99
    assert source.image.shape == ((64, 128) if pix_fmt == 'gray' else (64, 128, 3))


@pytest.mark.parametrize('codec, name', [('h264', 'H.264'), ('h265', 'H.265'), ('av1', 'AV1')])
def test_without_pyav_one_line_says_what_to_install(codec, name):
    with mock.patch.dict('sys.modules', {'av': None}):
        with pytest.raises(DecoderMissing) as error:
            outcomes([(0, b'\0\0\1\x65')], codec)
    assert str(error.value) == (
        f"no decoder of {name}: {name} in messages needs PyAV: pip install 'av>=16,<19'")
