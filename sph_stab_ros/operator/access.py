# Copyright 2026 The sph_stab_ros developers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""Who may talk to the server: by token, by the page that they come from, a few at a time."""

from ipaddress import ip_address
import secrets
from time import monotonic
from urllib.parse import urlsplit

from aiohttp import web

TOKEN_BYTES = 16
# Five browsers open a handful of connections each while the page loads.
MAX_CONNECTIONS = 64
# A connection that has not asked for anything by then is closed.
FIRST_REQUEST_S = 5.0


class Access:
    """
    Decides about requests.

    Parameters
    ----------
    host : str
        Where the server listens. On loopback only local names are served: a page of another site
        that lets its own name point here (DNS rebinding) is refused.
    token : str or None
        What a request for the page or its socket has to carry, if anything.

    """

    def __init__(self, host, token=None):
        self._local_only = is_loopback(host)
        if not (token or self._local_only):
            raise ValueError('a token is needed where others can connect')
        self.token = token

    def check_page(self, request):
        """Raise HTTPForbidden unless the request may have the page."""
        if self._local_only and not is_loopback(urlsplit(f'//{request.host}').hostname or ''):
            raise web.HTTPForbidden(text=f"'{request.host}' is no name of this machine's own.\n")
        if self.token and not secrets.compare_digest(
                request.query.get('token', '').encode(), self.token.encode()):
            raise web.HTTPForbidden(
                text='The token in the address is missing or wrong: use the address that the '
                     'operator command has printed.\n')

    def check_socket(self, request):
        """Raise HTTPForbidden unless a WebSocket is asked for by our own page."""
        self.check_page(request)
        origin = request.headers.get('Origin', '')
        if urlsplit(origin).netloc != request.host:
            raise web.HTTPForbidden(text=f"the page of '{origin}' is none of this server's\n")


class ConnectionGuard:
    """Closes connections that ask for nothing, and those that are too many."""

    def __init__(self, clock=monotonic):
        self._clock = clock
        # connection -> when it was first seen to be waiting.
        self._waiting_s = {}
        self._asked = set()

    def note(self, request):
        """Note that a connection has asked for something."""
        self._asked.add(request.protocol)

    def close_idle(self, connections):
        """Close the RequestHandlers of an aiohttp server that are in the way; return how many."""
        now_s = self._clock()
        self._asked.intersection_update(connections)
        self._waiting_s = {one: self._waiting_s.get(one, now_s)
                           for one in connections if one not in self._asked}
        excess = max(0, len(connections) - MAX_CONNECTIONS)
        oldest_first = sorted(self._waiting_s, key=self._waiting_s.get)
        closed = [one for n, one in enumerate(oldest_first)
                  if n < excess or self._waiting_s[one] <= now_s - FIRST_REQUEST_S]
        for one in closed:
            one.force_close()
        return len(closed)


def is_loopback(host):
    """Tell whether only this machine itself can connect to a host."""
    try:
        return ip_address(host).is_loopback
    except ValueError:
        return host.lower() == 'localhost'


def new_token():
    """Return a token that cannot be guessed."""
    return secrets.token_urlsafe(TOKEN_BYTES)
