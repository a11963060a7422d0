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
from itertools import islice
import logging
from pathlib import Path
from typing import Any, NamedTuple

from sph_stab_ros.config import NOT_JOINED
from sph_stab_ros.images.codec import ImageError, stamp_and_frame
from sph_stab_ros.images.frame import Frame, PictureSource
from sph_stab_ros.images.image_error import DecoderMissing
from sph_stab_ros.images.message_decoder import MessageDecoder
from sph_stab_ros.images.picture_clock import PictureClock
from sph_stab_ros.images.picture_time import Stamp
from sph_stab_ros.images.video.decoder import NO_KEY
from sph_stab_ros.images.video.picture import VideoPicture
from sph_stab_ros.recording.base import RecordingError, SkipLog, Stretch
from sph_stab_ros.recording.containers import Channel, Containers
from sph_stab_ros.recording.containers.limits import Damage
from sph_stab_ros.recording.joined import joined
from sph_stab_ros.recording.message_types import decoded, IMAGE_TYPES, is_known
from sph_stab_ros.recording.picture_times import first_stamp, peeked, with_times, within

logger = logging.getLogger(__name__)

# No robot's bag has more topics than fit a line that somebody reads.
MOST_LISTED = 100
# Drivers that stamp with zero until they have the time have it by then.
MAX_UNSTAMPED = 300


class Taken(NamedTuple):
    """When a picture was taken, and by which camera."""

    stamp: Stamp
    frame_id: str


class BagRecording:
    """
    A bag of either generation of ROS: a file, or a folder with its parts.

    Messages are decoded by ROS's own definitions of the standard types, so that neither a bag
    without definitions nor one with unusual messages beside the images is an obstacle. Of a bag
    that was cut short or damaged all that is whole is read. The pictures of two topics, with a
    comma between, are joined as ``join`` says.
    """

    def __init__(self, path: Path, image_topic: str | None = None, stretch: Stretch = Stretch(),
                 join: str = NOT_JOINED) -> None:
        self.path = path
        self._stretch, self._join = stretch, join
        self.name = path.name
        self._containers = Containers(path)
        counts: Counter[str] = Counter()
        self.topics: dict[str, str] = {}
        # Of a topic of several types it is that of images; a definition may be damaged, too.
        for channel in sorted(self._containers.channels, key=lambda one: (
                one.msgtype in IMAGE_TYPES, is_known(one.msgtype, one.encoding))):
            self.topics[channel.topic] = channel.msgtype
            counts[channel.topic] += self._containers.channels[channel]
        if not self.topics:
            raise RecordingError(f'{path} is not a readable bag: it holds no messages; damaged, '
                                 'encrypted or something else')
        self._images = self._choose_image_topics(image_topic, counts)
        self.image_topic: str | None = self._images[0]
        self.frame_count: int | None = counts[self._images[0]]
        self._skip_log = SkipLog(self.name)

    @property
    def skipped(self) -> Counter[str]:
        """Count the pictures left out so far, by reason."""
        return self._skip_log.counts

    @property
    def telemetry(self) -> None:
        """Return nothing: what was measured is in messages."""

    def frames(self) -> Generator[Frame, None, None]:
        """Yield the Frames of the image topic; header stamps, or times of receipt without any."""
        self._skip_log = SkipLog(self.name)
        if self._join == NOT_JOINED:
            yield from self._frames(*self._images)
        else:
            first, second = map(self._frames, self._images)
            yield from joined(first, second, self._join, self._skip_log)

    def _frames(self, topic: str) -> Iterator[Frame]:
        first, pictures = peeked(self._pictures(topic))
        known = first_stamp([first[0]]) if first else None
        if first and known is None:
            # Only here, as it takes to read the beginning twice.
            known = first_stamp(
                taken.stamp for taken, _ in islice(self._taken(topic), MAX_UNSTAMPED))
        timed = with_times(self.name, pictures, PictureClock(first=known))
        for times, (frame_id, source) in within(self.name, timed, self._stretch):
            colour = source.colour if isinstance(source, VideoPicture) else None
            yield Frame(source, times.stamp_ns, frame_id, times, colour=colour)

    def _taken(self, topic: str) -> Iterator[tuple[Taken, Any]]:
        """Yield the messages of an image topic, and when they were taken."""
        for received_ns, msg in self.messages(topic):
            stamp_ns, frame_id = stamp_and_frame(msg)
            yield Taken(Stamp(stamp_ns or None, received_ns), frame_id), msg

    def _pictures(self, topic: str) -> Iterator[tuple[Stamp, tuple[str, PictureSource]]]:
        """Yield the pictures of an image topic in the order of presentation."""
        decoder: MessageDecoder[Taken] = MessageDecoder(
            lambda text: logger.warning('%s: %s', self.name, text))

        def outcomes() -> Iterator[tuple[Taken, PictureSource | ImageError]]:
            for taken, msg in self._taken(topic):
                yield from decoder.decode(msg, taken, taken.stamp)
            yield from decoder.flush()
        try:
            for taken, outcome in outcomes():
                if isinstance(outcome, ImageError):
                    # The decoder tells how many there were of these.
                    self._skip_log.add(
                        outcome.reason, outcome, is_told=outcome.reason == NO_KEY)
                else:
                    yield taken.stamp, (taken.frame_id, outcome)
        except DecoderMissing as error:
            raise RecordingError(f'{self.path}: {error}') from None

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
            if channel.topic == topic and not is_known(msgtype, channel.encoding):
                raise RecordingError(f'{topic} in {self.path} is of type {msgtype} (encoded as '
                                     f'{channel.encoding}), which is not a standard one')
        count = 0
        damage = Damage()
        for message in self._containers.messages(topic, damage):
            yield message
            count += 1
        if damage:
            logger.debug('%s: %s', self.name, '; '.join(damage))
            logger.warning('%s is truncated or damaged: %d messages of %s were read',
                           self.name, count, topic)

    def _choose_image_topics(self, wanted: str | None, counts: Counter[str]) -> list[str]:
        """Return the topic to read images from, or both; RecordingError if that is not clear."""
        if self._join == NOT_JOINED:
            return [self._choose_image_topic(wanted, counts)]
        topics = (wanted or '').split(',')
        if len(topics) != 2:
            raise RecordingError(
                f'{self.path}: join puts the pictures of two topics together, name them with '
                f'--image-topic A,B; it has {self._listed()}')
        return [self._choose_image_topic(topic, counts) for topic in topics]

    def _choose_image_topic(self, wanted: str | None, counts: Counter[str]) -> str:
        """Return a topic to read images from, RecordingError if that is not clear."""
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
        listed = [f'{topic} ({msgtype})' for topic, msgtype in sorted(self.topics.items())]
        more = len(listed) - MOST_LISTED
        return ', '.join(listed[:MOST_LISTED] + [f'{more} more'] * (more > 0)) or 'no topics'
