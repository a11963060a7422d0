# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""A document that can import the modules of the operator's page, and does nothing by itself."""

from contextlib import contextmanager
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from importlib import resources
from threading import Thread

from operator_harness import chromium


class Handler(SimpleHTTPRequestHandler):
    """Serves files without a word."""

    def log_message(self, *_):
        """Say nothing."""


@contextmanager
def bare_page(query=''):
    """Give the document in a browser."""
    folder = resources.files('sph_stab_ros.operator') / 'page'
    server = ThreadingHTTPServer(('127.0.0.1', 0), partial(Handler, directory=folder))
    Thread(target=server.serve_forever).start()
    try:
        with chromium() as browser:
            page = browser.new_page()
            page.goto(f'http://127.0.0.1:{server.server_port}/icon.svg')
            # A document without the page's own scripts.
            page.goto(f'http://127.0.0.1:{server.server_port}/nothing{query}')
            yield page
    finally:
        server.shutdown()
        server.server_close()
