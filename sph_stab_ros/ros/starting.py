# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""How an executable starts with ROS: both have arguments on its command line."""

from collections.abc import Callable, Sequence
import signal
import sys
from typing import TypeVar

import rclpy
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args

from sph_stab_ros.command_line import one_line
from sph_stab_ros.command_line.process_setup import set_up_process

Parsed = TypeVar('Parsed')
# Between these ROS's own arguments stand.
BEGIN, END = '--ros-args', '--'


def split_arguments(argv: Sequence[str]) -> tuple[list[str], list[str]]:
    """
    Return a command line's own arguments, and those of ROS.

    ROS takes NAME:=VALUE for a remapping anywhere, but behind a ``-p`` it is our own.
    """
    own: list[str] = []
    of_ros: list[str] = []
    is_of_ros = False
    for argument in argv:
        is_of_ros = is_of_ros or argument == BEGIN
        is_remapping = ':=' in argument and own[-1:] != ['-p']
        (of_ros if is_of_ros or is_remapping else own).append(argument)
        is_of_ros = is_of_ros and argument != END
    return own, of_ros


def start_ros(name: str, argv: list[str] | None, parse: Callable[[list[str]], Parsed],
              ended_by_signals: bool = True) -> Parsed | None:
    """
    Start ROS with its arguments in ``argv``, and return what ``parse`` makes of all others.

    The first of ``argv``, ``sys.argv`` by default, is the program's name. None after a line on
    stderr where ROS does not start. SIGINT and SIGTERM shut ROS down, unless told otherwise.
    """
    own, of_ros = split_arguments(sys.argv if argv is None else argv)
    try:
        parsed = parse(own[1:])
        # Refuses what ROS does not take, without a line of its own.
        remove_ros_args(of_ros)
        handlers = SignalHandlerOptions.NO
        if ended_by_signals:
            # rclpy's handler ends it; another one on top could come at any time, the second one
            # while a node is destroyed.
            handlers = SignalHandlerOptions.ALL
            signal.signal(signal.SIGINT, signal.SIG_IGN)
        set_up_process()
        rclpy.init(args=of_ros, signal_handler_options=handlers)
    except RuntimeError as error:
        print(f'{name}: cannot start: {one_line(error)}', file=sys.stderr)
        return None
    return parsed
