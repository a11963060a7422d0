# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The images on their way to the stabiliser: from the messages of any transport to pictures."""

from collections.abc import Callable
from time import monotonic
from typing import Any, NamedTuple

from rclpy.node import Node
from sph_stab_ros.config import NodeConfig, NOT_JOINED
from sph_stab_ros.geometry.conventions import NS_PER_S
from sph_stab_ros.geometry.layout import Layout
from sph_stab_ros.images.codec import ImageError, stamp_and_frame, video_codec
from sph_stab_ros.images.frame import Frame, PictureSource, source_from_message
from sph_stab_ros.images.joined import JoinedPicture
from sph_stab_ros.images.jpeg_file import JpegFile
from sph_stab_ros.images.message_decoder import MessageDecoder
from sph_stab_ros.images.picture_time import PictureTime, Stamp
from sph_stab_ros.images.video.picture import VideoPicture
from sph_stab_ros.ros.diagnostics import Diagnostics
from sph_stab_ros.ros.silence import SilenceWatch
from sph_stab_ros.ros.topics import subscribe_to_images
from sph_stab_ros.ros.worker import Worker

# Messages of video, each of which needs those before it: a second of them.
MOST_UNDECODED = 30


class ReceivedImage(NamedTuple):
    """
    A message that holds a picture, or the picture of a source or a decoder.

    ``other`` is another lens', and ``join`` says how to put the two together; ``layout`` and
    ``refusal`` are the Frame's.
    """

    content: Any
    stamp_ns: int
    frame_id: str
    received_s: float
    other: Any = None
    join: str = NOT_JOINED
    layout: Layout | None = None
    refusal: ImageError | None = None

    def frame(self, times: PictureTime) -> Frame:
        """Return the Frame of it, whose times these are; ImageError where there is no picture."""
        source = _source_of(self.content)
        if self.join != NOT_JOINED:
            source = JoinedPicture(source, _source_of(self.other), self.join)
        return Frame(source, times.stamp_ns, self.frame_id, times, self.layout,
                     refusal=self.refusal)


def _source_of(content: Any) -> PictureSource:
    is_picture = isinstance(content, (VideoPicture, JpegFile, JoinedPicture))
    return content if is_picture else source_from_message(content)


class ImageInput:
    """
    Subscribes to ``image``, or another topic, by a transport, and says why nothing comes.

    Messages of compressed video are all decoded, in a thread that does nothing else.

    Parameters
    ----------
    node : rclpy.node.Node
    config : NodeConfig
        Names the transport; ConfigError where its messages are not installed.
    take : callable
        Takes each ReceivedImage, in the order of presentation.
    diagnostics : Diagnostics
        Told of what cannot be used.

    """

    def __init__(self, node: Node, config: NodeConfig, take: Callable[[ReceivedImage], None],
                 diagnostics: Diagnostics, topic: str = 'image') -> None:
        transport = config.image_transport
        self._node = node
        self._take = take
        self._diagnostics = diagnostics
        self._decoder: MessageDecoder[ReceivedImage] = MessageDecoder(
            lambda text: diagnostics.event('key_picture', text), is_live=True)
        self._decoding = Worker('decoding', self._decode, MOST_UNDECODED)
        images = subscribe_to_images(node, topic, transport, self._on_image)
        self.name: str = images.topic_name
        self._silence = SilenceWatch(node, images, transport)

    @property
    def dropped(self) -> int:
        """Return how many messages of video were not decoded, since others came too soon."""
        return self._decoding.dropped

    def why_silent(self) -> str:
        """Return why there have been no images for a while, '' where there have been some."""
        return self._silence.reason()

    def state(self) -> dict[str, Any]:
        """Return nothing: who publishes the images has diagnostics of its own."""
        return {}

    def start(self) -> None:
        """Start to decode."""
        self._decoding.start()

    def close(self) -> None:
        """Let the decoder finish its picture, and stop."""
        self._decoding.close()

    # In the executor's thread.

    def _on_image(self, msg: Any) -> None:
        self._silence.end()
        stamp_ns, frame_id = stamp_and_frame(msg)
        if stamp_ns == 0:
            self._node.get_logger().warning(
                'image stamps are zero, times of receipt are used', once=True)
            stamp_ns = self._node.get_clock().now().nanoseconds
            if stamp_ns == 0:
                self._diagnostics.refuse('no time', 'neither it nor /clock tells a time yet')
                return
        image = ReceivedImage(msg, stamp_ns, frame_id, monotonic())
        if video_codec(msg):
            self._decoding.put(image)
        else:
            self._take(image)

    # In the worker's thread.

    def _decode(self, image: ReceivedImage) -> None:
        """Decode a message of video: one that cannot be must not end the node."""
        stamp = Stamp(image.stamp_ns, round(image.received_s * NS_PER_S))
        try:
            with self._diagnostics.cpu.stage('decode'):
                outcomes = list(self._decoder.decode(image.content, image, stamp))
        except ImageError as error:
            self._diagnostics.refuse(error.reason, error)
        except Exception as error:
            self._diagnostics.refuse(type(error).__name__, f'{error!r}')
        else:
            for one, outcome in outcomes:
                if isinstance(outcome, ImageError):
                    self._diagnostics.refuse(outcome.reason, outcome)
                else:
                    self._take(one._replace(content=outcome))
