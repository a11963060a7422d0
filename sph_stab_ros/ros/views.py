# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""
The views: each has topics and parameters under its name, and looks where it is told to.

A view looks where its parameters or ``direction`` (geometry_msgs/QuaternionStamped) said last, and
turns and zooms at the rates of ``cmd_vel`` (geometry_msgs/Twist), all in the stabilised picture:
the robot may turn as it likes.
"""

from time import monotonic

from geometry_msgs.msg import QuaternionStamped, Twist
import numpy as np
from rclpy.node import Node
from scipy.spatial.transform import Rotation
from sph_stab_ros.config import options, Settings, ViewConfig
from sph_stab_ros.ros.diagnostics import ThrottledLog
from sph_stab_ros.ros.messages import rates_from_twist, rotation_from_message
from sph_stab_ros.ros.topics import subscribe
from sph_stab_ros.stabilization.outputs import configured_look, VirtualCamera
from sph_stab_ros.stabilization.steering import Steering

DIRECTION = {'yaw_deg', 'pitch_deg', 'roll_deg'}
HFOV_LIMITS_RAD = next(
    (np.deg2rad(one.minimum), np.deg2rad(one.maximum))
    for one in options(ViewConfig)
    if one.name == 'hfov_deg' and one.minimum is not None and one.maximum is not None)


class View:
    """
    What steers one virtual camera.

    Parameters
    ----------
    node : rclpy.node.Node
    name : str
        Topics and parameters begin with it.
    settings : Settings
    log : ThrottledLog
        Told of messages that make no sense.

    """

    def __init__(self, node: Node, name: str, settings: Settings, log: ThrottledLog) -> None:
        self._name = name
        self._log = log
        self._config, self._view = settings.config, settings.views[name]
        self._steering = Steering(configured_look(self._view), HFOV_LIMITS_RAD)
        subscribe(node, QuaternionStamped, f'{name}/direction', self._on_direction)
        subscribe(node, Twist, f'{name}/cmd_vel', self._on_cmd_vel)

    def reconfigure(self, settings: Settings, names: set[str]) -> None:
        """
        Take on Settings of which the parameters ``names`` were set just now.

        An angle that is set puts all three in force, whatever was said since.
        """
        self._config, self._view = settings.config, settings.views[self._name]
        own = {name.removeprefix(f'{self._name}.') for name in names}
        if DIRECTION & own:
            self._steering.look(
                monotonic(), R_virtual_view=configured_look(self._view).R_virtual_view)
        if 'hfov_deg' in own:
            self._steering.look(monotonic(), hfov_rad=np.deg2rad(self._view.hfov_deg))

    def camera(self) -> VirtualCamera:
        """Return the VirtualCamera that looks as this view does at present."""
        return VirtualCamera(self._name, self._view, self._steering.at(monotonic()))

    def look_home(self) -> None:
        """Look at the stabilised frame's front."""
        self._steering.look(monotonic(), R_virtual_view=Rotation.identity())

    def _on_direction(self, msg: QuaternionStamped) -> None:
        """Look there until the direction is set again, by topic or parameter."""
        topic = f'{self._name}/direction'
        frames = self._config.stabilized_frame, self._config.virtual_frame
        if msg.header.frame_id not in ('', *frames):
            self._log.warn(f'{topic} frame', f"{topic} is in frame '{msg.header.frame_id}', "
                                             f"taken as '{frames[0]}'")
        try:
            self._steering.look(monotonic(), R_virtual_view=rotation_from_message(msg))
        except ValueError as error:
            self._log.warn(topic, f'{topic} ignored: {error}')

    def _on_cmd_vel(self, msg: Twist) -> None:
        """Turn and zoom until the next message, or until it is overdue."""
        try:
            self._steering.turn(
                monotonic(), rates_from_twist(msg), self._config.cmd_vel_timeout_s)
        except ValueError as error:
            self._log.warn(f'{self._name}/cmd_vel', f'{self._name}/cmd_vel ignored: {error}')
