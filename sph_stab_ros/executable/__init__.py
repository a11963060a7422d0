# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""
How the executables start: what they need takes a second to import.

A Ctrl-C meanwhile would show at which line, so each is imported behind a handler that ends the
process. Whoever has begun, sets a handler of its own. Nothing else may be imported here.
"""

from functools import partial
from importlib import import_module
import os
import signal
from typing import Any

# What runs until a Ctrl-C, which is no failure then.
UNTIL_INTERRUPTED = ('stabilizer', 'operator', 'camera', 'player')


def start(module: str) -> int:
    """Run the executable in a module of the package; return its exit status."""
    name = module.removesuffix('.__main__')

    def end_at_once(*_: Any) -> None:
        if name in UNTIL_INTERRUPTED:
            os._exit(0)
        os.write(2, f'{name}: interrupted\n'.encode())
        os._exit(1)

    signal.signal(signal.SIGINT, end_at_once)
    status: int = import_module(f'sph_stab_ros.{module}').main()
    return status


batch = partial(start, 'batch.__main__')
benchmark = partial(start, 'benchmark.__main__')
calibrate = partial(start, 'calibrate')
camera = partial(start, 'camera')
demo = partial(start, 'demo')
evaluate = partial(start, 'evaluate')
operator = partial(start, 'operator.__main__')
player = partial(start, 'player')
replay = partial(start, 'replay')
stabilizer = partial(start, 'stabilizer')
