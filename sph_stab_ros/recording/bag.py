# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Images and other messages out of rosbag2 and ROS 1 bags."""

from collections import Counter
from collections.abc import Callable, Generator, Iterator, Sequence
import logging
from pathlib import Path
from typing import Any

from rosbags import rosbag1, rosbag2
from rosbags.typesys import get_typestore, Stores

from sph_stab_ros.geometry.conventions import NS_PER_S
from sph_stab_ros.images.codec import ImageError
from sph_stab_ros.images.frame import Frame, frame_from_message
from sph_stab_ros.recording.base import RecordingError, SkipLog
from sph_stab_ros.recording.salvage import SalvagedBag

logger = logging.getLogger(__name__)

IMAGE_TYPES = ('sensor_msgs/msg/Image', 'sensor_msgs/msg/CompressedImage')


class BagRecording:
    """
    A rosbag2 folder, a bare ``.mcap`` or ``.db3`` file, or a ROS 1 ``.bag``.

    Messages are decoded by ROS's own definitions of the standard types, so that neither a bag
    without definitions nor one with unusual messages beside the images is an obstacle. A bag
    that was cut short is read as far as it goes.
    """

    def __init__(self, path: Path, image_topic: str | None = None) -> None:
        self.path = path
        self.name = path.name
        library, store, decode = ((rosbag1, Stores.ROS1_NOETIC, 'deserialize_ros1')
                                  if path.suffix == '.bag' else
                                  (rosbag2, Stores.ROS2_JAZZY, 'deserialize_cdr'))
        self._types = get_typestore(store)
        self._decode = getattr(self._types, decode)
        # A reader of rosbags, or what stands in for one.
        self._open: Callable[[], Any] = lambda: library.Reader(path)
        try:
            connections = self._connections()
        # The readers promise no particular exception for damaged files.
        except Exception as error:
            connections = self._salvaged_connections(error)
        self.topics: dict[str, str] = {c.topic: c.msgtype for c in connections}
        counts: Counter[str] = Counter()
        for connection in connections:
            counts[connection.topic] += connection.msgcount
        self._images = self._choose_image_topic(image_topic, counts)
        self.image_topic: str | None = self._images
        self.frame_count: int | None = counts[self._images]
        self._skip_log = SkipLog(self.name)

    @property
    def skipped(self) -> Counter[str]:
        """Count the pictures left out so far, by reason."""
        return self._skip_log.counts

    def frames(self) -> Generator[Frame, None, None]:
        """Yield the Frames of the image topic; header stamps, or times of receipt where zero."""
        self._skip_log = SkipLog(self.name)
        said_zero = False
        for received_ns, msg in self.messages(self._images):
            stamp_ns = msg.header.stamp.sec * NS_PER_S + msg.header.stamp.nanosec
            if stamp_ns == 0:
                stamp_ns = received_ns
                if not said_zero:
                    logger.warning('%s: header stamps are zero, times of receipt are used',
                                   self.name)
                said_zero = True
            try:
                frame = frame_from_message(msg, stamp_ns, msg.header.frame_id)
            except ImageError as error:
                self._skip_log.add(error.reason, error)
            else:
                yield frame

    def messages(self, topic: str) -> Iterator[tuple[int, Any]]:
        """Yield (time of receipt in ns, message) of a topic; messages of rosbags' types."""
        if topic not in self.topics:
            raise RecordingError(f'{self.path} has no topic {topic}; it has {self._listed()}')
        msgtype = self.topics[topic]
        if msgtype not in self._types.types:
            raise RecordingError(f'{topic} in {self.path} is of type {msgtype}, '
                                 'which is not a standard one')
        with self._open() as reader:
            connections = [c for c in reader.connections if c.topic == topic]
            for received_ns, data in self._whole_part(reader, connections):
                try:
                    msg = self._decode(data, msgtype)
                # A damaged message makes the decoder fail in many ways.
                except Exception as error:
                    self._skip_log.add('unreadable message', f'unreadable message: {error}')
                    continue
                yield received_ns, msg

    def _whole_part(
            self, reader: Any, connections: Sequence[Any]) -> Iterator[tuple[int, bytes]]:
        """Yield (time of receipt, data) as far as the file is whole, then warn if it was not."""
        count = 0
        try:
            for _, received_ns, data in reader.messages(connections=connections):
                yield received_ns, data
                count += 1
            broken = getattr(reader, 'truncated', False)
        except Exception as error:
            logger.debug('%s: %r', self.name, error)
            broken = True
        if broken:
            logger.warning('%s is truncated or damaged: %d messages of %s were read',
                           self.name, count, connections[0].topic)

    def _connections(self) -> Sequence[Any]:
        with self._open() as reader:
            return list(reader.connections)

    def _salvaged_connections(self, error: Exception) -> Sequence[Any]:
        """Read without an index from now on, as opening the bag ended in ``error``."""
        try:
            salvaged = SalvagedBag(self.path)
        except OSError as unreadable:
            raise RecordingError(f'{self.path} cannot be read: {unreadable.strerror}') from None
        if not salvaged.connections:
            reason = ' '.join(str(error).split())
            raise RecordingError(f'{self.path} is not a readable bag: {reason}') from None
        self._open = lambda: salvaged
        return salvaged.connections

    def _choose_image_topic(self, wanted: str | None, counts: Counter[str]) -> str:
        """Return the topic to read images from, RecordingError if that is not clear."""
        candidates = [topic for topic, msgtype in self.topics.items() if msgtype in IMAGE_TYPES]
        if wanted is not None:
            if wanted not in candidates:
                raise RecordingError(
                    f'{self.path} has no image topic {wanted}; it has {self._listed()}')
            return wanted
        candidates = [topic for topic in candidates if counts[topic]] or candidates
        if not candidates:
            raise RecordingError(f'{self.path} has no images; it has {self._listed()}')
        if len(candidates) > 1:
            raise RecordingError(f'{self.path} has several image topics, choose one with '
                                 f'--image-topic: {", ".join(sorted(candidates))}')
        return candidates[0]

    def _listed(self) -> str:
        """Return the topics and their types in a line."""
        return ', '.join(f'{topic} ({msgtype})' for topic, msgtype in sorted(self.topics.items())
                         ) or 'no topics'
