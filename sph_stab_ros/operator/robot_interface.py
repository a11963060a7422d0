# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.


"""What the web server asks of the robot, and how that says no."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from sph_stab_ros.operator.pairing import UnitQuaternion
from sph_stab_ros.operator.protocol import Link


class RobotError(Exception):
    """Something that the robot cannot or did not do, in one line for the operator."""


@dataclass(frozen=True)
class Watcher:
    """A browser: its address, whether it steers, and its Link, None until it has told."""

    address: str
    steers: bool
    link: Link | None


class OperatedRobot(Protocol):
    """
    What an OperatorServer asks of the robot.

    The coroutines return what to tell the operator, or raise RobotError.
    """

    @property
    def state(self) -> Any:
        """Return a dataclass for the page."""

    def watch(self, watched: bool, needs_files: bool) -> None:
        """Take in whether anybody looks at the pictures, and whether at more than its video."""

    def report(self, watchers: Sequence[Watcher]) -> None:
        """Take in who watches, and how well; once a second."""

    def look(self, direction: UnitQuaternion) -> None:
        """Take in where the operator looks, ``R_virtual_view``."""

    async def reset_heading(self) -> str:
        """Make the camera's present orientation the world's."""

    async def level(self) -> str:
        """Make the present orientation level."""

    async def set_mode(self, mode: str) -> str:
        """Change how the view follows the robot."""
