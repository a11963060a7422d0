# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""How an executable starts with ROS: both have arguments on its command line."""

from collections.abc import Callable
import signal
import sys
from typing import TypeVar

import rclpy
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args

from sph_stab_ros.command_line import one_line
from sph_stab_ros.command_line.process_setup import set_up_process

Parsed = TypeVar('Parsed')


def start_ros(name: str, argv: list[str] | None, parse: Callable[[list[str]], Parsed],
              ended_by_signals: bool = True) -> Parsed | None:
    """
    Start ROS with its arguments in ``argv``, and return what ``parse`` makes of all others.

    The first of ``argv``, ``sys.argv`` by default, is the program's name. None after a line on
    stderr where ROS does not start. SIGINT and SIGTERM shut ROS down, unless told otherwise.
    """
    try:
        parsed = parse(remove_ros_args(argv)[1:])
        handlers = SignalHandlerOptions.NO
        if ended_by_signals:
            # rclpy's handler ends it; another one on top could come at any time, the second one
            # while a node is destroyed.
            handlers = SignalHandlerOptions.ALL
            signal.signal(signal.SIGINT, signal.SIG_IGN)
        set_up_process()
        rclpy.init(args=argv, signal_handler_options=handlers)
    except RuntimeError as error:
        print(f'{name}: cannot start: {one_line(error)}', file=sys.stderr)
        return None
    return parsed
