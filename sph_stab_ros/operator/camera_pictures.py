# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What the camera sends, as it goes to browsers: files of pictures, and its own video."""

from collections.abc import Callable
from typing import Any, TypeAlias

from sph_stab_ros.geometry.conventions import NS_PER_S, stamp_ns
from sph_stab_ros.images.codec import (
    encode_jpeg, image_from_message, ImageError, video_codec)
from sph_stab_ros.images.frame import Frame, PictureSource
from sph_stab_ros.images.message_decoder import MessageDecoder
from sph_stab_ros.images.picture_time import Stamp
from sph_stab_ros.images.video.bits import nal_units
from sph_stab_ros.images.video.h264 import IDR, PPS, SPS
from sph_stab_ros.operator.pairing import Packet, Picture
from sph_stab_ros.ros.worker import Worker

JPEG_QUALITY = 85
# Messages of video, each of which needs those before it: a second of them.
MOST_UNDECODED = 30
# Baseline, Main and High: 4:2:0 of eight bits, which browsers decode.
PROFILES = {66, 77, 100}
# The message and when it was received, and what came of it.
Outcome: TypeAlias = tuple[tuple[Any, float], PictureSource | ImageError]


class CameraPictures:
    """
    Makes Pictures of messages, in threads of its own; of files the newest counts, of video all do.

    Video is decoded even where nobody needs files: only a packet that a decoder has made a picture
    of, and at once, is one that a browser can show without what is missing.

    Parameters
    ----------
    take
        Takes each Picture.
    warn
        Logs a text, before which comes the kind of event.
    derotated
        Whether they are the virtual camera's.

    """

    def __init__(self, take: Callable[[Picture], object], warn: Callable[[str, str], object],
                 derotated: bool) -> None:
        self._take, self._warn, self._derotated = take, warn, derotated
        # Whether files are made of video.
        self.needs_files = True
        self._decoder: MessageDecoder[tuple[Any, float]] = MessageDecoder(
            lambda text: warn('key_picture', text), is_live=True)
        self._packets = Packets()
        self._stills = Worker('encoding', self._add_still)
        self._video = Worker('decoding', self._add_video, MOST_UNDECODED)
        self._stills.start()
        self._video.start()

    def put(self, msg: Any, received_s: float) -> None:
        """Take in a message of an image."""
        (self._video if video_codec(msg) else self._stills).put(msg, received_s)

    def close(self) -> None:
        """Let the pictures at hand be finished, and stop."""
        self._stills.close()
        self._video.close()

    # In the workers' threads.

    def _add_still(self, msg: Any, received_s: float) -> None:
        try:
            # Not numpy's: that would be a view of the message.
            data = bytes(msg.data) if hasattr(msg, 'format') else \
                encode_jpeg(image_from_message(msg), JPEG_QUALITY).tobytes()
        except ImageError as error:
            self._leave_out(error)
        else:
            self._take(Picture(stamp_ns(msg.header.stamp), data, received_s,
                               derotated=self._derotated))

    def _add_video(self, msg: Any, received_s: float) -> None:
        stamp = Stamp(stamp_ns(msg.header.stamp) or None, round(received_s * NS_PER_S))
        try:
            outcomes = list(self._decoder.decode(msg, (msg, received_s), stamp))
            packet = self._packets.add(msg) if is_shown_at_once(msg, outcomes) \
                else self._packets.end()
            for (shown, shown_s), source in outcomes:
                if isinstance(source, ImageError):
                    self._leave_out(source)
                    continue
                data = b''
                if self.needs_files or packet is None:
                    data = encode_jpeg(Frame(source, 0).image, JPEG_QUALITY).tobytes()
                self._take(Picture(stamp_ns(shown.header.stamp), data, shown_s,
                                   derotated=self._derotated, packet=packet))
        except ImageError as error:
            self._packets.end()
            self._leave_out(error)
        except Exception as error:
            # What a camera sends must not end the thread.
            self._packets.end()
            self._warn(type(error).__name__, f'image left out, {error!r}')

    def _leave_out(self, error: ImageError) -> None:
        self._warn(error.reason, f'image left out, {error}')


def is_shown_at_once(msg: Any, outcomes: list[Outcome]) -> bool:
    """Tell whether a picture came of its own message, as where their order is that of time."""
    return len(outcomes) == 1 and outcomes[0][0][0] is msg and not isinstance(
        outcomes[0][1], ImageError)


class Packets:
    """
    Tells which parts of a stream of H.264 (Annex B) browsers can take as they are.

    These begin with a key picture that has its parameters with it, of a profile of PROFILES, and
    end where one is missing.
    """

    def __init__(self) -> None:
        self._number = 0
        self._codec = ''

    def end(self) -> Packet | None:
        """Note that a picture is missing, or is not for browsers, and return None."""
        self._codec = ''
        self._number += 1
        return None

    def add(self, msg: Any) -> Packet | None:
        """Return the packet of the next picture, None where browsers cannot take it."""
        if video_codec(msg) != 'h264':
            return self.end()
        data = bytes(msg.data)
        units = {unit[0] & 31: unit for unit in nal_units(data)}
        is_key = IDR in units
        if is_key:
            sps = units.get(SPS, b'')
            fits = PPS in units and len(sps) > 3 and sps[1] in PROFILES
            self._codec = f'avc1.{sps[1:4].hex()}' if fits else ''
        self._number += 1
        if not self._codec:
            return None
        return Packet(self._number, data, 'key' if is_key else 'delta', self._codec)
