# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The web server: the page and its files, and a WebSocket for each browser."""

import asyncio
from collections.abc import Callable, Coroutine
from contextlib import suppress
from dataclasses import asdict
from importlib import resources
import logging
from mimetypes import guess_type
from typing import Any
from weakref import WeakSet

from aiohttp import web, WSCloseCode, WSMsgType

from sph_stab_ros.operator.access import Access, ConnectionGuard, ServerLog
from sph_stab_ros.operator.client import Client
from sph_stab_ros.operator.operated_robot import OperatedRobot, RobotError
from sph_stab_ros.operator.pairing import Picture
from sph_stab_ros.operator.protocol import (
    Command, Drawn, Level, Look, MAX_MESSAGE_BYTES, parse_command, ProtocolError, ResetHeading,
    SetMode, TakeControl, text_message)

MAX_CLIENTS = 5
STATE_PERIOD_S = 0.2
# A browser that does not answer in this time is gone.
HEARTBEAT_S = 5.0
# One that is told to go need not answer.
CLOSING_S = 1.0
PAGE = 'index.html'
# Nothing from elsewhere, and nobody shows this page within theirs.
HEADERS = {
    'Content-Security-Policy':
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob:; "
        "connect-src 'self' ws://{host} wss://{host}; base-uri 'none'; form-action 'none'; "
        "frame-ancestors 'none'",
    'X-Content-Type-Options': 'nosniff',
    # The address holds the token.
    'Referrer-Policy': 'no-referrer',
    'Cache-Control': 'no-cache',
}
NOT_IN_CONTROL = 'Another operator has control: take it first.'


class OperatorServer:
    """
    Serves the page, and lets one of its users at a time steer.

    All methods are for the event loop's thread.

    Parameters
    ----------
    robot, access
        Whom it steers, and who may.
    warn
        Logs a text; the kind of event comes before it, so that a flood can be held back.

    """

    def __init__(self, robot: OperatedRobot, access: Access, warn: Callable[[str, str], object],
                 max_clients: int = MAX_CLIENTS) -> None:
        self._robot = robot
        self._access = access
        self._warn = warn
        self._max_clients = max_clients
        self._files = page_files()
        self._guard = ConnectionGuard()
        self._sockets: WeakSet[web.WebSocketResponse] = WeakSet()
        self._clients: list[Client] = []
        self._in_control: Client | None = None
        self._picture_count = 0
        self._tasks: set[asyncio.Task[None]] = set()

    async def start(self, host: str, port: int) -> web.AppRunner:
        """Listen; return the aiohttp runner, whose ``addresses`` tell where."""
        app = web.Application(client_max_size=MAX_MESSAGE_BYTES)
        app.router.add_get('/', self._get_page)
        app.router.add_get('/socket', self._get_socket)
        app.router.add_get('/{name}', self._get_file)
        app.on_response_prepare.append(self._add_headers)
        app.on_shutdown.append(self._close_all)
        # Its log of requests would show the token.
        runner = web.AppRunner(app, access_log=None, shutdown_timeout=CLOSING_S,
                               logger=ServerLog(logging.getLogger(__name__), self._warn))
        await runner.setup()
        await web.TCPSite(runner, host, port).start()
        assert runner.server is not None
        self._run(self._tell_state(runner.server))
        return runner

    def show(self, picture: Picture) -> None:
        """Send a Picture to all browsers that are ready for it."""
        self._picture_count += 1
        for client in self._clients:
            client.offer_picture(self._picture_count, picture)

    def _run(self, coroutine: Coroutine[Any, Any, None]) -> asyncio.Task[None]:
        """Start a task, and keep it alive until it ends."""
        task = asyncio.create_task(coroutine)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)
        return task

    # Requests.

    async def _get_page(self, request: web.Request) -> web.Response:
        self._check(self._access.check_page, request)
        return self._file(PAGE)

    async def _get_file(self, request: web.Request) -> web.Response:
        return self._file(request.match_info['name'])

    def _check(self, check: Callable[[web.Request], None], request: web.Request) -> None:
        """Let a check raise HTTPForbidden, with a line in the log."""
        try:
            check(request)
        except web.HTTPForbidden as refusal:
            self._warn('forbidden', f'{request.remote} refused: {(refusal.text or "").strip()}')
            raise

    def _file(self, name: str) -> web.Response:
        if name not in self._files:
            raise web.HTTPNotFound
        body, content_type = self._files[name]
        return web.Response(body=body, content_type=content_type, charset='utf-8')

    async def _add_headers(self, request: web.Request, response: web.StreamResponse) -> None:
        # Whoever sends a strange host gets a policy that names none.
        host = request.host if all(c.isalnum() or c in '.:-[]' for c in request.host) else ''
        for name, value in HEADERS.items():
            response.headers[name] = value.format(host=host)
        if not isinstance(response, web.WebSocketResponse):
            # Kept open, nobody could tell it from an idle one.
            response.force_close()

    async def _get_socket(self, request: web.Request) -> web.WebSocketResponse:
        self._check(self._access.check_socket, request)
        self._guard.let_stay(request)
        socket = web.WebSocketResponse(
            heartbeat=HEARTBEAT_S, max_msg_size=MAX_MESSAGE_BYTES,
            compress=False)
        self._sockets.add(socket)
        await socket.prepare(request)
        if len(self._clients) >= self._max_clients:
            self._warn('full', f'{request.remote} refused: {self._max_clients} browsers are here')
            await close(socket, WSCloseCode.TRY_AGAIN_LATER, 'full')
            return socket
        await self._serve(socket, Client(request.remote))
        return socket

    # One browser.

    async def _serve(self, socket: web.WebSocketResponse, client: Client) -> None:
        """Talk to a browser until it goes, or has to."""
        self._clients.append(client)
        if self._in_control is None:
            self._in_control = client
        self._robot.watch(True)
        self._tell_all()
        sender = self._run(self._send(socket, client))
        try:
            await self._listen(socket, client)
        except ProtocolError as error:
            self._warn('dropped', f'{client.name} dropped: {error}')
            sender.cancel()
            await close(socket, WSCloseCode.POLICY_VIOLATION, str(error))
        finally:
            sender.cancel()
            self._clients.remove(client)
            if self._in_control is client:
                self._in_control = None
            self._robot.watch(bool(self._clients))
            self._tell_all()

    async def _send(self, socket: web.WebSocketResponse, client: Client) -> None:
        try:
            async for message in client.messages():
                if isinstance(message, str):
                    await socket.send_str(message)
                else:
                    await socket.send_bytes(message)
        except ConnectionError:
            pass

    async def _listen(self, socket: web.WebSocketResponse, client: Client) -> None:
        async for message in socket:
            if message.type is not WSMsgType.TEXT:
                raise ProtocolError('not a text')
            if not client.may_speak():
                raise ProtocolError('too many messages')
            self._obey(client, parse_command(message.data))
        if socket.exception():
            self._warn('dropped', f'{client.name} dropped: {socket.exception()}')

    def _obey(self, client: Client, command: Command) -> None:
        if isinstance(command, Drawn):
            client.drawn(command.sequence)
        elif isinstance(command, TakeControl):
            self._in_control = client
            self._tell_all()
        elif self._in_control is not client:
            # Looks are on their way when control goes over; that is no reason for words.
            if not isinstance(command, Look):
                self._tell(client, NOT_IN_CONTROL, ok=False)
        elif isinstance(command, Look):
            self._robot.look(command.direction)
        elif client.busy:
            self._tell(client, 'The last request is still on its way.', ok=False)
        else:
            client.busy = True
            self._run(self._act(client, command))

    async def _act(self, client: Client, command: Command) -> None:
        """Let the robot do what was asked for, and tell how that went."""
        try:
            if isinstance(command, ResetHeading):
                answer = await self._robot.reset_heading()
            elif isinstance(command, Level):
                answer = await self._robot.level()
            elif isinstance(command, SetMode):
                answer = await self._robot.set_mode(command.mode)
            self._tell(client, answer, ok=True, done=type(command).__name__)
        except RobotError as error:
            self._tell(client, str(error), ok=False)
        finally:
            client.busy = False
            self._tell_all()

    def _tell(self, client: Client, text: str, **values: Any) -> None:
        client.offer_text('notice', text_message('notice', text=text, **values))

    # All browsers.

    def _tell_all(self) -> None:
        """Tell everybody how things are."""
        robot = asdict(self._robot.state)
        for client in self._clients:
            rate_hz, latency_s = client.rate_and_latency()
            control = 'yours' if self._in_control is client else (
                'taken' if self._in_control else 'free')
            client.offer_text('state', text_message(
                'state', robot=robot, control=control, browsers=len(self._clients),
                rate_hz=round(rate_hz, 1),
                latency_ms=None if latency_s is None else round(1e3 * latency_s)))

    async def _tell_state(self, server: web.Server) -> None:
        while True:
            self._tell_all()
            if closed := self._guard.close_idle(server.connections):
                self._warn('idle', f'{closed} connections closed that led to nothing')
            await asyncio.sleep(STATE_PERIOD_S)

    async def _close_all(self, app: web.Application) -> None:
        for task in tuple(self._tasks):
            task.cancel()
        await asyncio.gather(*(
            close(socket, WSCloseCode.GOING_AWAY) for socket in tuple(self._sockets)))


async def close(socket: web.WebSocketResponse, code: int, text: str = '') -> None:
    """Close a WebSocket, whose other end may not even read."""
    with suppress(asyncio.TimeoutError):
        await asyncio.wait_for(socket.close(code=code, message=text.encode()), CLOSING_S)


def page_files() -> dict[str, tuple[bytes, str | None]]:
    """Return name -> (bytes, content type) of the page's files."""
    folder = resources.files('sph_stab_ros.operator') / 'page'
    return {path.name: (path.read_bytes(), guess_type(path.name)[0])
            for path in folder.iterdir() if path.is_file()}
