# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Small videos for tests, encoded as cameras do, with or without sound and metadata."""

from fractions import Fraction
from struct import pack
from unittest import mock

import av
import numpy as np

from sph_stab_ros.recording import spherical_boxes
from sph_stab_ros.recording.spherical_boxes import packed

RATE = 25
SOUND_RATE = 48000
# H.264 without any loss.
LOSSLESS = {'qp': '0', 'preset': 'ultrafast'}


def frame_of(planes, pix_fmt):
    """Return a picture of planes (Y, U, V), of bytes or of words."""
    height, width = planes[0].shape
    picture = av.VideoFrame(width, height, pix_fmt)
    for plane, values in zip(picture.planes, planes, strict=True):
        rows = np.zeros((plane.height, plane.line_size // values.itemsize), values.dtype)
        rows[:, :values.shape[1]] = values
        plane.update(rows.tobytes())
    return picture


def bgr_frame(image):
    """Return the picture of a BGR image in YUV, as PyAV makes it."""
    return av.VideoFrame.from_ndarray(image, format='bgr24').reformat(format='yuv420p')


def encode(path, pictures, codec='libx264', options=None, pts_ms=None, tags=(), sound=None,
           sound_codec='aac', tracks=1, sound_start_s=0., rate=RATE, **container_options):
    """
    Write a video of av.VideoFrames, at multiples of 1/rate s or at times in ms; return the path.

    ``tags`` are colorspace, color_range, color_primaries and color_trc; ``sound`` (N,) is mono, of
    so many equal ``tracks``.
    """
    time_base = Fraction(1, rate) if pts_ms is None else Fraction(1, 1000)
    with av.open(str(path), 'w', options=container_options) as container:
        stream = container.add_stream(codec, rate=rate, options=options or {})
        stream.width, stream.height = pictures[0].width, pictures[0].height
        stream.pix_fmt = pictures[0].format.name
        stream.time_base = stream.codec_context.time_base = time_base
        names = 'colorspace', 'color_range', 'color_primaries', 'color_trc'
        for name, value in zip(names, tags):
            setattr(stream.codec_context, name, value)
        heard = [container.add_stream(sound_codec, rate=SOUND_RATE, layout='mono')
                 for _ in range(tracks if sound is not None else 0)]
        for number, picture in enumerate(pictures):
            picture.pts = number if pts_ms is None else int(pts_ms[number])
            picture.time_base = time_base
            container.mux(stream.encode(picture))
        container.mux(stream.encode())
        for one in heard:
            _encode_sound(container, one, sound, round(sound_start_s * SOUND_RATE))
    return path


def encode_tracks(path, tracks, pts_ms=None, options=None):
    """
    Write a video whose tracks are these lists of av.VideoFrames; return the path.

    They are at multiples of 1/25 s, or each track at its list of times in ms.
    """
    with av.open(str(path), 'w') as container:
        streams = []
        for pictures in tracks:
            stream = container.add_stream('libx264', rate=RATE, options=options or LOSSLESS)
            stream.width, stream.height = pictures[0].width, pictures[0].height
            stream.pix_fmt = pictures[0].format.name
            stream.time_base = stream.codec_context.time_base = Fraction(1, 1000)
            streams.append(stream)
        for track, (stream, pictures) in enumerate(zip(streams, tracks)):
            times = (1000 // RATE * np.arange(len(pictures)) if pts_ms is None else pts_ms[track])
            for picture, at_ms in zip(pictures, times):
                picture.pts, picture.time_base = int(at_ms), Fraction(1, 1000)
                container.mux(stream.encode(picture))
            container.mux(stream.encode())
    return path


def _encode_sound(container, stream, sound, start):
    size = stream.codec_context.frame_size or 1024
    kind = stream.codec_context.format.name
    for begin in range(0, len(sound), size):
        part = sound[None, begin:begin + size]
        values = (np.float32(part) if kind.startswith('flt') else np.int16(32767 * part)
                  if kind.startswith('s16') else np.int32((2**31 - 1) * part))
        heard = av.AudioFrame.from_ndarray(np.ascontiguousarray(values), format=kind,
                                           layout='mono')
        heard.sample_rate, heard.pts = SOUND_RATE, start + begin
        heard.time_base = Fraction(1, SOUND_RATE)
        container.mux(stream.encode(heard))
    container.mux(stream.encode())


def chirp(seconds):
    """Return (N,) a sound that is another at every moment."""
    t = np.arange(round(seconds * SOUND_RATE)) / SOUND_RATE
    return 0.3 * np.sin(2 * np.pi * (200 * t + 300 * t ** 2))


def heard_in(path, track=0):
    """Return (N,) what is heard of a track from time zero on, as FFmpeg plays it."""
    with av.open(str(path)) as container:
        parts = [(round(frame.time * SOUND_RATE), frame.to_ndarray().ravel())
                 for frame in container.decode(container.streams.audio[track])]
    heard = np.zeros(max(start + len(values) for start, values in parts))
    for start, values in parts:
        scale = {'h': 2**15, 'i': 2**31}.get(values.dtype.char, 1)
        heard[max(start, 0):start + len(values)] = values[max(-start, 0):] / scale
    return heard


def stereo_box(mode):
    """Return a box st3d: 0 mono, 1 top-bottom, 2 left-right."""
    return packed(b'st3d', bytes(4) + bytes([mode]))


def sphere_box(left=0., top=0., right=0., bottom=0., projection=b'equi'):
    """Return a box sv3d of pictures whose edges are so far, as shares, from the sphere's."""
    bounds = pack('>4I', *(round(edge * 2**32) for edge in (top, bottom, left, right)))
    return packed(b'sv3d', packed(b'svhd', bytes(4) + b'a camera\0') + packed(
        b'proj', packed(b'prhd', bytes(16)) + packed(projection, bytes(4) + bounds)))


def cube_box(layout=0, padding=0):
    """Return a box sv3d of pictures of six faces of a cube."""
    return packed(b'sv3d', packed(b'svhd', bytes(4) + b'a camera\0') + packed(
        b'proj', packed(b'prhd', bytes(16)) + packed(
            b'cbmp', pack('>3I', 0, layout, padding))))


def xml_metadata(stereo='mono', extra='', projection='equirectangular'):
    """Return metadata of version 1 as a camera writes them."""
    return (
        '<?xml version="1.0"?><rdf:SphericalVideo '
        'xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#" '
        'xmlns:GSpherical="http://ns.google.com/videos/1.0/spherical/">'
        '<GSpherical:Spherical>true</GSpherical:Spherical>'
        '<GSpherical:Stitched>true</GSpherical:Stitched>'
        '<GSpherical:StitchingSoftware>a camera</GSpherical:StitchingSoftware>'
        f'<GSpherical:ProjectionType>{projection}</GSpherical:ProjectionType>'
        f'<GSpherical:StereoMode>{stereo}</GSpherical:StereoMode>{extra}'
        '</rdf:SphericalVideo>').encode()


def tagged(path, boxes=b'', xml=None):
    """Put spherical metadata of version 2 (boxes) or 1 (XML) into an MP4 file; return the path."""
    with mock.patch.object(spherical_boxes, 'version_2', lambda: boxes), \
            mock.patch.object(spherical_boxes, 'XML', xml or b''), \
            mock.patch.object(spherical_boxes, 'UUID', spherical_boxes.UUID if xml else bytes(16)):
        spherical_boxes.write_spherical(path)
    return path
