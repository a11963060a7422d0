# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Who may talk to the server: by token, by the page that they come from, a few at a time."""

from collections.abc import Callable, Collection
from ipaddress import ip_address
from logging import Logger, LoggerAdapter
import secrets
from time import monotonic
from typing import Any
from urllib.parse import urlsplit

from aiohttp import web
from aiohttp.http_exceptions import HttpProcessingError

TOKEN_BYTES = 16
# Five browsers open a handful of connections each while the page loads.
MAX_CONNECTIONS = 64
# A connection that has not become a socket's by then is closed: files take no time.
PATIENCE_S = 5.0


class Access:
    """
    Decides about requests.

    Parameters
    ----------
    host
        Where the server listens. On loopback only local names are served: a page of another site
        that lets its own name point here (DNS rebinding) is refused.
    token
        What a request for the page or its socket has to carry, if anything.

    """

    def __init__(self, host: str, token: str | None = None) -> None:
        self._local_only = is_loopback(host)
        if not (token or self._local_only):
            raise ValueError('a token is needed where others can connect')
        self.token = token

    def check_host(self, request: web.Request) -> None:
        """Raise HTTPForbidden where the request is not meant for this machine."""
        host = host_of(request)
        if self._local_only and not is_loopback(name_of(host)):
            raise web.HTTPForbidden(text=f"{host!r} is no name of this machine's own.\n")

    def check_page(self, request: web.Request) -> None:
        """Raise HTTPForbidden unless the request may have the page."""
        self.check_host(request)
        if self.token and not secrets.compare_digest(
                request.query.get('token', '').encode(), self.token.encode()):
            raise web.HTTPForbidden(
                text='The token in the address is missing or wrong: use the address that the '
                     'operator command has printed.\n')

    def check_socket(self, request: web.Request) -> None:
        """Raise HTTPForbidden unless a WebSocket is asked for by our own page."""
        self.check_page(request)
        origin = request.headers.get('Origin', '')
        # Without encryption of our own a proxy may have added some.
        schemes = ('https',) if request.secure else ('http', 'https')
        if origin not in [f'{scheme}://{host_of(request)}' for scheme in schemes]:
            raise web.HTTPForbidden(text=f"the page of {origin!r} is none of this server's\n")


class ConnectionGuard:
    """Closes connections that do not become sockets, and those that are too many."""

    def __init__(self, clock: Callable[[], float] = monotonic) -> None:
        self._clock = clock
        # When each connection was first seen.
        self._waiting_s: dict[web.RequestHandler, float] = {}
        self._sockets: set[web.RequestHandler] = set()
        # With encryption they last a while.
        self._closed: set[web.RequestHandler] = set()

    def let_stay(self, request: web.Request) -> None:
        """Let the connection of a request be, which becomes a socket's."""
        self._sockets.add(request.protocol)

    def close_idle(self, connections: Collection[web.RequestHandler]) -> int:
        """Close the connections of an aiohttp server that are in the way; return how many."""
        now_s = self._clock()
        self._sockets.intersection_update(connections)
        self._closed.intersection_update(connections)
        self._waiting_s = {
            connection: self._waiting_s.get(connection, now_s) for connection in connections
            if connection not in self._sockets and connection not in self._closed}
        excess = max(0, len(connections) - len(self._closed) - MAX_CONNECTIONS)
        oldest_first = sorted(self._waiting_s, key=self._waiting_s.__getitem__)
        closed = [connection for n, connection in enumerate(oldest_first)
                  if n < excess or self._waiting_s[connection] <= now_s - PATIENCE_S]
        for connection in closed:
            connection.force_close()
        self._closed.update(closed)
        return len(closed)


# It takes the type from Python 3.11 on only.
class ServerLog(LoggerAdapter):  # type: ignore[type-arg]
    """The log of an aiohttp server, which takes what is no HTTP for an error with traceback."""

    def __init__(self, logger: Logger, warn: Callable[[str, str], object]) -> None:
        super().__init__(logger, {})
        self._warn = warn

    def exception(self, msg: object, *args: object, exc_info: Any = True,
                  **kwargs: Any) -> None:
        """Log an error; in one line if it is the other end's."""
        if isinstance(exc_info, HttpProcessingError):
            self._warn('no HTTP', f'a request refused: {exc_info.message.splitlines()[0]}')
        else:
            super().exception(msg, *args, exc_info=exc_info, **kwargs)


def host_of(request: web.Request) -> str:
    """Return the host that a request names, '' where it names none."""
    # aiohttp's own ``host`` looks for a name where there is none, in the event loop if it is old.
    return request.headers.get('Host', '')


def name_of(host: str) -> str:
    """Return the name in a host of a request, without the port; '' where it is none."""
    try:
        return urlsplit(f'//{host}').hostname or ''
    except ValueError:
        return ''


def is_loopback(host: str) -> bool:
    """Tell whether only this machine itself can connect to a host."""
    try:
        return ip_address(host).is_loopback
    except ValueError:
        return host.lower() == 'localhost'


def new_token() -> str:
    """Return a token that cannot be guessed."""
    return secrets.token_urlsafe(TOKEN_BYTES)
