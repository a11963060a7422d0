# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""All executables behind one name that no other program has: ``sph-stab NAME ARGUMENTS…``."""

import sys

from sph_stab_ros.executable import start

# By their names, the modules whose main() they are, and what for.
COMMANDS = {
    'stabilizer': ('stabilizer', 'the ROS 2 node: takes the rotation out of live pictures'),
    'operator': ('operator.__main__', 'a page to look around in, in the browser'),
    'camera': ('camera', 'publishes a camera or stream on ROS topics'),
    'player': ('player', 'publishes a recording on ROS topics'),
    'replay': ('replay', 'stabilises a recording'),
    'batch': ('batch.__main__', 'stabilises many recordings'),
    'evaluate': ('evaluate', 'compares orientations with the truth'),
    'calibrate': ('calibrate', 'refines the calibration of two fisheye lenses'),
    'demo': ('demo', 'a recording, the node and the page, without a robot'),
    'benchmark': ('benchmark.__main__', 'measures times'),
}


def main() -> int:
    """Run the command that the first argument names and return its exit status."""
    name = sys.argv[1] if len(sys.argv) > 1 else ''
    if name in ('-h', '--help'):
        print(usage())
        return 0
    if name not in COMMANDS:
        print(usage(), file=sys.stderr)
        return 2
    # Each reads sys.argv itself, as ROS does.
    del sys.argv[1]
    sys.argv[0] = f'sph-stab {name}'
    return start(COMMANDS[name][0])


def usage() -> str:
    """Return the list of commands."""
    width = max(map(len, COMMANDS))
    return '\n'.join(['usage: sph-stab NAME ..., where NAME is one of',
                      *(f'  {name:{width}}  {text}' for name, (_, text) in COMMANDS.items()),
                      'sph-stab NAME --help tells more.'])


if __name__ == '__main__':
    sys.exit(main())
