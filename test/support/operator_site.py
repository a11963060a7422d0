# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""A server of the operator's page with a robot of straw, and browsers to talk to it."""

import asyncio
from contextlib import asynccontextmanager
from dataclasses import dataclass
import json
from pathlib import Path
from struct import unpack_from

import aiohttp
import cv2
import numpy as np
import pytest
from sph_stab_ros.operator.access import Access
from sph_stab_ros.operator.pairing import Picture
from sph_stab_ros.operator.recorder import Recorder
from sph_stab_ros.operator.robot_interface import RobotError
from sph_stab_ros.operator.server import OperatorServer

TIMEOUT_S = 20.
IDENTITY = (0., 0., 0., 1.)
# Nothing can be recorded there.
NOWHERE = Path('/proc/nowhere')
LOOK = json.dumps({'type': 'look', 'direction': IDENTITY})
# What no page sends.
BAD = [
    '', '{', 'null', '3', '[]', '"look"', '{}', '{"type": null}', '{"type": ["look"]}',
    '{"type": "shutdown"}', '{"type": "look"}', '{"type": "look", "direction": "up"}',
    '{"type": "look", "direction": [0, 0, 0]}', '{"type": "look", "direction": [0, 0, 0, 2]}',
    '{"type": "look", "direction": [NaN, 0, 0, 1]}',
    '{"type": "look", "direction": [0, 0, 0, 1e999]}',
    '{"type": "look", "direction": [0, 0, 0, true]}',
    '{"type": "look", "direction": [0, 0, 0, 1], "more": 1}',
    '{"type": "drawn", "sequence": -1}', '{"type": "drawn", "sequence": 1.5}',
    '{"type": "drawn", "sequence": 99999999999999999999}', '{"type": "drawn", "sequence": "1"}',
    '{"type": "set_mode", "mode": ""}', '{"type": "set_mode", "mode": 1}',
    '{"type": "level", "really": true}', '{"type": "record", "on": 1}', '{"type": "link"}',
    '{"type": "link", "drawn": NaN, "dropped": 0, "mbit_s": 0, "latency_ms": null, '
    '"latency_p95_ms": null, "round_trip_ms": null}', '[' * 1000,
]


def picture(stamp_ns, size=10):
    """Return a Picture without orientation."""
    return Picture(stamp_ns, b'\xff\xd8' + bytes(size), 0.)


def striped_jpeg(number=0, height=64):
    """Return a JPEG file of a sphere of stripes that move with a number."""
    rows, columns = np.mgrid[:height, :2 * height]
    stripes = 128 + 100 * np.sin((columns + 3 * number) / 5 + rows / 9)
    return cv2.imencode('.jpg', np.uint8(stripes))[1].tobytes()


@dataclass(frozen=True)
class StrawState:
    """What there is to tell of a robot of straw."""

    tracking: str = 'ok'


class StrawRobot:
    """Notes what it is asked for."""

    state = StrawState()

    def __init__(self):
        self.watched = self.needs_files = None
        self.looks = []
        self.watchers = []
        self.levelling = asyncio.Event()

    def watch(self, watched, needs_files):
        """Note whether somebody looks."""
        self.watched, self.needs_files = watched, needs_files

    def report(self, watchers):
        """Note who watches."""
        self.watchers = watchers

    def look(self, direction):
        """Note a look."""
        self.looks.append(direction)

    async def reset_heading(self):
        """Do as told."""
        return 'done'

    async def level(self):
        """Take a long time."""
        await self.levelling.wait()
        return 'level'

    async def set_mode(self, mode):
        """Refuse."""
        raise RobotError(f'no {mode}')


def frame(opcode, payload=b'', final=True):
    """Return a WebSocket frame of a browser; masked by zeros, which change nothing."""
    return bytes((0x80 * final | opcode, 0x80 | len(payload))) + bytes(4) + payload


class Browser:
    """The other end of a WebSocket, as the page is; ``data`` is that of the last picture."""

    def __init__(self, socket):
        self.socket, self.data = socket, b''

    async def receive(self, kind, condition=lambda message: True):
        """Return the next message of a kind, a dict, that meets a condition; skip others."""
        while True:
            message = await asyncio.wait_for(self.socket.receive(), TIMEOUT_S)
            assert message.type in (aiohttp.WSMsgType.TEXT, aiohttp.WSMsgType.BINARY), message
            if message.type is aiohttp.WSMsgType.TEXT:
                values = json.loads(message.data)
            else:
                length, = unpack_from('<I', message.data)
                self.data = message.data[4 + length:]
                values = {'type': 'picture', **json.loads(message.data[4:4 + length])}
            if values['type'] == kind and condition(values):
                return values

    async def control(self, value):
        """Wait until control is 'yours', 'taken' or 'free'."""
        await self.receive('state', lambda state: state['control'] == value)

    async def send(self, kind, **values):
        """Send a command."""
        await self.socket.send_str(json.dumps({'type': kind, **values}))

    async def closed(self):
        """Wait for the end; return the close code."""
        while not (await asyncio.wait_for(self.socket.receive(), TIMEOUT_S)).type in (
                aiohttp.WSMsgType.CLOSE, aiohttp.WSMsgType.CLOSED, aiohttp.WSMsgType.ERROR):
            pass
        return self.socket.close_code


class Site:
    """A server with a robot of straw, and ways to it."""

    def __init__(self, server, robot, port, session, warnings):
        self.server, self.robot, self.port = server, robot, port
        self.session, self.warnings = session, warnings
        self.url = f'http://127.0.0.1:{port}'
        # A TLS context of a browser, where it is needed.
        self.trusted = None

    async def bare_socket(self):
        """Open a WebSocket of which every byte is ours; return reader and writer."""
        reader, writer = await asyncio.open_connection('127.0.0.1', self.port, limit=1)
        writer.write((
            f'GET /socket HTTP/1.1\r\nHost: 127.0.0.1:{self.port}\r\nOrigin: {self.url}\r\n'
            'Connection: Upgrade\r\nUpgrade: websocket\r\nSec-WebSocket-Version: 13\r\n'
            'Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n\r\n').encode())
        return reader, writer

    async def status(self, path, **headers):
        """Return the status of an answer."""
        async with self.session.get(
                self.url + path, headers=headers, ssl=self.trusted or True) as answer:
            return answer.status

    async def connect(self, query='', **headers):
        """Open a WebSocket as the page does."""
        return Browser(await self.session.ws_connect(
            f'{self.url}/socket{query}', headers={'Origin': self.url, **headers},
            ssl=self.trusted or True))

    async def refusal(self, query='', **headers):
        """Return the status with which a WebSocket is refused."""
        with pytest.raises(aiohttp.WSServerHandshakeError) as refused:
            await self.connect(query, **headers)
        return refused.value.status


@asynccontextmanager
async def site(token=None, tls=None, host='127.0.0.1', recordings=NOWHERE, **options):
    """Serve on a free port."""
    robot, warnings = StrawRobot(), []

    def warn(kind, text):
        warnings.append(text)

    server = OperatorServer(robot, Access(host, token), Recorder(recordings, warn), warn,
                            **options)
    listener = await server.start(host, 0, tls)
    try:
        async with aiohttp.ClientSession() as session:
            yield Site(server, robot, listener.addresses[0][1], session, warnings)
    finally:
        await listener.cleanup()


def served(**options):
    """Run a test, a coroutine function of a Site, in an event loop."""
    def decorate(test):
        def run():
            async def with_site():
                async with site(**options) as one:
                    await asyncio.wait_for(test(one), 2 * TIMEOUT_S)
            asyncio.run(with_site())
        run.__name__ = test.__name__
        return run
    return decorate


async def next_picture(site, browser, stamp_ns):
    """Show a picture; return its message when the browser has it and has said so."""
    site.server.show(picture(stamp_ns))
    received = await browser.receive('picture')
    assert int(received['stamp_ns']) == stamp_ns
    await browser.send('drawn', sequence=received['sequence'])
    return received
