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
import logging
from ssl import SSLContext
from time import monotonic, time
from typing import Any, TYPE_CHECKING

from aiohttp import web, WSCloseCode

from sph_stab_ros.operator.access import Access, ConnectionGuard, ServerLog
from sph_stab_ros.operator.browser_socket import BrowserSocket, CLOSING_S
from sph_stab_ros.operator.client import Client
from sph_stab_ros.operator.listening import Listener
from sph_stab_ros.operator.page_files import add_headers, PageFiles
from sph_stab_ros.operator.pairing import Picture
from sph_stab_ros.operator.protocol import (
    Arrived, Command, Drawn, Echo, Level, Link, Look, MAX_MESSAGE_BYTES, NeedKey, parse_command,
    ProtocolError, Record, ResetHeading, SetMode, Skipped, TakeControl, text_message)
from sph_stab_ros.operator.recorder import Recorder
from sph_stab_ros.operator.robot_interface import OperatedRobot, RobotError, Watcher

if TYPE_CHECKING:
    from sph_stab_ros.operator.datagrams import Datagrams
    from sph_stab_ros.operator.video import Video

MAX_CLIENTS = 5
STATE_PERIOD_S = 0.2
# As diagnostics come.
REPORT_PERIOD_S = 1.0
NOT_IN_CONTROL = 'Another operator has control: take it first.'


class OperatorServer:
    """
    Serves the page, and lets one of its users at a time steer.

    All methods are for the event loop's thread.

    Parameters
    ----------
    robot, access, recorder
        Whom it steers, who may, and what writes what is seen.
    warn
        Logs a text; the kind of event comes before it, so that a flood can be held back.
    video
        Where there is one, for browsers that take it in place of files.
    datagrams
        Where there are any, another way for video, which is always encrypted.

    """

    def __init__(self, robot: OperatedRobot, access: Access, recorder: Recorder,
                 warn: Callable[[str, str], object], max_clients: int = MAX_CLIENTS,
                 video: 'Video | None' = None, datagrams: 'Datagrams | None' = None) -> None:
        self._robot = robot
        self._recorder = recorder
        self._access = access
        self._warn = warn
        self._max_clients = max_clients
        self._video, self._datagrams = video, datagrams
        self.files = PageFiles(access, warn)
        self._guard = ConnectionGuard()
        self._browsers: dict[Client, BrowserSocket] = {}
        self._in_control: Client | None = None
        self._picture_count = 0
        self._tasks: set[asyncio.Task[None]] = set()

    async def start(self, host: str, port: int, tls: SSLContext | None = None) -> Listener:
        """Listen, encrypted where there is a context for it; return the Listener."""
        app = web.Application(client_max_size=MAX_MESSAGE_BYTES)
        app.router.add_get('/', self.files.get_page)
        app.router.add_get('/socket', self._get_socket)
        app.router.add_get('/{name}', self.files.get_file)
        app.on_response_prepare.append(add_headers)
        app.on_shutdown.append(self._close_all)
        # Its log of requests would show the token.
        runner = web.AppRunner(app, access_log=None, shutdown_timeout=CLOSING_S,
                               logger=ServerLog(logging.getLogger(__name__), self._warn))
        listener = await Listener.start(
            runner, host, port, tls,
            lambda name: self._warn('dropped', f'{name} dropped: too much data'))
        if self._datagrams:
            try:
                await self._datagrams.start(listener.addresses, self._obey)
            except OSError as error:
                self._warn('datagrams', f'video goes without datagrams: {error.strerror}')
                self._datagrams = None
        self._run(self._tell_state(listener))
        return listener

    def show(self, picture: Picture) -> None:
        """Send a Picture to all browsers that are ready for it."""
        self._picture_count += 1
        if picture.data:
            self._recorder.take(picture)
        for client in self._browsers:
            if picture.data and not client.video:
                client.flow.offer(self._picture_count, picture)
        if self._video:
            self._video.offer(self._picture_count, picture)
        self._tell_robot()

    def _run(self, coroutine: Coroutine[Any, Any, None]) -> asyncio.Task[None]:
        """Start a task, and keep it alive until it ends."""
        task = asyncio.create_task(coroutine)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)
        return task

    async def _get_socket(self, request: web.Request) -> web.WebSocketResponse:
        self.files.check(self._access.check_socket, request)
        self._guard.let_stay(request)
        client = Client(request.remote, request.query.get('page', ''),
                        self._video is not None and request.query.get('video') == 'h264')
        socket = BrowserSocket(client.may_speak)
        response = await socket.accept(request)
        former = self._former(client)
        if former:
            self._browsers.pop(former).abort()
        if len(self._browsers) >= self._max_clients:
            self._warn('full', f'{request.remote} refused: {self._max_clients} browsers are here')
            await socket.close(WSCloseCode.TRY_AGAIN_LATER, 'full')
            return response
        self._browsers[client] = socket
        if self._in_control in (None, former):
            self._in_control = client
        await self._serve(socket, client)
        return response

    def _former(self, client: Client) -> Client | None:
        """Return who this one was before its connection went silent; the page names itself."""
        return next((other for other in self._browsers if other.page and
                     other.page == client.page), None)

    # One browser.

    async def _serve(self, socket: BrowserSocket, client: Client) -> None:
        """Talk to a browser until it goes, or has to."""
        if self._video and client.video:
            self._video.add(client.video)
        if self._datagrams and client.video:
            client.offer_text('datagrams', text_message(
                'datagrams', **self._datagrams.invite(client)))
        self._tell_all()
        tasks = self._run(self._send(socket, client)), self._run(self._watch(socket, client))
        try:
            async for text in socket.texts():
                self._obey(client, parse_command(text))
        except ConnectionError:
            # It went while it was being answered.
            pass
        except ProtocolError as error:
            self._warn('dropped', f'{client.name} dropped: {error}')
            await socket.close(WSCloseCode.POLICY_VIOLATION, str(error))
        finally:
            for task in tasks:
                task.cancel()
            if self._video and client.video:
                self._video.remove(client.video)
            if self._datagrams:
                self._datagrams.dismiss(client)
            self._browsers.pop(client, None)
            if self._in_control is client:
                self._in_control = None
            self._tell_all()

    async def _send(self, socket: BrowserSocket, client: Client) -> None:
        try:
            async for message in client.messages():
                await socket.send(message)
        except ConnectionError:
            pass

    async def _watch(self, socket: BrowserSocket, client: Client) -> None:
        """Cut the connection of a browser that does not read what it is sent."""
        with suppress(ConnectionError):
            await socket.wait_for_silence()
            self._warn('silent', f'{client.name} dropped: no answer')
            socket.abort()

    def _obey(self, client: Client, command: Command) -> None:
        if isinstance(command, Arrived):
            client.arrived(command.sequence, command.newest)
        elif isinstance(command, Skipped):
            client.skipped(command.sequence)
        elif isinstance(command, Drawn):
            client.drawn(command.sequence)
        elif isinstance(command, NeedKey):
            if self._video and client.video:
                self._video.failed(client.video)
        elif isinstance(command, Echo):
            client.offer_text('echo', text_message(
                'echo', sent_ms=command.sent_ms, server_ms=1e3 * time()))
        elif isinstance(command, Link):
            client.link = command
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
            elif isinstance(command, Record):
                answer = await self._recorder.record(command.on)
            self._tell(client, answer, ok=True, done=type(command).__name__)
        except RobotError as error:
            self._tell(client, str(error), ok=False)
        finally:
            client.busy = False
            self._tell_all()

    def _tell(self, client: Client, text: str, **values: Any) -> None:
        client.offer_text('notice', text_message('notice', text=text, **values))

    # All browsers.

    def _tell_robot(self) -> None:
        """Tell the robot what is wanted of it."""
        # A recording goes on also when nobody is left.
        is_recording = bool(self._recorder.name)
        self._robot.watch(bool(self._browsers) or is_recording, is_recording or any(
            not client.video for client in self._browsers) or bool(
            self._video and self._video.needs_files))

    def _tell_all(self) -> None:
        """Tell everybody how things are."""
        self._tell_robot()
        robot = asdict(self._robot.state)
        for client in self._browsers:
            rate_hz, latency_s = client.rate_and_latency()
            control = 'yours' if self._in_control is client else (
                'taken' if self._in_control else 'free')
            client.offer_text('state', text_message(
                'state', robot=robot, control=control, browsers=len(self._browsers),
                can_video=self._video is not None, recording=self._recorder.name,
                rate_hz=round(rate_hz, 1),
                latency_ms=None if latency_s is None else round(1e3 * latency_s)))

    async def _tell_state(self, listener: Listener) -> None:
        report_s = 0.
        while True:
            self._tell_all()
            if failure := self._recorder.pop_failure():
                for client in self._browsers:
                    self._tell(client, failure, ok=False)
            if monotonic() >= report_s:
                report_s = monotonic() + REPORT_PERIOD_S
                self._robot.report([
                    Watcher(str(client.name), self._in_control is client, client.link)
                    for client in self._browsers])
            if closed := self._guard.close_idle(listener.connections):
                self._warn('idle', f'{closed} connections closed that led to nothing')
            await asyncio.sleep(STATE_PERIOD_S)

    async def _close_all(self, app: web.Application) -> None:
        self._recorder.close()
        if self._video:
            self._video.close()
            self._video = None
        if self._datagrams:
            self._datagrams.close()
        for task in tuple(self._tasks):
            task.cancel()
        await asyncio.gather(*(
            socket.close(WSCloseCode.GOING_AWAY) for socket in tuple(self._browsers.values())))
