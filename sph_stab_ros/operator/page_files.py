# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The page's files, and the answers to who asks for them."""

from collections.abc import Callable
from importlib import resources
from mimetypes import guess_type

from aiohttp import web

from sph_stab_ros.operator.access import Access, host_of

PAGE = 'index.html'
# Nothing from elsewhere, and nobody shows this page, or parts of it, within theirs.
HEADERS = {
    'Content-Security-Policy':
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob:; "
        "connect-src 'self' ws://{host} wss://{host}; base-uri 'none'; form-action 'none'; "
        "frame-ancestors 'none'",
    'Cross-Origin-Resource-Policy': 'same-origin',
    'X-Content-Type-Options': 'nosniff',
    # The address holds the token.
    'Referrer-Policy': 'no-referrer',
    'Cache-Control': 'no-cache',
}


def headers(host: str) -> dict[str, str]:
    """Return the headers of an answer to a request for a host."""
    # Whoever sends a strange host gets a policy that names none.
    name = host if all(c.isalnum() or c in '.:-[]' for c in host) else ''
    return {header: value.format(host=name) for header, value in HEADERS.items()}


def page_files() -> dict[str, tuple[bytes, str | None]]:
    """Return name -> (bytes, content type) of the page's files."""
    folder = resources.files('sph_stab_ros.operator') / 'page'
    return {path.name: (path.read_bytes(), guess_type(path.name)[0])
            for path in folder.iterdir() if path.is_file()}


class PageFiles:
    """
    Answers requests for files; see OperatorServer for ``access`` and ``warn``.

    Each request has to pass a check of Access first.
    """

    def __init__(self, access: Access, warn: Callable[[str, str], object]) -> None:
        self._access, self._warn = access, warn
        self._files = page_files()

    def offer(self, name: str, body: bytes, content_type: str) -> None:
        """Let one more file be fetched, without token."""
        self._files[name] = body, content_type

    def check(self, check: Callable[[web.Request], None], request: web.Request) -> None:
        """Let a check raise HTTPForbidden, with a line in the log."""
        try:
            check(request)
        except web.HTTPForbidden as refusal:
            self._warn('forbidden', f'{request.remote} refused: {(refusal.text or "").strip()}')
            raise

    async def get_page(self, request: web.Request) -> web.Response:
        """Answer with the page itself, which needs the token."""
        self.check(self._access.check_page, request)
        return self._file(PAGE)

    async def get_file(self, request: web.Request) -> web.Response:
        """Answer with one of the other files."""
        self.check(self._access.check_host, request)
        name = request.match_info['name']
        if name == PAGE:
            # It has an address of its own, and needs the token.
            raise web.HTTPNotFound
        return self._file(name)

    def _file(self, name: str) -> web.Response:
        if name not in self._files:
            raise web.HTTPNotFound
        body, content_type = self._files[name]
        return web.Response(body=body, content_type=content_type, charset='utf-8')


async def add_headers(request: web.Request, response: web.StreamResponse) -> None:
    """Give an answer the headers that all have."""
    response.headers.update(headers(host_of(request)))
    if not isinstance(response, web.WebSocketResponse):
        # Kept open, nobody could tell it from an idle one.
        response.force_close()
        # aiohttp has said what becomes of it before, if it is old.
        response.headers['Connection'] = 'close'
