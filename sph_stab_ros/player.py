# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""
Publish a recording on ROS topics, in its own time or faster.

Images go out on ``image``, or ``image/compressed`` if they are compressed in the recording;
remap them with ``--ros-args -r image:=/camera/image``. Video is decoded where its messages are of
a package that is not installed. Ends with status 0 on SIGINT and SIGTERM.
"""

# Before all that takes time to import.
if __name__ == '__main__':
    from sph_stab_ros.executable import start
    raise SystemExit(start('player'))

from argparse import Namespace
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from heapq import merge
from pathlib import Path
import sys
import time
from typing import Any, TypeAlias

import rclpy
from rclpy.duration import Duration
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation as rclpy_binding
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile
from rclpy.time import Time

from sensor_msgs.msg import CompressedImage, Image

from sph_stab_ros.command_line import one_line, Parser
from sph_stab_ros.command_line.parameters import (
    add_parameters, add_shorthands, given_parameters, SetParameters, settings_from)
from sph_stab_ros.command_line.process_setup import bounded_ending
from sph_stab_ros.config import AUTO, EQUIRECT, NodeConfig, NOT_JOINED, Settings
from sph_stab_ros.geometry.conventions import NS_PER_S, stamp_ns
from sph_stab_ros.geometry.projection_factory import ProjectionError
from sph_stab_ros.images.appearance_watch import PictureWatch
from sph_stab_ros.images.codec import fill_compressed, fill_image
from sph_stab_ros.images.picture_time import duration
from sph_stab_ros.images.sphere import stitched
from sph_stab_ros.recording import open_recording, Recording, RecordingError
from sph_stab_ros.recording.messages import COMPRESSED_IMAGE, IMAGE
from sph_stab_ros.recording.picture_times import HeaderClock, PlayingTime
from sph_stab_ros.ros import messages as ros_messages
from sph_stab_ros.ros.starting import start_ros
from sph_stab_ros.ros.topics import TRANSPORTS

RCLError = rclpy_binding.RCLError
# Reliable, as subscribers of either kind can receive that.
QOS = QoSProfile(depth=10)
# The frame of videos, which name none.
CAMERA_FRAME = 'camera'
# A subscriber that we know of may take this long to know of us.
MATCHING_S = 0.5
# From the last message of one loop to the first of the next.
LOOP_PAUSE_NS = NS_PER_S // 10
# A subscriber that is gone must not hold up the end.
LAST_DELIVERY_S = 2.0
# Messages hold seconds in 31 bits.
MAX_TIME_NS = 2**31 * NS_PER_S - 1

# Times in ns and messages, in the order of time.
TimedMessages: TypeAlias = Iterator[tuple[int, Any]]


class Player:
    """
    Publishes a Recording.

    Parameters
    ----------
    node, recording
        Who publishes what.
    topics
        What to publish beside the images, under the same names.
    config
        Of the node that listens. By its ``image_transport`` images that are no CompressedImages
        in the recording are published as JPEG, of its ``jpeg_quality``.

    """

    def __init__(self, node: Node, recording: Recording, topics: Iterable[str] = (),
                 config: NodeConfig = NodeConfig()) -> None:
        compress = config.image_transport == 'compressed'
        self._node = node
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(node)
        self._watch = PictureWatch(config)
        self._sources: list[Callable[[], TimedMessages]] = []
        topic = recording.image_topic
        recorded = recording.topics[topic] if topic else ''
        as_recorded = recorded == COMPRESSED_IMAGE or not compress
        if topic and config.join == NOT_JOINED and is_installed(recorded) and as_recorded:
            images_type = recorded
            self._sources.append(partial(recorded_messages, recording, topic))
        else:
            images_type = COMPRESSED_IMAGE if compress else IMAGE
            self._sources.append(partial(
                frame_messages, recording, message_type(images_type), config))
        ending, = (ending for ending, name in TRANSPORTS.values() if name == images_type)
        self.images = node.create_publisher(message_type(images_type), f'image{ending}', QOS)
        self._publishers = [self.images]
        for topic in topics:
            self._sources.append(partial(recorded_messages, recording, topic))
            self._publishers.append(node.create_publisher(
                message_type(recording.topics[topic]), topic, QOS))

    def wait_for_subscriber(self) -> None:
        """Return when somebody listens to the images."""
        while not self.images.get_subscription_count():
            self._spin_for(0.05)
        self._spin_for(MATCHING_S)

    def play(self, rate: float = 1., loop: bool = False, now: bool = False) -> None:
        """
        Publish everything at its time, ``rate`` times as fast.

        Header stamps stay as recorded, and go on increasing from one loop to the next; with
        ``now`` they are counted from the start of playing instead of that of the recording. Where
        the recorder's clock was set playing goes on after a second, and says so.
        """
        start_s = time.monotonic()
        start_ns = self._node.get_clock().now().nanoseconds
        loop_start_ns = 0
        while True:
            playing, is_empty = PlayingTime(), True
            clocks = {publisher: HeaderClock() for publisher in self._publishers}
            for time_ns, publisher, msg in self._timeline():
                is_empty = False
                stepped_by_ns = playing.advance(time_ns)
                if stepped_by_ns is not None:
                    self._node.get_logger().warning(
                        f'the times of the recording step by {duration(stepped_by_ns)}: '
                        'it goes on in a second')
                elapsed_ns = loop_start_ns + playing.elapsed_ns
                self._spin_for(start_s + elapsed_ns / rate / NS_PER_S - time.monotonic())
                if now:
                    restamp(msg, lambda ns: start_ns + round((loop_start_ns + clocks[
                        publisher].elapsed_ns(ns, time_ns, playing.elapsed_ns)) / rate))
                elif loop_start_ns:
                    # A stamp of zero means unknown and stays that.
                    restamp(msg, lambda ns: ns and ns + loop_start_ns)
                if publisher is self.images and (hint := self._watch.look(msg)):
                    self._node.get_logger().warning(hint)
                publisher.publish(msg)
            if not loop or is_empty:
                break
            loop_start_ns += playing.elapsed_ns + LOOP_PAUSE_NS
        for publisher in self._publishers:
            publisher.wait_for_all_acked(Duration(seconds=LAST_DELIVERY_S))

    def _timeline(self) -> Iterator[tuple[int, Publisher, Any]]:
        """Yield (time in ns, publisher, message) of all topics in the order of time."""
        def published_by(publisher: Publisher, source: Callable[[], TimedMessages]
                         ) -> Iterator[tuple[int, Publisher, Any]]:
            return ((time_ns, publisher, msg) for time_ns, msg in source())
        yield from merge(*map(published_by, self._publishers, self._sources),
                         key=lambda item: item[0])

    def _spin_for(self, seconds: float) -> None:
        """Serve the node for so long; ExternalShutdownException when ROS ends."""
        end_s = time.monotonic() + seconds
        while (left_s := end_s - time.monotonic()) > 0:
            self._executor.spin_once(timeout_sec=left_s)


def is_installed(name: str) -> bool:
    """Tell whether messages of a type can be published here."""
    try:
        ros_messages.message_type(name)
    except ImportError:
        return False
    return True


def recorded_messages(recording: Recording, topic: str) -> TimedMessages:
    """Yield (time of receipt in ns, rclpy message) of a bag's topic, faulty images included."""
    message = message_type(recording.topics[topic])
    for received_ns, recorded in recording.messages(topic):
        yield received_ns, ros_messages.copy_fields(recorded, message())


def frame_messages(recording: Recording, images_type: type[Any], config: NodeConfig
                   ) -> TimedMessages:
    """Yield (stamp in ns, Image or CompressedImage) of the pictures of a recording."""
    is_left_to_metadata = config.projection == EQUIRECT and config.layout == AUTO
    for frame in recording.frames():
        if is_left_to_metadata and (frame.layout or frame.refusal):
            # What a video's metadata say has no place in a message.
            try:
                frame = stitched(frame, config)
            except ProjectionError as error:
                raise RecordingError(f'{recording.name}: {error}') from None
        msg = (fill_image(Image(), frame.image) if images_type is Image
               else fill_compressed(CompressedImage(), frame.image, config.jpeg_quality))
        msg.header.stamp = time_message(frame.stamp_ns)
        msg.header.frame_id = frame.frame_id or CAMERA_FRAME
        yield frame.time_ns, msg


def message_type(name: str) -> type[Any]:
    """Return the class of, for example, ``sensor_msgs/msg/Image``."""
    try:
        return ros_messages.message_type(name)
    except ImportError:
        raise RecordingError(f'{name} is not installed') from None


def restamp(msg: Any, new_ns: Callable[[int], int]) -> None:
    """Replace the header's stamp, where there is one, by ``new_ns(stamp in ns)``."""
    if hasattr(msg, 'header'):
        msg.header.stamp = time_message(new_ns(stamp_ns(msg.header.stamp)))


def time_message(ns: int) -> Any:
    """Return the message of a time, or of the nearest that a message can hold."""
    return Time(nanoseconds=min(max(ns, 0), MAX_TIME_NS)).to_msg()


def arguments(argv: Sequence[str]) -> tuple[Namespace, Settings]:
    """Return the parsed command line and the Settings; exit 2 on a usage error."""
    parser = Parser(prog='player', description='Publish a recording on ROS topics.')
    parser.add_argument('recording', metavar='REC', type=Path,
                        help='rosbag2 folder, .mcap, .db3, ROS 1 .bag, or a video file')
    parser.add_argument('--rate', type=float, default=1., metavar='X',
                        help='how many times as fast as recorded (default: %(default)s)')
    parser.add_argument('--loop', action='store_true', help='start again at the end')
    parser.add_argument('--now', action='store_true',
                        help='stamp with the current time, as videos always are')
    parser.add_argument('--wait', action='store_true',
                        help='start when somebody listens to the images')
    parser.add_argument('--image-topic', metavar='TOPIC',
                        help='where the images are in a bag with several image topics; with '
                        'join A,B for two lenses')
    parser.add_argument('--topics', nargs='+', default=[], metavar='TOPIC',
                        help='further topics of the bag to publish')
    group = add_parameters(
        parser, 'image_transport, jpeg_quality, projection, layout and join count, but what a '
                'bag has compressed goes out as it is')
    add_shorthands(group, ('join',))
    group.add_argument('--compressed', action=SetParameters, nargs=0,
                       read=lambda _, flag: {'image_transport': (flag, 'compressed')},
                       help='publish JPEG on image/compressed also where images are raw')
    args = parser.parse_args(argv)
    if not args.rate > 0:
        parser.error('--rate must be positive')
    return args, settings_from(parser, given_parameters(parser, args))


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit status."""
    argv = sys.argv if argv is None else ['player', *argv]
    started = start_ros('player', argv, arguments)
    if started is None:
        return 2
    args, settings = started
    node: Node | None = None
    try:
        recording = open_recording(
            args.recording, args.image_topic, join=settings.config.join)
        for topic in args.topics:
            if topic not in recording.topics:
                raise RecordingError(f'{args.recording} has no topic {topic}')
        node = rclpy.create_node('player')
        player = Player(node, recording, args.topics, settings.config)
        if args.wait:
            player.wait_for_subscriber()
        # The times of a video are no clock's, and begin with zero, which means unknown to ROS.
        player.play(args.rate, args.loop, args.now or recording.image_topic is None)
    except ExternalShutdownException:
        pass
    except RCLError as error:
        # Publishing while ROS ends is no failure.
        if rclpy.ok():
            print(f'player: {one_line(error)}', file=sys.stderr)
            return 1
    except RecordingError as error:
        print(f'player: {one_line(error)}', file=sys.stderr)
        return 1
    finally:
        with bounded_ending():
            if node:
                node.destroy_node()
            rclpy.try_shutdown()
    return 0
