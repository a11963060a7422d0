# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Pictures out of the messages of one topic, of whatever types and formats."""

from collections.abc import Callable, Iterator
from typing import Any, Generic, TypeVar

from sph_stab_ros.images.codec import ImageError, video_codec
from sph_stab_ros.images.frame import PictureSource, source_from_message
from sph_stab_ros.images.picture_time import Stamp
from sph_stab_ros.images.video.decoder import VideoDecoder

Item = TypeVar('Item')


class MessageDecoder(Generic[Item]):
    """
    Decodes the messages of one topic, one after the other.

    An item stands for each message and comes back with what is in it, in the order of
    presentation, or with the ImageError that says why there is nothing.

    Parameters
    ----------
    say
        Told in one line of what users should hear of.
    is_live
        Whether pictures are not to wait, see VideoDecoder.

    """

    def __init__(self, say: Callable[[str], Any], is_live: bool = False) -> None:
        self._say, self._is_live = say, is_live
        self._codec: str | None = None
        self._video: VideoDecoder[Item] | None = None

    def decode(self, msg: Any, item: Item, stamp: Stamp
               ) -> Iterator[tuple[Item, PictureSource | ImageError]]:
        """Yield what comes of a message, and of those before that had to wait for it."""
        codec = video_codec(msg)
        if codec is None:
            try:
                yield item, source_from_message(msg)
            except ImageError as error:
                yield item, error
            return
        if self._video is None or codec != self._codec:
            yield from self.flush()
            self._codec, self._video = codec, VideoDecoder(
                codec, self._say, self._is_live)
        yield from self._video.decode(bytes(msg.data), item, stamp)

    def flush(self) -> Iterator[tuple[Item, PictureSource | ImageError]]:
        """Yield what is left at the end."""
        if self._video is not None:
            yield from self._video.flush()
