# Copyright 2026 The sph_stab_ros developers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""
The ROS 2 node: spherical images in; orientation, stabilised images and a steerable view out.

Subscribes to ``image`` (sensor_msgs/Image) or ``image/compressed`` (sensor_msgs/CompressedImage),
as ``image_transport`` says, and to ``view/direction`` (geometry_msgs/QuaternionStamped,
``R_world_view``). The view looks where this topic or the parameters ``view.yaw_deg``,
``view.pitch_deg`` and ``view.roll_deg`` said last; setting one of them puts all three in force.

Publishes ``orientation`` (geometry_msgs/QuaternionStamped, ``R_world_camera``),
``stabilized/image``, ``view/image``, both with ``/compressed``, ``view/camera_info``, all with the
image's stamp and only what somebody subscribes to, and ``/diagnostics``. ``~/reset``
(std_srvs/Trigger) makes the next image's orientation the world's.

The executor only stores the newest image and answers services and parameters; a worker thread
decodes, stabilises and publishes. Images that come faster than that are dropped and counted.
"""

import sys
from threading import Lock, Thread
from time import monotonic

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import QuaternionStamped
import numpy as np
from rcl_interfaces.msg import SetParametersResult
import rclpy
from rclpy.clock import Clock, ClockType
from rclpy.exceptions import ParameterException
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.utilities import remove_ros_args
from sensor_msgs.msg import CameraInfo
from sph_stab_ros.command_line import limit_blas_threads, Parser
from sph_stab_ros.config import ConfigError
from sph_stab_ros.frame import Frame
from sph_stab_ros.masks import MaskError
from sph_stab_ros.recording.images import image_from_message, ImageError
from sph_stab_ros.ros.diagnostics import Diagnostics, ThrottledLog
from sph_stab_ros.ros.image_topics import (
    advertise, ImagePublisher, is_wanted, subscribe_to_images)
from sph_stab_ros.ros.messages import (
    orientation_message, rotation_from_message, stamp_ns, view_camera_info)
from sph_stab_ros.ros.one_slot_mailbox import OneSlotMailbox
from sph_stab_ros.ros.parameters import (
    changed_config, declare_parameters, undeclared_overrides)
from sph_stab_ros.stabilization import FrameError, Stabilizer, view_direction
from std_msgs.msg import Header
from std_srvs.srv import Trigger

DIAGNOSTICS_PERIOD_S = 1.0
DIRECTION_PARAMETERS = {'view.yaw_deg', 'view.pitch_deg', 'view.roll_deg'}


class StabilizerNode(Node):
    """Subscribes to images and publishes what the Stabilizer makes of them."""

    def __init__(self):
        super().__init__('stabilizer')
        self._config = declare_parameters(self)
        self._accepted_config = self._config
        self._stabilizer = Stabilizer(self._config)
        self._R_world_view = view_direction(self._config.view)
        self.add_on_set_parameters_callback(self._check_parameters)
        self.add_post_set_parameters_callback(self._apply_parameters)
        # Held while a frame is processed and published: a change is in effect once it is
        # acknowledged.
        self._lock = Lock()

        self._orientation = advertise(self, QuaternionStamped, 'orientation', depth=10)
        self._sphere = ImagePublisher(self, 'stabilized/image')
        self._view = ImagePublisher(self, 'view/image')
        self._view_info = advertise(self, CameraInfo, 'view/camera_info')
        self.create_service(Trigger, '~/reset', self._on_reset)
        self.create_subscription(QuaternionStamped, 'view/direction', self._on_direction, 10)
        self._inbox = OneSlotMailbox()
        images = subscribe_to_images(
            self, 'image', self._config.image_transport, self._on_image)

        self._log = ThrottledLog(self.get_logger().warning)
        self._diagnostics = Diagnostics(self.get_fully_qualified_name(),
                                        self.get_logger().warning)
        self._diagnostics_publisher = self.create_publisher(DiagnosticArray, '/diagnostics', 10)
        # By the steady clock: a heartbeat goes on when simulated time stands still.
        self.create_timer(DIAGNOSTICS_PERIOD_S, self._publish_diagnostics,
                          clock=Clock(clock_type=ClockType.STEADY_TIME))
        self._worker = Thread(target=self._work, name='worker')
        for name in undeclared_overrides(self):
            self.get_logger().warning(f"there is no parameter '{name}'")
        self.get_logger().info(f'waiting for images on {images.topic_name}')

    def start(self):
        """Start the worker."""
        self._worker.start()

    def destroy_node(self):
        """Let the worker finish its frame, then destroy the node."""
        self._inbox.close()
        if self._worker.is_alive():
            self._worker.join()
        super().destroy_node()

    # In the executor's thread.

    def _on_image(self, msg):
        if stamp_ns(msg.header.stamp) == 0:
            self.get_logger().warning(
                'image stamps are zero, times of receipt are used', once=True)
            msg.header.stamp = self.get_clock().now().to_msg()
        self._inbox.put((msg, monotonic()))

    def _on_direction(self, msg):
        """Look there until the direction is set again, by topic or parameter."""
        if msg.header.frame_id not in ('', self._config.stabilized_frame):
            self._log.warn('frame', f"view/direction is in frame '{msg.header.frame_id}', taken "
                                    f"as '{self._config.stabilized_frame}'")
        try:
            self._R_world_view = rotation_from_message(msg)
        except ValueError as error:
            self._log.warn('direction', f'view/direction ignored: {error}')

    def _on_reset(self, request, response):
        with self._lock:
            self._stabilizer.reset()
        self.get_logger().info('reset: the next image defines the stabilized frame')
        return Trigger.Response(
            success=True, message='the next image defines the stabilized frame')

    def _check_parameters(self, parameters):
        try:
            self._accepted_config = changed_config(self._config, parameters)
        except (ConfigError, MaskError) as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _apply_parameters(self, parameters):
        """Take over what was accepted, after rclpy's own checks and those of others."""
        with self._lock:
            self._config = self._accepted_config
            self._stabilizer.reconfigure(self._config)
            if DIRECTION_PARAMETERS.intersection(one.name for one in parameters):
                self._R_world_view = view_direction(self._config.view)

    def _publish_diagnostics(self):
        self._diagnostics_publisher.publish(DiagnosticArray(
            header=Header(stamp=self.get_clock().now().to_msg()),
            status=[self._diagnostics.status(self._inbox.dropped)]))

    # In the worker's thread.

    def _work(self):
        while (received := self._inbox.get()) is not None:
            try:
                self._process(*received)
            except ImageError as error:
                self._diagnostics.refuse(error.reason, error)
            except FrameError as error:
                self._diagnostics.refuse('unusable size', error)
            except Exception as error:
                # One frame must not end the node; after a shutdown nothing can be published.
                if self.context.ok():
                    self._diagnostics.refuse(type(error).__name__, f'{error!r}')

    def _process(self, msg, received_s):
        frame = Frame(image_from_message(msg), stamp_ns(msg.header.stamp), msg.header.frame_id)
        with self._lock:
            stabilized = self._stabilizer.process(frame)
            self._publish(stabilized, msg.header.stamp)
        self._diagnostics.count_frame(stabilized, monotonic() - received_s)

    def _publish(self, stabilized, stamp):
        config = self._config
        header = Header(stamp=stamp, frame_id=config.stabilized_frame)
        self._orientation.publish(orientation_message(header, stabilized.R_world_camera))
        if self._sphere.wanted:
            self._sphere.publish(header, stabilized.sphere(), config.jpeg_quality)
        view_header = Header(stamp=stamp, frame_id=config.view_frame)
        if is_wanted(self._view_info):
            self._view_info.publish(view_camera_info(view_header, config.view))
        if self._view.wanted:
            image = stabilized.view(self._R_world_view, np.deg2rad(config.view.hfov_deg),
                                    (config.view.width, config.view.height))
            self._view.publish(view_header, image, config.jpeg_quality)


def main(args=None):
    """Run the node until SIGINT or SIGTERM and return 0, or 2 where it cannot start."""
    parser = Parser(
        'stabilizer', description="Takes the rotation out of a spherical camera's video.",
        usage='%(prog)s [-h] [--ros-args [-r FROM:=TO] [-p NAME:=VALUE] [--params-file FILE]]',
        epilog='config/stabilizer.yaml describes all parameters, as does ros2 param describe.')
    try:
        parser.parse_args(remove_ros_args(args)[1:])
        rclpy.init(args=args)
    except RuntimeError as error:
        print(f'stabilizer: cannot start: {error}', file=sys.stderr)
        return 2
    limit_blas_threads()
    node = None
    try:
        node = StabilizerNode()
        node.start()
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except (ConfigError, MaskError, ParameterException, RuntimeError) as error:
        # A signal shuts rclpy down at any time; its calls then fail with a RuntimeError.
        if rclpy.ok():
            if node:
                raise
            print(f'stabilizer: cannot start: {error}', file=sys.stderr)
            return 2
    finally:
        if node:
            node.destroy_node()
        rclpy.try_shutdown()
    return 0


if __name__ == '__main__':
    sys.exit(main())
