# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Video as encoders give it, one packet for each message, and what its decoder makes of all."""

from fractions import Fraction
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
from sph_stab_ros.images.codec import ImageError, stamp_and_frame
from sph_stab_ros.images.message_decoder import MessageDecoder
from sph_stab_ros.images.picture_time import Stamp
from sph_stab_ros.images.video.picture import tagged_colour, VideoPicture
from tiny_recordings import turning_spheres

# Who imports this is skipped without.
av = pytest.importorskip('av')

KEY_PERIOD, COUNT, WIDTH = 8, 24, 128
X265 = 'log-level=none'
# Encoder, its options, and of what messages name the format. Without pictures in between
# ("zerolatency"), with such (B), with key pictures that later ones reach across (open), without
# key pictures (refresh).
STREAMS = {
    'h264': ('libx264', {'preset': 'ultrafast', 'tune': 'zerolatency'}),
    'h264 B': ('libx264', {'preset': 'medium', 'bf': '2'}),
    'h264 open': ('libx264', {'preset': 'medium', 'bf': '2', 'x264-params': 'open-gop=1'}),
    'h264 refresh': ('libx264', {
        'preset': 'veryfast', 'tune': 'zerolatency', 'x264-params': 'intra-refresh=1'}),
    'h265': ('libx265', {
        'preset': 'ultrafast', 'tune': 'zerolatency', 'x265-params': X265}),
    'h265 B': ('libx265', {
        'preset': 'fast', 'x265-params': f'{X265}:bframes=2:open-gop=0'}),
    'h265 open': ('libx265', {'preset': 'fast', 'x265-params': f'{X265}:bframes=2:open-gop=1'}),
    'av1': ('libsvtav1', {'preset': '11', 'svtav1-params': 'pred-struct=1'}),
    'av1 hidden': ('libsvtav1', {'preset': '11'})}
# Those in which decoding begins with key pictures only, at known places.
CLOSED = ('h264', 'h264 B', 'h265', 'h265 B', 'av1', 'av1 hidden')
PERIOD_NS = 33_333_333
DECODERS = {'h264': 'h264', 'h265': 'hevc', 'av1': 'libdav1d'}


def encode(images, name, key_period=KEY_PERIOD, pixel_format='yuv420p'):
    """Return (index of the picture, packet) of a stream, in the order of decoding."""
    encoder, options = STREAMS[name]
    try:
        context = av.CodecContext.create(encoder, 'w')
    except ValueError:
        pytest.skip(f'this PyAV has no {encoder}')
    context.height, context.width = images[0].shape[:2]
    context.pix_fmt, context.gop_size = pixel_format, key_period
    context.time_base, context.framerate = Fraction(1, 30), Fraction(30)
    context.options = options
    packets = []
    for index, image in enumerate(images):
        picture = av.VideoFrame.from_ndarray(image, format='bgr24')
        picture.pts, picture.time_base = index, context.time_base
        packets += context.encode(picture)
    return [(packet.pts, bytes(packet)) for packet in (*packets, *context.encode(None))]


@cache
def stream(name):
    """Return the packets of a short stream of a turning camera."""
    return encode(turning_spheres(COUNT, WIDTH)[0], name)


@cache
def pictures(name):
    """Return the pictures of ``stream`` as the decoder gives them of the whole, by index."""
    return decode(stream(name), name)


def decode(packets, name):
    """Return pictures by index, decoded as those of a video file are."""
    context = av.CodecContext.create(DECODERS[codec_of(name)], 'r')
    frames = []
    for index, data in packets:
        packet = av.Packet(data)
        packet.pts = index
        frames += context.decode(packet)
    return {frame.pts: VideoPicture(frame, tagged_colour(frame, context)).image
            for frame in (*frames, *context.decode(None))}


def keys(name):
    """Return where in the order of decoding the key pictures of a closed stream are."""
    return [at for at, (index, _) in enumerate(stream(name)) if index % KEY_PERIOD == 0]


def message(data, format='h264', index=0):  # noqa: A002
    """Return what looks like a CompressedImage."""
    stamp = SimpleNamespace(sec=1000, nanosec=index * PERIOD_NS)
    return SimpleNamespace(header=SimpleNamespace(stamp=stamp, frame_id='camera'), format=format,
                           data=np.frombuffer(data, np.uint8))


def packet_message(data, encoding='libx264', index=0):
    """Return what looks like an FFMPEGPacket."""
    msg = message(data, index=index)
    return SimpleNamespace(header=msg.header, encoding=encoding, data=msg.data, pts=index)


def video_message(data, format='h264', index=0):  # noqa: A002
    """Return what looks like a CompressedVideo."""
    msg = message(data, index=index)
    return SimpleNamespace(timestamp=msg.header.stamp, frame_id='camera', data=msg.data,
                           format=format)


MESSAGES = {'CompressedImage': message, 'FFMPEGPacket': packet_message,
            'CompressedVideo': video_message}


def codec_of(name):
    return name.split()[0]


def outcomes(packets, name, make=message, said=None):
    """Return (index, picture or ImageError) of messages with these packets."""
    decoder = MessageDecoder([].append if said is None else said.append)
    found = []
    for index, data in packets:
        msg = make(data, codec_of(name), index)
        found += decoder.decode(msg, index, Stamp(stamp_and_frame(msg)[0]))
    return found + [*decoder.flush()]


def given_pictures(found):
    """Return the pictures by index, in their order; check that there is one outcome for each."""
    assert len({index for index, _ in found}) == len(found)
    shown = {index: source.image for index, source in found
             if not isinstance(source, ImageError)}
    assert list(shown) == sorted(shown)
    return shown


def check_right(shown, name):
    """Check that pictures are those of the whole stream, to the last bit."""
    for index, image in shown.items():
        assert np.array_equal(image, pictures(name)[index]), (name, index)


def reasons(found):
    return [source.reason for _, source in found if isinstance(source, ImageError)]
