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
``/diagnostics``, publishes ``view/direction`` and, on ``/diagnostics``, how good the link is, and
calls the services of the stabilizer node. Ends on SIGINT and SIGTERM.
"""

# Before all that takes time to import.
if __name__ == '__main__':
    from sph_stab_ros.executable import start
    raise SystemExit(start('operator.__main__'))

from argparse import Namespace
import asyncio
from collections.abc import Callable, Sequence
import logging
from pathlib import Path
import signal
from ssl import SSLContext, SSLError
import sys
from typing import TYPE_CHECKING

import rclpy
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node

from sph_stab_ros.command_line import Parser
from sph_stab_ros.command_line.arguments import whole_number
from sph_stab_ros.command_line.process_setup import bounded_ending
from sph_stab_ros.config import LIVE_ENCODERS
from sph_stab_ros.operator.addresses import own_address
from sph_stab_ros.ros.starting import start_ros

if TYPE_CHECKING:
    from sph_stab_ros.operator.datagrams import Datagrams
    from sph_stab_ros.operator.listening import Listener
    from sph_stab_ros.operator.server import OperatorServer
    from sph_stab_ros.operator.video import Video

PORT = 8360
# Encoders that are not in hardware.
X264, NONE = 'x264', 'none'
LOOPBACK = '127.0.0.1'
# What is said of optional dependencies.
MISSING = {'aiohttp': 'this needs aiohttp',
           'cryptography': '--host needs --certificate, --insecure, or cryptography to make a '
                           'certificate'}
LOG = logging.getLogger('operator')


class Failure(Exception):
    """What keeps the server from starting, in one line."""


def arguments(argv: Sequence[str]) -> Namespace:
    """Return the parsed command line; exit 2 on a usage error."""
    parser = Parser(
        prog='operator', description='Serve a page to look around in the stabilised view.',
        epilog='Topics are remapped by --ros-args -r image:=/camera/image.')
    parser.add_argument('--host', default=LOOPBACK, metavar='ADDRESS',
                        help='where to listen; 0.0.0.0 for the whole network, whose browsers then '
                             'need the token in the address printed (default: %(default)s)')
    parser.add_argument('--port', type=whole_number(0, 2**16 - 1), metavar='N',
                        help=f'0 for any that is free (default: {PORT}, or any if that is taken)')
    parser.add_argument('--token-file', type=Path, metavar='FILE',
                        help='file with the token to ask for, instead of a new one at each start')
    parser.add_argument('--certificate', type=Path, metavar='FILE',
                        help='serve https with this certificate chain (PEM) instead of one of our '
                             'own')
    parser.add_argument('--key', type=Path, metavar='FILE',
                        help="the certificate's key, if that is not in the same file")
    parser.add_argument('--insecure', action='store_true',
                        help='serve http also beyond this machine: everybody on the way can see '
                             'the pictures and the token')
    parser.add_argument('--browsers', type=whole_number(1), default=5, metavar='N',
                        help='how many may look at the same time (default: %(default)s)')
    parser.add_argument('--stabilizer', default='stabilizer', metavar='NAME',
                        help='name of the stabilizer node (default: %(default)s)')
    parser.add_argument('--pictures', choices=('camera', 'stabilizer'), default='camera',
                        help="whose pictures to send; the stabilizer's costs more, and is for "
                             'cameras that are not equirectangular (default: %(default)s)')
    parser.add_argument('--encoder', choices=(X264, NONE, *LIVE_ENCODERS), default=X264,
                        help='what makes a video of the pictures for browsers that take one: a '
                             'tenth of the bits for half a core; one in a graphics card or '
                             'another chip, if it can be used, x264 otherwise; none sends JPEG '
                             'alone (default: %(default)s)')
    parser.add_argument('--recordings', type=Path, default=Path('recordings'), metavar='FOLDER',
                        help='where the bags come that the page records (default: %(default)s)')
    args = parser.parse_args(argv)
    if args.insecure and args.certificate:
        parser.error('--insecure leaves no use for --certificate')
    if args.key and not args.certificate:
        parser.error('--key goes with --certificate')
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
    args = start_ros('operator', argv, arguments, ended_by_signals=False)
    if args is None:
        return 2
    logging.basicConfig(format='operator: %(message)s', level=logging.INFO, stream=sys.stderr)
    try:
        asyncio.run(serve(args))
    except ImportError as error:
        if error.name not in MISSING:
            raise
        print(f"operator: {MISSING[error.name]}: pip install 'sph_stab_ros[operator]' or "
              f'apt install python3-{error.name}', file=sys.stderr)
        return 1
    except OSError as error:
        print(f'operator: cannot listen on {args.host}: {error.strerror}', file=sys.stderr)
        return 1
    except Failure as failure:
        print(f'operator: {failure}', file=sys.stderr)
        return 1
    finally:
        rclpy.try_shutdown()
    return 0


async def serve(args: Namespace) -> None:
    """Serve the page until SIGINT or SIGTERM."""
    # An optional dependency, missing with a line of its own.
    from sph_stab_ros.operator.access import Access, is_loopback, new_token
    from sph_stab_ros.operator.encryption import (
        AUTHORITY_FILE, AUTHORITY_TYPE, encryption)
    from sph_stab_ros.operator.recorder import Recorder
    from sph_stab_ros.operator.robot import Robot
    from sph_stab_ros.operator.server import OperatorServer
    from sph_stab_ros.ros.diagnostics import ThrottledLog
    from sph_stab_ros.ros.parameters import undeclared_overrides

    loop = asyncio.get_running_loop()
    ending = asyncio.Event()
    for ending_signal in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(ending_signal, ending.set)
    token = args.token or (None if is_loopback(args.host) else new_token())
    try:
        tls = encryption(args)
    except OSError as error:
        # OpenSSL says neither in which file nor, in plain words, what.
        what = 'no certificate with its key, unencrypted, in PEM' \
            if isinstance(error, SSLError) else error.strerror
        raise Failure(f'no https: {error.filename or args.certificate}: {what}') from None
    robot = Robot(args.stabilizer,
                  lambda picture: loop.call_soon_threadsafe(server.show, picture),
                  args.pictures)
    unknown = undeclared_overrides(robot)
    if unknown:
        LOG.warning('there is no parameter %s here; those of the stabilizer are set at that node',
                    ', '.join(map(repr, unknown)))
    warn = ThrottledLog(LOG.warning).warn
    encoding = None if args.encoder == NONE else video(warn, args.encoder)
    server = OperatorServer(robot, Access(args.host, token), Recorder(args.recordings, warn), warn,
                            args.browsers, encoding,
                            datagrams(warn) if tls and encoding else None)
    if tls and tls.authority_pem:
        server.files.offer(AUTHORITY_FILE, tls.authority_pem, AUTHORITY_TYPE)
    try:
        listener = await listen(server, args.host, args.port, tls.context if tls else None)
        spinning = asyncio.create_task(asyncio.to_thread(spin, robot))
        base = address(args.host, listener.addresses[0][1], bool(tls))
        print(f'operator: {base}' + (f'?token={token}' if token else ''), flush=True)
        if tls and tls.authority_pem:
            print(f'operator: its certificate has SHA-256 {tls.fingerprint}\n'
                  f'operator: to trust it, {base}{AUTHORITY_FILE}, with SHA-256 '
                  f'{tls.authority_fingerprint}', flush=True)
        # Spinning ends by itself only by a fault of our own.
        await asyncio.wait((spinning, asyncio.create_task(ending.wait())),
                           return_when=asyncio.FIRST_COMPLETED)
        await listener.cleanup()
        rclpy.try_shutdown()
        await spinning
    finally:
        with bounded_ending():
            robot.destroy_node()


def video(warn: Callable[[str, str], object], encoder: str) -> 'Video | None':
    """Return what encodes, or None where nothing can, with a line in the log."""
    from sph_stab_ros.images.video.decoder import INSTALL
    try:
        from sph_stab_ros.operator.h264 import can_encode, SOFTWARE
        from sph_stab_ros.operator.video import Video
        if can_encode():
            return Video(warn, SOFTWARE if encoder == X264 else encoder)
    except ImportError as error:
        if error.name != 'av':
            raise
    LOG.info('pictures go out as JPEG: video %s, with libx264', INSTALL)
    return None


def datagrams(warn: Callable[[str, str], object]) -> 'Datagrams | None':
    """Return another way for video, or None where there is none, with a line in the log."""
    try:
        from sph_stab_ros.operator.datagrams import Datagrams
        return Datagrams(warn)
    except ImportError as error:
        if error.name != 'aioquic':
            raise
    LOG.info('where packets get lost video will wait for them: pip install '
             "'sph_stab_ros[datagrams]' mends that")
    return None


async def listen(server: 'OperatorServer', host: str, port: int | None,
                 tls: SSLContext | None) -> 'Listener':
    """Let the server listen; return where. OSError where it cannot."""
    if port is not None:
        return await server.start(host, port, tls)
    try:
        return await server.start(host, PORT, tls)
    except OSError as error:
        LOG.info('port %d is taken: %s', PORT, error.strerror)
        return await server.start(host, 0, tls)


def spin(robot: Node) -> None:
    """Serve the node until ROS ends."""
    executor = SingleThreadedExecutor()
    executor.add_node(robot)
    try:
        executor.spin()
    except ExternalShutdownException:
        pass


def address(host: str, port: int, encrypted: bool) -> str:
    """Return the URL to open in a browser, without the token."""
    if host in ('0.0.0.0', '::', ''):
        host = own_address()
    name = f'[{host}]' if ':' in host else host
    return f"http{'s' if encrypted else ''}://{name}:{port}/"
