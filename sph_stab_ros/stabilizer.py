# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The ROS 2 node as an executable, see ``ros.node``."""

import os
import signal
import sys
from typing import Any


def main(args: list[str] | None = None) -> int:
    """Run the node until SIGINT or SIGTERM and return 0, or 2 where it cannot start."""
    # What it needs takes a second to import: a Ctrl-C meanwhile would show at which line.
    signal.signal(signal.SIGINT, _end_at_once)
    from sph_stab_ros.ros.node import run
    return run(args)


def _end_at_once(*signal_and_frame: Any) -> None:
    """End while nothing has begun."""
    os._exit(0)


if __name__ == '__main__':
    sys.exit(main())
