# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""
The robot as the page knows it: pictures with orientations, the stabilizer's state and services.

The picture that goes to the browsers is the camera's own file, unturned: the browser derotates it
while it draws. Of a camera that is not equirectangular the stabilizer's picture is taken. Raw
images are encoded as JPEG; video is decoded, and goes as it is to browsers that can take it.
Without a browser no images are subscribed to.
"""

import asyncio
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from time import monotonic
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import Quaternion, QuaternionStamped
from rclpy.client import Client
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.parameter_client import AsyncParameterClient
from rclpy.subscription import Subscription
from rclpy.task import Future
from sph_stab_ros.config import MODES
from sph_stab_ros.geometry.conventions import stamp_ns
from sph_stab_ros.operator.camera_pictures import CameraPictures
from sph_stab_ros.operator.link_status import link_status
from sph_stab_ros.operator.pairing import (
    Pairing, Picture, StampedOrientations, UnitQuaternion)
from sph_stab_ros.operator.robot_interface import RobotError, Watcher
from sph_stab_ros.ros.diagnostics import ThrottledLog
from sph_stab_ros.ros.messages import rotation_from_message
from sph_stab_ros.ros.topics import compressed_topic, subscribe_to_images
from std_msgs.msg import Header
from std_srvs.srv import Trigger

CHECK_PERIOD_S = 0.25
# Diagnostics come once per second.
SILENCE_S = 2.5
ANSWER_S = 3.0
# Others may change the mode too.
QUESTION_PERIOD_S = 1.0
PICTURES = {'camera': 'image', 'stabilizer': 'stabilized/image'}
MODE = 'smoothing.mode'


@dataclass(frozen=True)
class RobotState:
    """
    What the page shows of the stabilizer.

    ``tracking`` is its own word, '' while it is not heard; ``modes`` are what ``mode`` may be,
    empty while it is not heard.
    """

    camera: bool = False
    tracking: str = ''
    healthy: bool = False
    message: str = ''
    rate_hz: str = ''
    latency_ms: str = ''
    modes: tuple[str, ...] = ()
    mode: str = ''
    can_reset: bool = False
    can_level: bool = False


class Robot(Node):
    """
    The ROS side of the operator's page.

    Parameters
    ----------
    stabilizer
        Name of the stabilizer node, relative to this one's namespace.
    show
        Takes each Picture; called from threads of this node.
    pictures
        Whose, one of PICTURES.

    """

    def __init__(self, stabilizer: str, show: Callable[[Picture], object],
                 pictures: str = 'camera') -> None:
        super().__init__('operator')
        self._topic = PICTURES[pictures]
        self._watched = False
        self._images: Subscription | None = None
        self._transport: str | None = None
        self._frame_id = ''
        self._image_s = self._diagnostics_s = float('-inf')
        self._status = DiagnosticStatus()
        self._status_values: dict[str, str] = {}
        self._mode = ''
        self._question, self._next_question_s = Future(), 0.
        self._log = ThrottledLog(self.get_logger().warning)
        self._pairing = Pairing(show)
        self._orientations = StampedOrientations(self._pairing.add_orientation)
        self._pictures = CameraPictures(
            self._pairing.add_picture, self._log.warn, pictures == 'stabilizer')

        self._look = self.create_publisher(QuaternionStamped, 'view/direction', 10)
        self._diagnostics = self.create_publisher(DiagnosticArray, '/diagnostics', 10)
        self._reset = self.create_client(Trigger, f'{stabilizer}/reset')
        self._level = self.create_client(Trigger, f'{stabilizer}/level')
        self._node_parameters = AsyncParameterClient(self, stabilizer)
        name = stabilizer if stabilizer.startswith('/') else \
            f"{self.get_namespace().rstrip('/')}/{stabilizer}"
        self._status_name = f'{name}: stabilization'
        self.create_subscription(DiagnosticArray, '/diagnostics', self._on_diagnostics, 10)
        for topic, name in (('orientation', 'R_world_camera'),
                            ('virtual_orientation', 'R_world_virtual')):
            self.create_subscription(
                QuaternionStamped, topic, partial(self._on_orientation, name), 10)
        self.create_timer(CHECK_PERIOD_S, self._check,
                          clock=Clock(clock_type=ClockType.STEADY_TIME))

    def destroy_node(self) -> None:
        """End the workers and the node."""
        self._pictures.close()
        super().destroy_node()

    # For the web server, from its thread.

    @property
    def state(self) -> RobotState:
        """Return the present RobotState."""
        heard = monotonic() < self._diagnostics_s + SILENCE_S
        values = self._status_values if heard else {}
        return RobotState(
            camera=monotonic() < self._image_s + SILENCE_S,
            tracking=values.get('tracking', ''),
            healthy=heard and self._status.level == DiagnosticStatus.OK,
            message=self._status.message if heard else '',
            rate_hz=values.get('rate_hz', ''),
            latency_ms=values.get('latency_ms', ''),
            modes=MODES if heard else (),
            mode=self._mode if heard else '',
            can_reset=heard and self._reset.service_is_ready(),
            can_level=heard and self._level.service_is_ready())

    def watch(self, watched: bool, needs_files: bool) -> None:
        """Say whether anybody looks at the pictures, and whether at more than its own video."""
        self._watched = watched
        self._pictures.needs_files = needs_files

    def look(self, direction: UnitQuaternion) -> None:
        """Publish the operator's look direction, the quaternion of R_virtual_view."""
        x, y, z, w = direction
        self._look.publish(QuaternionStamped(
            header=Header(stamp=self.get_clock().now().to_msg(), frame_id=self._frame_id),
            quaternion=Quaternion(x=x, y=y, z=z, w=w)))

    def report(self, watchers: Sequence[Watcher]) -> None:
        """Publish who watches, and how well."""
        message, values = link_status(watchers)
        self._diagnostics.publish(DiagnosticArray(
            header=Header(stamp=self.get_clock().now().to_msg()),
            status=[DiagnosticStatus(
                level=DiagnosticStatus.OK, name=f'{self.get_fully_qualified_name()}: link',
                message=message,
                values=[KeyValue(key=key, value=value) for key, value in values.items()])]))

    async def reset_heading(self) -> str:
        """Make the next image's orientation the world's; return what to tell the operator."""
        await self._call(self._reset)
        return 'Heading reset: ahead is where the robot looks now.'

    async def level(self) -> str:
        """Level the horizon; return the stabilizer's answer."""
        return await self._call(self._level)

    async def set_mode(self, mode: str) -> str:
        """Change how the view follows the robot; return what to tell the operator."""
        if mode not in MODES:
            raise RobotError(f"The stabilizer has no mode '{mode}'.")
        answer = await self._answer(
            self._node_parameters.set_parameters([Parameter(MODE, value=mode)]))
        if not (answer.results and answer.results[0].successful):
            raise RobotError(sentence(answer.results[0].reason if answer.results else 'refused'))
        self._mode = mode
        return f"Mode: {mode.replace('_', ' ')}."

    async def _call(self, client: Client) -> str:
        """Call a Trigger service; return its answer, or raise it as RobotError."""
        if not client.service_is_ready():
            raise RobotError('The stabilizer does not offer that.')
        answer = await self._answer(client.call_async(Trigger.Request()))
        if not answer.success:
            raise RobotError(sentence(answer.message or 'the stabilizer refused'))
        return sentence(answer.message or 'done')

    async def _answer(self, future: Future) -> Any:
        """Wait for an rclpy future in the event loop; return its result."""
        loop = asyncio.get_running_loop()
        done = asyncio.Event()
        future.add_done_callback(lambda _: loop.call_soon_threadsafe(done.set))
        try:
            await asyncio.wait_for(done.wait(), ANSWER_S)
        except asyncio.TimeoutError:
            future.cancel()
            raise RobotError('The stabilizer did not answer.') from None
        return future.result()

    # In the executor's thread.

    def _on_orientation(self, name: str, msg: QuaternionStamped) -> None:
        self._frame_id = msg.header.frame_id
        try:
            x, y, z, w = rotation_from_message(msg).as_quat().tolist()
        except ValueError as error:
            self._log.warn(name, f'orientation ignored: {error}')
        else:
            self._orientations.add(stamp_ns(msg.header.stamp), **{name: (x, y, z, w)})

    def _on_image(self, msg: Any) -> None:
        self._image_s = monotonic()
        self._pictures.put(msg, self._image_s)

    def _on_diagnostics(self, msg: DiagnosticArray) -> None:
        for status in msg.status:
            if status.name == self._status_name:
                self._status = status
                self._status_values = {pair.key: pair.value for pair in status.values}
                self._diagnostics_s = monotonic()

    def _check(self) -> None:
        """Subscribe to what there is as far as it is wanted, and ask for the node's mode."""
        transport = self._present_transport() if self._watched else None
        if transport != self._transport:
            if self._images:
                self.destroy_subscription(self._images)
                self._images = None
            if transport:
                self._images = subscribe_to_images(
                    self, self._topic, transport, self._on_image)
            self._transport = transport
        if monotonic() > self._next_question_s and self._node_parameters.services_are_ready():
            self._next_question_s = monotonic() + QUESTION_PERIOD_S
            # What was asked before and not answered, by a node that is gone, will not be.
            self._question.cancel()
            self._question = self._node_parameters.get_parameters([MODE], self._on_mode)

    def _on_mode(self, future: Future) -> None:
        # Empty where there is no such parameter.
        if not future.cancelled() and (values := future.result().values):
            self._mode = values[0].string_value

    def _present_transport(self) -> str | None:
        """Return how the camera's images are published; as files, where both are."""
        if self.count_publishers(compressed_topic(self, self._topic)):
            return 'compressed'
        # Until there are any, what was subscribed to last may come again.
        return 'raw' if self.count_publishers(self._topic) else self._transport


def sentence(text: str) -> str:
    """Return a text with a capital and a full stop."""
    return text[:1].upper() + text[1:].rstrip('.') + '.'
