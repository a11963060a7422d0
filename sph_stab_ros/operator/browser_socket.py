# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""A WebSocket to a browser of which every frame counts, and whose other end has to read."""

import asyncio
from collections.abc import AsyncIterator, Callable
from contextlib import suppress
import secrets
import socket

from aiohttp import web, WSMsgType

from sph_stab_ros.operator.protocol import MAX_MESSAGE_BYTES, ProtocolError

# A browser is asked so often whether it is there, and has as much time to answer.
HEARTBEAT_S = 5.0
# One that is told to go need not answer.
CLOSING_S = 1.0
QUESTION_BYTES = 8
# Of Linux, some since 6.15 only and not yet in Python. A radio that loses packets is not a crowded
# one (BBR); what is lost is sent again soon, and after an outage within a second.
TCP_RTO_MAX_MS, TCP_RTO_MIN_US = 44, 45
TCP_OPTIONS: tuple[tuple[int, int | bytes], ...] = (
    (socket.TCP_CONGESTION, b'bbr'), (TCP_RTO_MIN_US, 50_000), (TCP_RTO_MAX_MS, 1000))


def prepare_for_loss(request: web.Request) -> None:
    """Let the connection lose packets without slowing down, as far as this system can."""
    connection = request.get_extra_info('socket')
    for option, value in TCP_OPTIONS:
        # Systems differ in what they know and what they allow.
        with suppress(OSError):
            connection.setsockopt(socket.IPPROTO_TCP, option, value)


class BrowserSocket:
    """
    Talks to one browser.

    aiohttp would answer pings without end, and take any pong for an answer. Here pings and pongs
    are messages as others are, and only those who read what they are sent can answer.

    Parameters
    ----------
    may_speak
        Tells, for each message that comes, whether it may.

    """

    def __init__(self, may_speak: Callable[[], bool]) -> None:
        self._may_speak = may_speak
        # The limit is what aiohttp refuses, not what it takes.
        self._socket = web.WebSocketResponse(
            max_msg_size=MAX_MESSAGE_BYTES + 1, compress=False, autoping=False)
        self._question = b''
        self._answered = asyncio.Event()
        self._transport: asyncio.Transport | None = None

    async def accept(self, request: web.Request) -> web.WebSocketResponse:
        """Accept a request; return the answer to it."""
        self._transport = request.transport
        prepare_for_loss(request)
        await self._socket.prepare(request)
        return self._socket

    async def texts(self) -> AsyncIterator[str]:
        """Yield what comes until the end; ProtocolError for what no browser of ours sends."""
        async for message in self._socket:
            if message.type is WSMsgType.ERROR:
                raise ProtocolError(str(message.data))
            if not self._may_speak():
                raise ProtocolError('too many messages')
            if message.type is WSMsgType.PING:
                await self._socket.pong(message.data)
            elif message.type is WSMsgType.PONG:
                if secrets.compare_digest(bytes(message.data), self._question):
                    self._answered.set()
            elif message.type is WSMsgType.TEXT:
                yield message.data
            else:
                raise ProtocolError('not a text')

    async def send(self, message: str | bytes) -> None:
        """Send a text or a binary message."""
        if isinstance(message, str):
            await self._socket.send_str(message)
        else:
            await self._socket.send_bytes(message)

    async def wait_for_silence(self) -> None:
        """Return when the browser has not answered for HEARTBEAT_S."""
        with suppress(asyncio.TimeoutError):
            while True:
                await asyncio.wait_for(self._ask(), HEARTBEAT_S)
                await asyncio.sleep(HEARTBEAT_S)

    async def _ask(self) -> None:
        self._question = secrets.token_bytes(QUESTION_BYTES)
        self._answered.clear()
        await self._socket.ping(self._question)
        await self._answered.wait()

    async def close(self, code: int, text: str = '') -> None:
        """Say goodbye; cut the connection where that is not heard."""
        try:
            await asyncio.wait_for(
                self._socket.close(code=code, message=text.encode()), CLOSING_S)
        except asyncio.TimeoutError:
            self.abort()

    def abort(self) -> None:
        """Cut the connection."""
        if self._transport:
            self._transport.abort()
