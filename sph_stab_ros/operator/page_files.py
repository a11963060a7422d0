# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The page's files, and the headers that they go out with."""

from importlib import resources
from mimetypes import guess_type

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
