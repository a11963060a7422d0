# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""
Serve the operator's page: look around in the stabilised view with a browser.

Subscribes to ``image/compressed`` or ``image``, ``orientation``, ``virtual_orientation`` and
``/diagnostics``, publishes ``view/direction`` and calls the services of the stabilizer node. Ends
on SIGINT and SIGTERM.
"""

from argparse import Namespace
import asyncio
from collections.abc import Sequence
import logging
from pathlib import Path
import signal
import socket
import sys
from typing import TYPE_CHECKING

import rclpy
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args

from sph_stab_ros.command_line import Parser
from sph_stab_ros.command_line.process_setup import bounded_ending, set_up_process

if TYPE_CHECKING:
    from aiohttp.web import AppRunner
    from sph_stab_ros.operator.server import OperatorServer

PORT = 8360
LOOPBACK = '127.0.0.1'
LOG = logging.getLogger('operator')


def arguments(argv: Sequence[str]) -> Namespace:
    """Return the parsed command line; exit 2 on a usage error."""
    parser = Parser(
        prog='operator', description='Serve a page to look around in the stabilised view.',
        epilog='Topics are remapped by --ros-args -r image:=/camera/image.')
    parser.add_argument('--host', default=LOOPBACK, metavar='ADDRESS',
                        help='where to listen; 0.0.0.0 for the whole network, whose browsers then '
                             'need the token in the address printed (default: %(default)s)')
    parser.add_argument('--port', type=int, metavar='N',
                        help=f'0 for any that is free (default: {PORT}, or any if that is taken)')
    parser.add_argument('--token-file', type=Path, metavar='FILE',
                        help='file with the token to ask for, instead of a new one at each start')
    parser.add_argument('--browsers', type=int, default=5, metavar='N',
                        help='how many may look at the same time (default: %(default)s)')
    parser.add_argument('--stabilizer', default='stabilizer', metavar='NAME',
                        help='name of the stabilizer node (default: %(default)s)')
    parser.add_argument('--pictures', choices=('camera', 'stabilizer'), default='camera',
                        help="whose pictures to send; the stabilizer's costs more, and is for "
                             'cameras that are not equirectangular (default: %(default)s)')
    args = parser.parse_args(argv)
    if args.port is not None and not 0 <= args.port < 2**16:
        parser.error('--port lies within 0 and 65535')
    if args.browsers < 1:
        parser.error('--browsers must be positive')
    args.token = None
    if args.token_file:
        try:
            args.token = args.token_file.read_text().strip()
        except (OSError, UnicodeDecodeError) as error:
            parser.error(f'{args.token_file} cannot be read: {error}')
        if not args.token:
            parser.error(f'{args.token_file} is empty')
    return args


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit status."""
    argv = sys.argv if argv is None else ['operator', *argv]
    try:
        args = arguments(remove_ros_args(argv)[1:])
        set_up_process()
        rclpy.init(args=argv, signal_handler_options=SignalHandlerOptions.NO)
    except RuntimeError as error:
        print(f'operator: {str(error).splitlines()[0]}', file=sys.stderr)
        return 2
    logging.basicConfig(format='operator: %(message)s', level=logging.INFO, stream=sys.stderr)
    try:
        asyncio.run(serve(args))
    except ImportError as error:
        if error.name != 'aiohttp':
            raise
        print("operator: this needs aiohttp: pip install 'sph_stab_ros[operator]' or "
              'apt install python3-aiohttp', file=sys.stderr)
        return 1
    except OSError as error:
        print(f'operator: cannot listen on {args.host}: {error.strerror}', file=sys.stderr)
        return 1
    finally:
        rclpy.try_shutdown()
    return 0


async def serve(args: Namespace) -> None:
    """Serve the page until SIGINT or SIGTERM."""
    # An optional dependency, missing with a line of its own.
    from sph_stab_ros.operator.access import Access, is_loopback, new_token
    from sph_stab_ros.operator.robot import Robot
    from sph_stab_ros.operator.server import OperatorServer
    from sph_stab_ros.ros.diagnostics import ThrottledLog

    loop = asyncio.get_running_loop()
    ending = asyncio.Event()
    for ending_signal in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(ending_signal, ending.set)
    token = args.token or (None if is_loopback(args.host) else new_token())
    robot = Robot(args.stabilizer,
                  lambda picture: loop.call_soon_threadsafe(server.show, picture),
                  args.pictures)
    server = OperatorServer(robot, Access(args.host, token), ThrottledLog(LOG.warning).warn,
                            args.browsers)
    try:
        runner = await start(server, args.host, args.port)
        spinning = asyncio.create_task(asyncio.to_thread(spin, robot))
        print(f'operator: {address(args.host, runner.addresses[0][1], token)}', flush=True)
        # Spinning ends by itself only by a fault of our own.
        await asyncio.wait((spinning, asyncio.create_task(ending.wait())),
                           return_when=asyncio.FIRST_COMPLETED)
        await runner.cleanup()
        rclpy.try_shutdown()
        await spinning
    finally:
        with bounded_ending():
            robot.destroy_node()


async def start(server: 'OperatorServer', host: str, port: int | None) -> 'AppRunner':
    """Let the server listen; return its runner. OSError where it cannot."""
    if port is not None:
        return await server.start(host, port)
    try:
        return await server.start(host, PORT)
    except OSError as error:
        LOG.info('port %d is taken: %s', PORT, error.strerror)
        return await server.start(host, 0)


def spin(robot: Node) -> None:
    """Serve the node until ROS ends."""
    executor = SingleThreadedExecutor()
    executor.add_node(robot)
    try:
        executor.spin()
    except ExternalShutdownException:
        pass


def address(host: str, port: int, token: str | None) -> str:
    """Return the URL to open in a browser."""
    if host in ('0.0.0.0', '::', ''):
        host = own_address()
    name = f'[{host}]' if ':' in host else host
    return f'http://{name}:{port}/' + (f'?token={token}' if token else '')


def own_address() -> str:
    """Return the address by which others reach this machine, or its name."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            # Nothing is sent: this only asks for the way out. The address is one for examples.
            probe.connect(('192.0.2.1', 9))
            return probe.getsockname()[0]
        except OSError:
            return socket.gethostname()


if __name__ == '__main__':
    sys.exit(main())
