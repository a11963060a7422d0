# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Video by datagrams in a browser: pictures come that way, or the WebSocket's."""

from contextlib import contextmanager

import pytest

pytest.importorskip('rclpy', reason='rclpy is not installed')
pytest.importorskip('aiohttp', reason='aiohttp is not installed')
pytest.importorskip('av', reason='PyAV is not installed')
pytest.importorskip('aioquic', reason='aioquic is not installed')
pytest.importorskip('cryptography', reason='cryptography is not installed')
from operator_harness import Page, wait_until  # noqa: E402, I100
from operator_served import Served  # noqa: E402
from operator_site import striped_jpeg  # noqa: E402
from sph_stab_ros.operator import datagrams  # noqa: E402
from sph_stab_ros.operator.certificate import own_identity  # noqa: E402
from sph_stab_ros.operator.encryption import context  # noqa: E402
from sph_stab_ros.operator.video import Video  # noqa: E402

TOKEN = 'sesame'


class Ways:
    """A page that shows a film, its server, and how many pictures have come which way."""

    def __init__(self, page, served, told):
        self.page, self.served, self.told = page, served, told
        self.by_socket = 0
        page.page.on('websocket', lambda socket: socket.on('framereceived', self._count))

    def _count(self, data):
        self.by_socket += isinstance(data, bytes)

    @property
    def client(self):
        """Return who is served."""
        browsers = [*self.served.server._browsers]
        return browsers[-1] if browsers else None

    def wait_for_datagrams(self):
        """Wait until pictures go by datagrams."""
        wait_until(lambda: self.client and self.client.datagrams, self.page.situation)

    def wait_for_what(self, what):
        """Wait until the page says that pictures come so."""
        wait_until(lambda: self.page.page.text_content('[data-figure=what]').split(',')[0] == what,
                   self.page.situation)

    def wait_for_pictures(self, count=5):
        """Wait until so many more pictures are drawn."""
        for _ in range(count):
            self.page.wait_for_picture_after(self.page.stamp_ns)


class Told(datagrams.Datagrams):
    """Tells browsers a ``sha256`` of its own, if it has one."""

    sha256 = None

    def invite(self, client):
        """Return what a browser has to be told."""
        told = super().invite(client)
        return {**told, 'sha256': self.sha256 or told['sha256']}


@pytest.fixture
def ways(browser, tmp_path):
    """Return what gives Ways, after a script has run in the page."""
    @contextmanager
    def ways(script='', sha256=None):
        identity = own_identity(tmp_path, {'localhost'}, set())

        def warn(kind, text):
            pass

        told = Told(warn)
        told.sha256 = sha256
        with Served(token=TOKEN, tls=context(identity.file), video=Video(warn),
                    datagrams=told) as served:
            served.file = striped_jpeg(height=256)
            page = Page(browser, 'about:blank', ignore_https_errors=True)
            page.page.add_init_script(script)
            one = Ways(page, served, told)
            page.page.goto(f'https://127.0.0.1:{served.port}/?token={TOKEN}')
            page.wait_for_situation('stabilized')
            yield one
            page.context.close()
            assert not page.errors
    return ways


def test_pictures_come_by_datagrams_alone(ways):
    with ways() as one:
        one.wait_for_datagrams()
        one.wait_for_pictures()
        before = one.by_socket
        one.wait_for_pictures(20)
        assert one.by_socket == before
        one.wait_for_what('H.264 by datagrams')
        # Which counts them.
        wait_until(lambda: float(one.page.page.text_content('[data-figure=mbit_s]')[:3]) > 0)


@pytest.mark.parametrize('options', [
    {'script': 'delete globalThis.WebTransport'}, {'sha256': 'A' * 43 + '='}],
    ids=['a browser that cannot', 'none gets through'])
def test_otherwise_they_come_by_the_websocket(ways, options):
    with ways(**options) as one:
        before = one.by_socket
        one.wait_for_pictures(20)
        assert one.by_socket > before
        one.wait_for_what('H.264')
        assert one.client.datagrams is None


@pytest.mark.parametrize('end', ['with a word', 'silently'])
def test_when_the_way_ends_they_come_by_the_websocket_again(ways, monkeypatch, end):
    monkeypatch.setattr(datagrams, 'IDLE_S', 1.)
    with ways() as one:
        one.wait_for_datagrams()
        one.wait_for_pictures()
        before, session = one.by_socket, one.client.datagrams
        if end == 'silently':
            # From now on the server hears none of them, but the WebSocket.
            for door in one.told._doors:
                monkeypatch.setattr(door, 'datagram_received', lambda data, addr: None)
        else:
            session._loop.call_soon_threadsafe(session.drop, 'enough')
        wait_until(lambda: one.client.datagrams is None, one.page.situation)
        one.wait_for_pictures(20)
        assert one.by_socket > before
        one.wait_for_what('H.264')
        one.page.wait_for_situation('stabilized')


def test_a_page_that_comes_back_gets_them_by_datagrams_again(ways):
    with ways() as one:
        one.wait_for_datagrams()
        first = one.client
        one.page.page.reload()
        wait_until(lambda: one.client not in (None, first), one.page.situation)
        one.wait_for_datagrams()
        one.wait_for_pictures()
        assert first.datagrams is None
