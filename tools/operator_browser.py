# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""A browser to measure the operator's page with."""

from contextlib import contextmanager, nullcontext
import socket
import subprocess
import sys
import tempfile
import time

STARTUP_S = 60.
SIZE_WH = 1280, 720
# WebGL in software where there is no graphics card; no connections of the browser's own.
CHROMIUM_FLAGS = (
    '--no-sandbox', '--disable-quic', '--no-first-run', '--disable-background-networking',
    '--disable-component-update', '--disable-sync',
    '--enable-unsafe-swiftshader')
# Over a link the page comes by https, with a certificate that no browser knows.
LINK_FLAGS = ('--ignore-certificate-errors',)


class Browser:
    """
    A headless Chromium with one page.

    Its driver is there only within ``page``: while pictures come it would be told of each. Both
    are at the far end of a BadLink if there is one.
    """

    def __init__(self, chromium, link):
        self._inside = link.inside if link else nullcontext
        self._port = free_port()
        self._folder = tempfile.TemporaryDirectory()
        width, height = SIZE_WH
        with self._inside():
            self._process = subprocess.Popen(
                (chromium, '--headless', *CHROMIUM_FLAGS, *(LINK_FLAGS if link else ()),
                 f'--window-size={width},{height}', f'--remote-debugging-port={self._port}',
                 f'--user-data-dir={self._folder.name}', 'about:blank'),
                stderr=subprocess.DEVNULL)

    def __enter__(self):
        with self._inside():
            wait_until(lambda: socket.socket().connect_ex(('127.0.0.1', self._port)) == 0)
        return self

    def __exit__(self, *_):
        self._process.terminate()
        self._process.wait()
        self._folder.cleanup()

    @contextmanager
    def page(self):
        """Give the page to the driver."""
        from playwright.sync_api import sync_playwright
        with self._inside(), sync_playwright() as driver:
            browser = driver.chromium.connect_over_cdp(f'http://127.0.0.1:{self._port}')
            yield browser.contexts[0].pages[0]
            browser.close()


def free_port():
    """Return a TCP port that nobody listens on."""
    with socket.socket() as probe:
        probe.bind(('127.0.0.1', 0))
        return probe.getsockname()[1]


def wait_until(condition):
    """Wait until a condition holds; end the program where it does not."""
    end_s = time.monotonic() + STARTUP_S
    while not condition():
        if time.monotonic() > end_s:
            sys.exit('operator_latency: node, server and page did not come up')
        time.sleep(0.05)
