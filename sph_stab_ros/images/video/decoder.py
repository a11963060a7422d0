# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""
Pictures out of messages of video, never one that is made of missing or damaged ones.

Decoding begins with a key picture. Where one is missing or damaged all pictures up to the next
key picture are given up, since they may show what is left of it: a gap is found by the numbers of
the pictures and by their times, damage by the decoder. Not all damage is found: arithmetic coding
makes something of any bits, in H.265 without exception.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from typing import Any, Generic, NamedTuple, TYPE_CHECKING, TypeAlias, TypeVar

from sph_stab_ros.images.image_error import DecoderMissing, ImageError
from sph_stab_ros.images.picture_time import Stamp
from sph_stab_ros.images.video.av1 import Av1
from sph_stab_ros.images.video.bits import Stream, Unit, Unreadable
from sph_stab_ros.images.video.gap_clock import GapClock
from sph_stab_ros.images.video.h264 import H264
from sph_stab_ros.images.video.h265 import H265
from sph_stab_ros.images.video.picture import tagged_colour, VideoPicture

if TYPE_CHECKING:
    import av

INSTALL = "needs PyAV: pip install 'av>=16,<19'"
NO_KEY, MISSING, DAMAGED, NOT_SHOWN = (
    'no key picture', 'missing picture', 'damaged picture', 'picture not shown')
# More are not decoded between a picture and when it is shown: 16, and some more.
MOST_BETWEEN = 20
# Parameters of no picture, in bytes.
MOST_AHEAD = 2**16

Item = TypeVar('Item')
# What came of the message that an item stands for.
Outcome: TypeAlias = tuple[Item, 'VideoPicture | ImageError']


class Codec(NamedTuple):
    """
    How something is decoded.

    ``threads`` is how many work on a picture, 0 as many as there are cores; several pictures at a
    time would be delayed. A lenient decoder decodes anything: pictures before a key picture, which
    it does not show, and damaged ones, of which it tells when these are shown.
    """

    name: str
    decoder: str
    stream: Callable[[], Stream]
    threads: int = 0
    options: Mapping[str, str] = {}
    is_lenient: bool = False


CODECS = {
    # By several threads it would not notice errors; were it strict, it would not begin with open
    # groups of pictures.
    'h264': Codec('H.264', 'h264', H264, threads=1, is_lenient=True),
    # Else it leaves out without a word what needs a missing picture.
    'h265': Codec('H.265', 'hevc', H265, options={'err_detect': 'explode'}),
    'av1': Codec('AV1', 'libdav1d', Av1, options={'max_frame_delay': '1'})}


class VideoDecoder(Generic[Item]):
    """
    Decodes the messages of one stream, in their order.

    An item stands for each message and comes back with its picture, in the order of presentation,
    or with the ImageError that says why there is none.

    Parameters
    ----------
    codec
        One of the keys of CODECS; DecoderMissing where it cannot be decoded here.
    say
        Told in one line of what users should hear of.
    is_live
        Whether pictures are given as soon as they can be shown. Else they wait until it is known
        that those which they are made of are whole, which a lenient decoder tells later.

    """

    def __init__(self, codec: str, say: Callable[[str], Any], is_live: bool = False) -> None:
        self._codec = CODECS[codec]
        self._say = say
        self._waits = self._codec.is_lenient and not is_live
        self._av, self._context = opened(self._codec)
        self._stream = self._codec.stream()
        self._clock = GapClock()
        # Pictures passed over since there was none to begin with; None while decoding.
        self._passed: int | None = 0
        self._is_primed = False
        # By the number in the order of decoding what has no outcome yet, and the pictures of it
        # that there are, in the order of presentation.
        self._waiting: dict[int, Item] = {}
        self._pictures: dict[int, VideoPicture] = {}
        self._number = 0
        # Parameters that came by themselves.
        self._ahead = b''

    def decode(self, data: bytes, item: Item, stamp: Stamp) -> Iterator[Outcome[Item]]:
        """Yield what comes of the next message, and of those before that had to wait for it."""
        try:
            unit = self._stream.look(data)
        except Unreadable as error:
            yield from self._give_up()
            yield from self._pass(item, DAMAGED, str(error))
            return
        if unit.has_parameters:
            # Those of a picture are its own; no more than what comes between two pictures.
            self._ahead = b'' if unit.has_picture else (self._ahead + unit.data)[-MOST_AHEAD:]
        if not unit.has_picture:
            return
        reason, detail = NO_KEY, 'it needs others before it'
        is_gap = not unit.follows or self._clock.is_gap(stamp, self._stream.wrap)
        if is_gap and self._passed is None:
            yield from self._give_up()
            reason, detail = MISSING, 'one or more before it are missing'
        elif unit.is_closed and self._waits:
            # Before it is known whether those before are whole, others would be mixed with them.
            yield from self._give_up()
        if self._passed is not None:
            is_key = unit.is_key and (self._is_primed or not unit.needs_any)
            if not is_key or not self._stream.is_configured:
                self._prime(unit.data)
                if is_key:
                    detail = 'key pictures come without their parameters'
                yield from self._pass(item, reason, detail)
                return
            self._begin(unit)
        self._clock.add(stamp, unit.is_key)
        yield from self._decoded(unit.data, item)

    def _begin(self, unit: Unit) -> None:
        """Say what was passed over, and decode from this key picture on."""
        if self._passed:
            self._clock.restart()
            self._say(f'{self._codec.name}: pictures passed over before a key picture: '
                      f'{self._passed}')
            if not unit.needs_any:
                # What is left of slices that were missing shows in the next picture.
                self._prime(unit.data)
                self._flush()
        self._passed = None

    def flush(self) -> Iterator[Outcome[Item]]:
        """Yield what is left at the end of the stream."""
        passed = self._passed
        yield from self._give_up()
        if passed:
            self._say(f'{self._codec.name}: pictures passed over, without a key picture to the '
                      f'end: {passed}')

    def _decoded(self, data: bytes, item: Item) -> Iterator[Outcome[Item]]:
        packet = self._packet(data)
        self._number += 1
        packet.pts = self._number
        self._waiting[self._number] = item
        try:
            yield from self._shown(self._context.decode(packet))
        except self._av.FFmpegError as error:
            self._waiting.pop(self._number, None)
            yield from self._give_up()
            yield from self._pass(item, DAMAGED, f'it cannot be decoded ({error.strerror})')

    def _prime(self, data: bytes) -> None:
        """Let the decoder have a picture that will not be shown, where that helps."""
        if self._codec.is_lenient:
            with suppress(self._av.FFmpegError):
                self._context.decode(self._packet(data))
                self._is_primed = True

    def _packet(self, data: bytes) -> 'av.Packet[Any]':
        """Return what the decoder is given next, the parameters that came before included."""
        data, self._ahead = self._ahead + data, b''
        return self._av.Packet(data)

    def _shown(self, frames: Iterable['av.VideoFrame']) -> Iterator[Outcome[Item]]:
        """Yield the pictures that a decoder gave; begin anew where one is damaged."""
        for frame in frames:
            if frame.pts not in self._waiting:
                continue
            if frame.is_corrupt:
                # Others may be made of it.
                for number in sorted(self._waiting):
                    yield from self._pass(
                        self._waiting.pop(number), DAMAGED, 'the decoder found errors')
                self._pictures.clear()
                self._flush()
                return
            self._pictures[frame.pts] = VideoPicture(
                frame, tagged_colour(frame, self._context))
        yield from self._proved()

    def _proved(self, at_end: bool = False) -> Iterator[Outcome[Item]]:
        """Yield what need not wait any more."""
        oldest = self._number + 1 if at_end else self._number - MOST_BETWEEN
        for number in sorted(self._waiting.keys() - self._pictures.keys()):
            if number < oldest:
                yield self._waiting.pop(number), ImageError(
                    NOT_SHOWN, f'the decoder of {self._codec.name} leaves it out')
        missing = self._waiting.keys() - self._pictures.keys()
        for number in list(self._pictures):
            if self._waits and min(missing, default=number) < number:
                break
            yield self._waiting.pop(number), self._pictures.pop(number)

    def _give_up(self) -> Iterator[Outcome[Item]]:
        """Yield the pictures that can still be shown, and wait for a key picture."""
        if self._passed is not None:
            return
        try:
            frames = self._context.decode(None)
        except self._av.FFmpegError:
            frames = []
        yield from self._shown(frames)
        yield from self._proved(at_end=True)
        self._flush()
        self._passed = self._passed or 0

    def _flush(self) -> None:
        self._context.flush_buffers()
        self._is_primed = False

    def _pass(self, item: Item, reason: str, detail: str) -> Iterator[Outcome[Item]]:
        """Yield that there is no picture, and count it."""
        self._passed = (self._passed or 0) + 1
        yield item, ImageError(reason, f'{detail}; {self._codec.name} goes on with a key picture')


def opened(codec: Codec) -> tuple[Any, 'av.VideoCodecContext']:
    """Return PyAV and a decoder of it; DecoderMissing without."""
    try:
        import av
    except ImportError:
        raise DecoderMissing(codec.name, INSTALL) from None
    try:
        context: Any = av.CodecContext.create(codec.decoder, 'r')
    except (av.FFmpegError, ValueError) as error:
        raise DecoderMissing(codec.name, f'needs a PyAV with {codec.decoder} ({error})') from None
    context.thread_type, context.thread_count = 'SLICE', codec.threads
    context.options = dict(codec.options)
    return av, context
