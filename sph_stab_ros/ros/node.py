# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""
The ROS 2 node: spherical images in; orientation, stabilised images and steerable views out.

Subscribes to ``image`` (sensor_msgs/Image), ``image/compressed`` (sensor_msgs/CompressedImage) or
others, as ``image_transport`` says (``ros.topics``), or reads the camera or stream that ``source``
names itself (``ros.source_input``). Subscribes where ``level`` is ``imu`` to ``imu``
(sensor_msgs/Imu), and for each view to what steers it, see ``ros.views``.

Publishes ``orientation`` (geometry_msgs/QuaternionStamped, ``R_world_camera``),
``virtual_orientation`` (geometry_msgs/QuaternionStamped, ``R_world_virtual``),
``orientation_covariance`` (geometry_msgs/PoseWithCovarianceStamped) where the tracker knows it,
``stabilized/image`` and, for each of the ``views``, ``view/image``, both with ``/compressed``,
and ``view/camera_info``, ``/tf``, all with the image's stamp and only what somebody subscribes
to, and ``/diagnostics``. ``~/reset`` (std_srvs/Trigger) makes the next image's orientation the
world's, ``~/level`` makes the present one level, ``~/look_at_home`` turns all views to the world's
front.

The executor only stores the newest image and answers services and parameters. One worker thread
decodes, tracks and publishes the orientation, another one draws and publishes pictures; images
that come faster than that are dropped and counted; of compressed video all are decoded before, by
a worker of their own. No lock is held meanwhile: what is asked for is left for the workers, who
take it over before the next image.
"""

from collections.abc import Callable
from functools import partial
import os
import sys
from time import monotonic
from typing import Any

import cv2
from diagnostic_msgs.msg import DiagnosticArray
from rcl_interfaces.msg import SetParametersResult
import rclpy
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.exceptions import ParameterException
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos_overriding_options import InvalidQosOverridesError
from rclpy.signals import uninstall_signal_handlers
from sph_stab_ros.command_line import one_line, Parser
from sph_stab_ros.command_line.process_setup import bounded_ending, give_back_freed_memory
from sph_stab_ros.config import ConfigError, IMU, NOT_JOINED
from sph_stab_ros.geometry.conventions import NS_PER_S
from sph_stab_ros.geometry.masks import MaskError
from sph_stab_ros.geometry.projection_factory import ProjectionError
from sph_stab_ros.images.codec import ImageError
from sph_stab_ros.images.picture_clock import PictureClock
from sph_stab_ros.images.picture_time import PictureTime, Stamp, TimeEvent, told
from sph_stab_ros.ros.diagnostics import Diagnostics, LOG_PERIOD_S, ThrottledLog
from sph_stab_ros.ros.image_input import ImageInput, ReceivedImage
from sph_stab_ros.ros.imu_input import ImuInput
from sph_stab_ros.ros.joined_input import JoinedInput
from sph_stab_ros.ros.parameters import changed, declare_parameters, undeclared_overrides
from sph_stab_ros.ros.publishers import Outputs
from sph_stab_ros.ros.source_input import SourceInput
from sph_stab_ros.ros.starting import start_ros
from sph_stab_ros.ros.topics import advertise
from sph_stab_ros.ros.worker import Worker
from sph_stab_ros.stabilization.level import LevelError
from sph_stab_ros.stabilization.outputs import Output
from sph_stab_ros.stabilization.pipeline import Stabilizer
from std_msgs.msg import Header
from std_srvs.srv import Trigger

DIAGNOSTICS_PERIOD_S = 1.0
SWITCH_INTERVAL_S = 0.0005


class StabilizerNode(Node):
    """Subscribes to images and publishes what the Stabilizer makes of them."""

    def __init__(self) -> None:
        super().__init__('stabilizer')
        self._settings = self._accepted_settings = declare_parameters(self)
        config = self._settings.config
        self._stabilizer = Stabilizer(config)
        self._picture_clock, self._reset_wanted = PictureClock(), False

        warn = self.get_logger().warning
        self._diagnostics = Diagnostics(self.get_fully_qualified_name(), warn)
        self._outputs = Outputs(self, self._settings, ThrottledLog(warn), self._diagnostics.cpu)
        self.create_service(Trigger, '~/reset', self._on_reset)
        self.create_service(Trigger, '~/level', self._on_level)
        self.create_service(Trigger, '~/look_at_home', self._on_look_at_home)
        # Pictures take as long as tracking: while one is drawn the next frame is tracked, and the
        # orientation waits for neither.
        self._tracking = Worker('tracking', partial(self._safely, self._track))
        self._drawing = Worker('drawing', partial(self._safely, self._draw))
        input_of = (SourceInput if config.source or config.source_rear else
                    ImageInput if config.join == NOT_JOINED else JoinedInput)
        self._images = input_of(self, config, self._tracking.put, self._diagnostics)
        self._imu = ImuInput(self, self._stabilizer.add_imu_samples, self._diagnostics)
        self._imu.listen(config.level == IMU)

        self._diagnostics_publisher = advertise(self, DiagnosticArray, '/diagnostics', depth=10)
        # By the steady clock: a heartbeat goes on when simulated time stands still.
        self.create_timer(DIAGNOSTICS_PERIOD_S, self._publish_diagnostics,
                          clock=Clock(clock_type=ClockType.STEADY_TIME))
        self.add_on_set_parameters_callback(self._check_parameters)
        self.add_post_set_parameters_callback(self._apply_parameters)
        for name in undeclared_overrides(self):
            self.get_logger().warning(f"there is no parameter '{name}'")
        self.get_logger().info(f'waiting for images on {self._images.name}')

    def start(self) -> None:
        """Start the workers."""
        self._images.start()
        self._tracking.start()
        self._drawing.start()

    def serve(self) -> None:
        """Serve the middleware until it is shut down, whatever one callback may fail at."""
        while self.context.ok():
            try:
                rclpy.spin(self)
            except ExternalShutdownException:
                return
            except Exception as error:
                if self.context.ok():
                    self.get_logger().error(
                        f'a call made no sense: {error!r}', throttle_duration_sec=LOG_PERIOD_S)

    def destroy_node(self) -> None:
        """Let the workers finish their frames, then destroy the node."""
        self._images.close()
        self._tracking.close()
        self._drawing.close()
        super().destroy_node()

    # In the executor's thread.

    def _on_reset(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self._reset_wanted = True
        message = 'the next image defines the stabilized frame'
        self.get_logger().info(f'reset: {message}', throttle_duration_sec=LOG_PERIOD_S)
        return Trigger.Response(success=True, message=message)

    def _on_level(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        try:
            if self._reset_wanted:
                raise LevelError('there is no picture since the reset yet')
            self._stabilizer.level_here()
        except LevelError as error:
            return Trigger.Response(success=False, message=str(error))
        return Trigger.Response(success=True, message='the present orientation becomes level')

    def _on_look_at_home(
            self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self._outputs.look_home()
        return Trigger.Response(
            success=True, message="all views look at the stabilized frame's front")

    def _check_parameters(self, parameters: list[Parameter]) -> SetParametersResult:
        try:
            self._accepted_settings = changed(self._settings, parameters)
        except (ConfigError, MaskError) as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _apply_parameters(self, parameters: list[Parameter]) -> None:
        """Take over what was accepted, after rclpy's own checks and those of others."""
        self._settings = self._accepted_settings
        self._outputs.reconfigure(self._settings, {one.name for one in parameters})
        self._imu.listen(self._settings.config.level == IMU)

    def _publish_diagnostics(self) -> None:
        self._imu.collect()
        self._diagnostics_publisher.publish(DiagnosticArray(
            header=Header(stamp=self.get_clock().now().to_msg()),
            status=[self._diagnostics.status(
                self._images.dropped + self._tracking.dropped, self._drawing.dropped,
                self._images.why_silent(), self._images.state())]))
        give_back_freed_memory()

    # In the workers' threads.

    def _safely(self, work: Callable[..., None], *item: Any) -> None:
        """Do some work: one frame must not end the node."""
        try:
            work(*item)
        except (ImageError, ProjectionError) as error:
            self._diagnostics.refuse(error.reason, error)
        except Exception as error:
            # After a shutdown nothing can be published.
            if self.context.ok():
                self._diagnostics.refuse(type(error).__name__, f'{error!r}')

    def _track(self, image: ReceivedImage) -> None:
        cpu = self._diagnostics.cpu
        self._take_over_what_is_wanted()
        with cpu.stage('decode'):
            times = self._picture_clock.decide(
                Stamp(image.stamp_ns, round(image.received_s * NS_PER_S)))
            self._judge_time(times)
            frame = image.frame(times)
            if self._outputs.pictures_wanted:
                frame.load()
            self._diagnostics.look_at(frame, self._settings.config)
        with cpu.stage('imu'):
            self._imu.collect()
        with cpu.stage('track'):
            stabilized = self._stabilizer.process(frame)
        pictures = self._outputs.publish_orientation(stabilized)
        self._diagnostics.count_frame(stabilized, self._stabilizer.tracker)
        self._drawing.put(pictures, image.received_s)
        self._settle()

    def _settle(self) -> None:
        """Do what the orientation has not waited for; the image was used whatever comes of it."""
        try:
            with self._diagnostics.cpu.stage('track'):
                self._stabilizer.settle()
        except Exception as error:
            self._diagnostics.event('keyframe_failed', f'a keyframe was given up: {error!r}')

    def _draw(self, pictures: list[Output], received_s: float) -> None:
        self._outputs.publish(pictures)
        self._diagnostics.count_latency(monotonic() - received_s)

    def _take_over_what_is_wanted(self) -> None:
        if self._reset_wanted:
            self._stabilizer.reset()
            self._picture_clock = PictureClock()
            # Only now: until then there is nothing that ~/level could mean.
            self._reset_wanted = False
        self._stabilizer.reconfigure(self._settings.config)

    def _judge_time(self, times: PictureTime) -> None:
        """Say what is wrong with stamps; reset where they went back for good, as in a loop."""
        if times.event is TimeEvent.STEP_BACK:
            self._stabilizer.reset()
            self._stabilizer.forget_imu()
            self._diagnostics.event(
                times.event.value, f'the stamps went back by {-times.by_ns / NS_PER_S:.3f} s, '
                'reset: this image defines the stabilized frame')
        elif times.event is not None:
            self._diagnostics.event(times.event.value, told(times))


def run(args: list[str] | None = None) -> int:
    """Run the node until SIGINT or SIGTERM and return 0, or 2 where it cannot start."""
    parser = Parser(
        'stabilizer', description="Takes the rotation out of a spherical camera's video.",
        usage='%(prog)s [-h] [--ros-args [-r FROM:=TO] [-p NAME:=VALUE] [--params-file FILE]]',
        epilog='config/stabilizer.yaml describes all parameters, as does ros2 param describe.')
    if start_ros('stabilizer', args, parser.parse_args) is None:
        return 2
    # Two workers share the interpreter: each call that gives it away would wait 5 ms for another.
    sys.setswitchinterval(SWITCH_INTERVAL_S)
    # And the cores.
    cv2.setNumThreads(max((os.cpu_count() or 2) // 2, 1))
    node = None
    try:
        node = StabilizerNode()
        node.start()
        node.serve()
    except (ConfigError, MaskError, ParameterException, InvalidQosOverridesError,
            RuntimeError) as error:
        # A signal shuts rclpy down at any time; its calls then fail with a RuntimeError.
        if rclpy.ok():
            if node:
                raise
            print(f'stabilizer: cannot start: {one_line(error)}', file=sys.stderr)
            return 2
    finally:
        # It is ending: rclpy's handler would touch what is freed meanwhile.
        uninstall_signal_handlers()
        with bounded_ending():
            if node:
                node.destroy_node()
            rclpy.try_shutdown()
    return 0
