# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Packets of a live stream into pictures, never one that is made of missing or damaged ones."""

from collections.abc import Callable, Iterator
from contextlib import suppress
from typing import Any, TYPE_CHECKING, TypeAlias

from sph_stab_ros.geometry.conventions import NS_PER_S
from sph_stab_ros.images.codec import whole_file
from sph_stab_ros.images.image_error import ImageError
from sph_stab_ros.images.jpeg_file import JpegFile
from sph_stab_ros.images.picture_time import Stamp
from sph_stab_ros.images.video.decoder import DAMAGED, NO_KEY, VideoDecoder
from sph_stab_ros.images.video.picture import side_data_of, tagged_colour, VideoPicture
from sph_stab_ros.live.address import SourceError

if TYPE_CHECKING:
    import av

JPEG = 'mjpeg'
# FFmpeg's names of what VideoDecoder decodes, and of the filters that make messages of packets.
VIDEO = {'h264': ('h264', 'h264_mp4toannexb'), 'hevc': ('h265', 'hevc_mp4toannexb'),
         'av1': ('av1', None)}
# Of MP4, Matroska and FLV, whose packets have lengths in place of start codes.
CONFIGURATION = b'\1'

LiveImage: TypeAlias = JpegFile | VideoPicture
# The time of a picture in ns by the stream, and the picture or why there is none.
Decoded: TypeAlias = tuple[int | None, LiveImage | ImageError]


class PacketDecoder:
    """
    Decodes the packets of one stream, in their order.

    JPEG files stay files until somebody asks for more. H.264, H.265 and AV1 are followed as those
    in messages are; of all else FFmpeg says what is damaged.

    Parameters
    ----------
    stream
        Of video, of an open container.
    say
        Told in one line of what users should hear of.
    tells_keys
        Whether the container knows which pictures are key pictures. Most of FFmpeg's decoders make
        something of the others, or call them damaged, before there has been one.

    """

    def __init__(self, stream: 'av.VideoStream', say: Callable[[str], Any],
                 tells_keys: bool = False) -> None:
        import av
        from av.bitstream import BitStreamFilterContext
        self._error = av.FFmpegError
        self._stream, self._say = stream, say
        # Packets passed over since there was no key picture to begin with; None while decoding.
        self._passed: int | None = 0 if tells_keys else None
        if stream.codec_context is None:
            raise SourceError('its codec is unknown to FFmpeg')
        self.codec: str = stream.codec_context.codec.canonical_name
        # What FFmpeg tells of the pictures besides, such as how they show a sphere.
        self.side_data: dict[str, bytes] = {}
        self._has_side_data = False
        self._video: VideoDecoder[int | None] | None = None
        self._filter: BitStreamFilterContext | None = None
        if self.codec in VIDEO:
            codec, filter_name = VIDEO[self.codec]
            self._video = VideoDecoder(codec, say, is_live=True)
            parameters = stream.codec_context.extradata or b''
            if filter_name and parameters.startswith(CONFIGURATION):
                self._filter = BitStreamFilterContext(filter_name, stream)
            elif filter_name and parameters:
                # What describes the stream (SDP) may be all that has them.
                list(self._video.decode(parameters, None, Stamp(None)))
        else:
            # Several pictures at a time would be delayed.
            stream.thread_type = 'SLICE'

    @property
    def finds_gaps(self) -> bool:
        """Tell whether, where packets are left out, nothing is shown that would need them."""
        return self._video is not None

    def decode(self, packet: 'av.Packet[Any]', pts_ns: int | None, received_ns: int
               ) -> Iterator[Decoded]:
        """Yield what comes of a packet."""
        if self._video is not None:
            if packet.is_keyframe and not self._has_side_data:
                self._look_at(packet)
            # Without times of their own pictures that come in a burst would look like a gap.
            stamp = Stamp(pts_ns, None if pts_ns is None else received_ns)
            for one in self._filter.filter(packet) if self._filter else (packet,):
                yield from self._video.decode(bytes(one), pts_ns, stamp)
        elif self.codec == JPEG:
            try:
                yield pts_ns, JpegFile(whole_file(bytes(packet))[0])
            except ImageError as error:
                yield pts_ns, error
        elif self._passed is not None and not packet.is_keyframe:
            self._passed += 1
            yield pts_ns, ImageError(
                NO_KEY, f'it needs others before it; {self.codec} goes on with a key picture')
        else:
            if self._passed:
                self._say(f'{self.codec}: pictures passed over before a key picture: '
                          f'{self._passed}')
            self._passed = None
            yield from self._decode(packet, pts_ns)

    def flush(self) -> Iterator[Decoded]:
        """Yield what is left at the end."""
        if self._video is not None:
            yield from self._video.flush()
        elif self.codec != JPEG:
            yield from self._decode(None, None)

    def _look_at(self, packet: 'av.Packet[Any]') -> None:
        """Find out what comes with a key picture, by a decoder that knows the container."""
        context: Any = self._stream.codec_context
        with suppress(self._error):
            for picture in [*context.decode(packet), *context.decode(None)]:
                self._take_side_data(picture)

    def _take_side_data(self, picture: 'av.VideoFrame') -> None:
        if not self._has_side_data:
            self.side_data, self._has_side_data = side_data_of(picture), True

    def _decode(self, packet: 'av.Packet[Any] | None', pts_ns: int | None) -> Iterator[Decoded]:
        """Yield what FFmpeg's own decoder makes of a packet, or of the end."""
        context: Any = self._stream.codec_context
        try:
            pictures = context.decode(packet)
        except self._error as error:
            yield pts_ns, ImageError(DAMAGED, f'it cannot be decoded ({error.strerror})')
            return
        for picture in pictures:
            self._take_side_data(picture)
            shown_ns = pts_ns_of(picture)
            if picture.is_corrupt:
                yield shown_ns, ImageError(DAMAGED, 'the decoder found errors')
            else:
                yield shown_ns, VideoPicture(picture, tagged_colour(picture, context),
                                             self._stream.sample_aspect_ratio)


def sender_time(packet: 'av.Packet[Any]') -> bytes | None:
    """Return what RTCP says of a packet, the side data "producer reference time", if it does."""
    if not packet.has_sidedata('prft'):
        return None
    side_data: Any = packet.get_sidedata('prft')
    try:
        return bytes(side_data)
    except TypeError:
        # PyAV 16 does not give it away.
        return None


def pts_ns_of(item: 'av.Packet[Any] | av.VideoFrame') -> int | None:
    """Return the time of presentation by the stream in ns, None without."""
    if item.pts is None or not item.time_base:
        return None
    return round(item.pts * item.time_base * NS_PER_S)
