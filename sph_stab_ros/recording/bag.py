# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Images and other messages out of rosbag2 and ROS 1 bags."""

from collections import Counter
from collections.abc import Generator, Iterator
from functools import cache
from itertools import islice
import logging
from pathlib import Path
import sys
from typing import Any

from rosbags.typesys import get_typestore, Stores

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd

from sph_stab_ros.geometry.conventions import NS_PER_S
from sph_stab_ros.images.codec import ImageError
from sph_stab_ros.images.frame import Frame, frame_from_message
from sph_stab_ros.images.picture_time import Stamp
from sph_stab_ros.images.times import PictureClock
from sph_stab_ros.recording.base import RecordingError, SkipLog, Stretch
from sph_stab_ros.recording.containers import Channel, Containers
from sph_stab_ros.recording.containers.kinds import ZSTD
from sph_stab_ros.recording.picture_times import first_stamp, peeked, with_times, within

logger = logging.getLogger(__name__)

IMAGE_TYPES = ('sensor_msgs/msg/Image', 'sensor_msgs/msg/CompressedImage')
# How the messages in a channel are encoded: the definitions of types, and what decodes by them.
ENCODINGS = {'cdr': (Stores.ROS2_JAZZY, 'deserialize_cdr'),
             'ros1': (Stores.ROS1_NOETIC, 'deserialize_ros1')}
types_of = cache(get_typestore)
# Drivers that stamp with zero until they have the time have it by then.
MAX_UNSTAMPED = 300


class BagRecording:
    """
    A bag of either generation of ROS: a file, or a folder with its parts.

    Messages are decoded by ROS's own definitions of the standard types, so that neither a bag
    without definitions nor one with unusual messages beside the images is an obstacle. Of a bag
    that was cut short or damaged all that is whole is read.
    """

    def __init__(self, path: Path, image_topic: str | None = None, stretch: Stretch = Stretch()
                 ) -> None:
        self.path = path
        self._stretch = stretch
        self.name = path.name
        self._containers = Containers(path)
        counts: Counter[str] = Counter()
        self.topics: dict[str, str] = {}
        for channel, count in self._containers.channels.items():
            # A damaged definition may contradict a whole one.
            if channel.topic not in self.topics or is_standard(channel.msgtype, channel.encoding):
                self.topics[channel.topic] = channel.msgtype
            counts[channel.topic] += count
        if not self.topics:
            raise RecordingError(f'{path} is not a readable bag: it holds no messages; damaged, '
                                 'encrypted or something else')
        self._images = self._choose_image_topic(image_topic, counts)
        self.image_topic: str | None = self._images
        self.frame_count: int | None = counts[self._images]
        self._skip_log = SkipLog(self.name)

    @property
    def skipped(self) -> Counter[str]:
        """Count the pictures left out so far, by reason."""
        return self._skip_log.counts

    def frames(self) -> Generator[Frame, None, None]:
        """Yield the Frames of the image topic; header stamps, or times of receipt without any."""
        self._skip_log = SkipLog(self.name)
        first, stamped = peeked(self._stamped())
        known = first_stamp([first[0]]) if first else None
        if first and known is None:
            # Only here, as it takes to read the beginning twice.
            known = first_stamp(stamp for stamp, _ in islice(self._stamped(), MAX_UNSTAMPED))
        timed = with_times(self.name, stamped, PictureClock(first=known))
        for times, msg in within(self.name, timed, self._stretch):
            try:
                frame = frame_from_message(msg, times.stamp_ns, msg.header.frame_id, times)
            except ImageError as error:
                self._skip_log.add(error.reason, error)
            else:
                yield frame

    def _stamped(self) -> Iterator[tuple[Stamp, Any]]:
        """Yield the messages of the image topic with their stamps."""
        for received_ns, msg in self.messages(self._images):
            stamp_ns = msg.header.stamp.sec * NS_PER_S + msg.header.stamp.nanosec
            yield Stamp(stamp_ns or None, received_ns), msg

    def messages(self, topic: str) -> Iterator[tuple[int, Any]]:
        """Yield (time of receipt in ns, message) of a topic; messages of rosbags' types."""
        if topic not in self.topics:
            raise RecordingError(f'{self.path} has no topic {topic}; it has {self._listed()}')
        for channel, received_ns, data in self._whole_part(topic):
            try:
                msg = decoded(data, self.topics[topic], channel.encoding)
            # A damaged message makes the decoder fail in many ways.
            except Exception as error:
                self._skip_log.add('unreadable message', f'unreadable message: {error}')
                continue
            yield received_ns, msg

    def _whole_part(self, topic: str) -> Iterator[tuple[Channel, int, bytes]]:
        """Yield what is whole of a topic's messages, then warn if that was not all."""
        msgtype = self.topics[topic]
        for channel in self._containers.channels:
            if channel.topic == topic and not is_standard(msgtype, channel.encoding):
                raise RecordingError(f'{topic} in {self.path} is of type {msgtype} (encoded as '
                                     f'{channel.encoding}), which is not a standard one')
        count = 0
        damage: list[str] = []
        for message in self._containers.messages(topic, damage):
            yield message
            count += 1
        if damage:
            logger.debug('%s: %s', self.name, '; '.join(damage))
            logger.warning('%s is truncated or damaged: %d messages of %s were read',
                           self.name, count, topic)

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


def is_standard(msgtype: str, encoding: str) -> bool:
    """Tell whether ROS's own definitions are enough to decode messages of this type."""
    return encoding in ENCODINGS and msgtype in types_of(ENCODINGS[encoding][0]).types


def decoded(data: bytes, msgtype: str, encoding: str) -> Any:
    """Return a message, which may be compressed by itself."""
    store, decode = ENCODINGS[encoding]
    # The encapsulation that CDR data begin with is never this.
    if encoding == 'cdr' and data.startswith(ZSTD):
        data = zstd.decompress(data)
    return getattr(types_of(store), decode)(data, msgtype)
