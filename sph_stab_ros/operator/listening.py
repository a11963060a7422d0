# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""
Connections from strangers: how much each may say, and where they come in.

Rates of messages are counted where messages are known (``browser_socket``). Before that, in a
header, a handshake or a message that never ends, only bytes can be counted.
"""

import asyncio
from collections.abc import Callable
from ssl import SSLContext
from time import monotonic
from typing import Any

from aiohttp import web

# A page that looks around at 120 Hz sends a quarter of it; the burst is what gathers while this
# process stands still for some seconds.
BYTES_PER_S = 100e3
BURST_BYTES = 400e3
# Until then a connection has to be encrypted, where it is to be.
HANDSHAKE_S = 5.0


class Allowance:
    """So much per second, and so much at once after a while of silence."""

    def __init__(self, per_s: float, burst: float,
                 clock: Callable[[], float] = monotonic) -> None:
        self._per_s, self._burst, self._clock = per_s, burst, clock
        self._credit, self._credit_s = burst, clock()

    def take(self, amount: float = 1.) -> bool:
        """Tell whether so much more is within the allowance."""
        now_s = self._clock()
        self._credit = min(
            self._burst, self._credit + self._per_s * (now_s - self._credit_s)) - amount
        self._credit_s = now_s
        return self._credit >= 0


class MeteredConnection(asyncio.Protocol):
    """Passes a connection on to another protocol, and ends it when more comes than is allowed."""

    def __init__(self, inner: asyncio.Protocol, excessive: Callable[[str], object]) -> None:
        self._inner = inner
        self._excessive = excessive
        self._allowance = Allowance(BYTES_PER_S, BURST_BYTES)

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Begin."""
        assert isinstance(transport, asyncio.Transport)
        self._transport = transport
        self._inner.connection_made(transport)

    def data_received(self, data: bytes) -> None:
        """Pass data on as long as they are not too many."""
        if self._transport.is_closing():
            return
        if self._allowance.take(len(data)):
            self._inner.data_received(data)
        else:
            self._excessive(str((self._transport.get_extra_info('peername') or ['?'])[0]))
            self._transport.abort()

    def eof_received(self) -> bool | None:
        """Pass it on."""
        return self._inner.eof_received()

    def connection_lost(self, exc: Exception | None) -> None:
        """Pass it on."""
        self._inner.connection_lost(exc)

    def pause_writing(self) -> None:
        """Pass it on."""
        self._inner.pause_writing()

    def resume_writing(self) -> None:
        """Pass it on."""
        self._inner.resume_writing()


class Listener:
    """A web application on a port; its connections are metered."""

    def __init__(self, runner: web.AppRunner, sockets: asyncio.Server) -> None:
        self._runner, self._sockets = runner, sockets

    @classmethod
    async def start(cls, runner: web.AppRunner, host: str, port: int, tls: SSLContext | None,
                    excessive: Callable[[str], object]) -> 'Listener':
        """Listen; OSError where that cannot be. ``excessive`` is told who sends too much."""
        await runner.setup()
        handlers = runner.server
        assert handlers is not None
        return cls(runner, await asyncio.get_running_loop().create_server(
            lambda: MeteredConnection(handlers(), excessive), host, port, ssl=tls,
            ssl_handshake_timeout=HANDSHAKE_S if tls else None))

    @property
    def addresses(self) -> list[Any]:
        """Return where it listens, as the system names it."""
        return [socket.getsockname() for socket in self._sockets.sockets]

    @property
    def connections(self) -> list[web.RequestHandler]:
        """Return the connections that are open."""
        assert self._runner.server is not None
        return self._runner.server.connections

    async def cleanup(self) -> None:
        """End listening, and all connections."""
        self._sockets.close()
        await self._runner.cleanup()
