# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""
Publish a camera or stream that FFmpeg reads on ROS topics.

Pictures go out on image (Image) and image/compressed (CompressedImage), with camera_info
(CameraInfo) that tells their size, as much of it as somebody subscribes to; what comes as JPEG
goes out as it came. Where a source breaks off it is opened again. Ends with status 0 on SIGINT and
SIGTERM and at the end of a file or pipe.

The node itself needs none of this: its parameter source reads the same past the middleware.
"""

# Before all that takes time to import.
if __name__ == '__main__':
    from sph_stab_ros.executable import start
    raise SystemExit(start('camera'))

from argparse import Namespace
from collections.abc import Sequence
import sys

import rclpy
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation as rclpy_binding
from rclpy.node import Node
from rclpy.time import Time

from sensor_msgs.msg import CameraInfo, CompressedImage, Image

from sph_stab_ros.command_line import one_line, Parser
from sph_stab_ros.command_line.arguments import whole_number
from sph_stab_ros.command_line.process_setup import bounded_ending
from sph_stab_ros.config import JOINS, NODE_PARAMETERS, NOT_JOINED
from sph_stab_ros.images.codec import (
    compressed_fields, fill_image, fill_message, ImageError, JPEG_QUALITY)
from sph_stab_ros.images.frame import Frame
from sph_stab_ros.images.jpeg_file import jpeg_fields, JpegFile
from sph_stab_ros.live.address import Address, SourceError
from sph_stab_ros.live.joined import source_of
from sph_stab_ros.live.source import LivePicture
from sph_stab_ros.ros.diagnostics import ThrottledLog
from sph_stab_ros.ros.source_input import source_address
from sph_stab_ros.ros.starting import start_ros
from sph_stab_ros.ros.topics import advertise, compressed_topic, is_wanted
from sph_stab_ros.ros.worker import Worker
from std_msgs.msg import Header

RCLError = rclpy_binding.RCLError
LOOK_S = 0.2


class Camera:
    """
    Publishes what a source gives, the newest picture first.

    Parameters
    ----------
    node, address, rear
        Who publishes what, and of which other lens if there is one.
    frame_id
        Of the pictures.
    quality
        Of the JPEG files that are made of what comes as none.
    join
        How to put the pictures of two tracks or lenses together.

    """

    def __init__(self, node: Node, address: Address, rear: Address | None, frame_id: str,
                 quality: int, join: str = NOT_JOINED) -> None:
        self._frame_id, self._quality = frame_id, quality
        self._image = advertise(node, Image, 'image')
        self._compressed = advertise(node, CompressedImage, compressed_topic(node, 'image'))
        self._info = advertise(node, CameraInfo, 'camera_info')
        self._refusals = ThrottledLog(node.get_logger().warning)
        self._publishing = Worker('publishing', self._publish)
        self.source = source_of(
            address, rear, self._publishing.put, node.get_logger(), self._refuse, join)

    def start(self) -> None:
        """Start to read and publish."""
        self._publishing.start()
        self.source.start()

    def close(self) -> None:
        """Stop."""
        self.source.close()
        self._publishing.close()

    def _publish(self, picture: LivePicture) -> None:
        """Publish a picture, in the worker's thread: one that fails must not end it."""
        header = Header(stamp=Time(nanoseconds=picture.stamp_ns).to_msg(),
                        frame_id=self._frame_id)
        try:
            self._publish_with(header, Frame(picture.source, picture.stamp_ns))
        except ImageError as error:
            self._refuse(error)
        except Exception as error:
            # After a shutdown nothing can be published.
            if rclpy.ok():
                self._refusals.warn(type(error).__name__, f'image not published, {error!r}')

    def _publish_with(self, header: Header, frame: Frame) -> None:
        if is_wanted(self._compressed):
            fields = (jpeg_fields(frame.source) if isinstance(frame.source, JpegFile)
                      else compressed_fields(frame.image, self._quality))
            self._compressed.publish(fill_message(CompressedImage(header=header), fields))
        if is_wanted(self._image):
            self._image.publish(fill_image(Image(header=header), frame.image))
        if is_wanted(self._info):
            # Without a matrix it means "not calibrated": no model of ROS is that of a sphere.
            width, height = frame.size_wh
            self._info.publish(CameraInfo(header=header, width=width, height=height))

    def _refuse(self, error: ImageError) -> None:
        self._refusals.warn(error.reason, f'image refused, {error}')


def arguments(argv: Sequence[str] | None) -> tuple[Namespace, Address, Address | None]:
    """Return the parsed command line and the sources; exit 2 on a usage error."""
    parser = Parser(prog='camera', description=__doc__)
    parser.add_argument('source', metavar='SOURCE',
                        help='a device such as /dev/video0, an address such as rtsp://..., what '
                        "else FFmpeg reads, a file, or '-' for standard input")
    parser.add_argument('--rear', metavar='SOURCE',
                        help=NODE_PARAMETERS['source_rear'].description)
    parser.add_argument('--options', metavar='NAME=VALUE,...', default='',
                        help=NODE_PARAMETERS['source_options'].description)
    parser.add_argument('--frame', metavar='FRAME_ID',
                        default=NODE_PARAMETERS['source_frame'].default,
                        help='frame_id of the images (default: %(default)s)')
    parser.add_argument('--quality', metavar='N', type=whole_number(1, 100),
                        default=JPEG_QUALITY,
                        help='of the JPEG made of what comes otherwise (default: %(default)s)')
    parser.add_argument('--join', choices=JOINS, default=NOT_JOINED,
                        help=NODE_PARAMETERS['join'].description)
    args = parser.parse_args(argv)
    try:
        return (args, source_address(args.source, args.options),
                source_address(args.rear, args.options) if args.rear else None)
    except SourceError as error:
        parser.error(str(error))


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit status."""
    argv = sys.argv if argv is None else ['camera', *argv]
    started = start_ros('camera', argv, arguments)
    if started is None:
        return 2
    args, address, rear = started
    node: Node | None = None
    camera: Camera | None = None
    try:
        node = rclpy.create_node('camera')
        camera = Camera(node, address, rear, args.frame, args.quality, args.join)
        camera.start()
        executor = SingleThreadedExecutor()
        executor.add_node(node)
        while not camera.source.has_ended():
            executor.spin_once(timeout_sec=LOOK_S)
        return 0 if camera.source.state.pictures else 1
    except ExternalShutdownException:
        return 0
    except (RCLError, SourceError) as error:
        # What fails while ROS ends is no failure.
        if not rclpy.ok():
            return 0
        print(f'camera: {one_line(error)}', file=sys.stderr)
        return 1
    finally:
        with bounded_ending():
            if camera:
                camera.close()
            if node:
                node.destroy_node()
            rclpy.try_shutdown()
