# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Video by datagrams for strangers and clumsy clients: who gets in, and whom that disturbs."""

import asyncio
from contextlib import asynccontextmanager
import json
from random import Random
import socket
import ssl

import pytest

pytest.importorskip('aiohttp', reason='aiohttp is not installed')
pytest.importorskip('av', reason='PyAV is not installed')
pytest.importorskip('aioquic', reason='aioquic is not installed')
pytest.importorskip('cryptography', reason='cryptography is not installed')
from aioquic.asyncio import connect, QuicConnectionProtocol  # noqa: E402, I100
from aioquic.h3.connection import H3_ALPN, H3Connection  # noqa: E402
from aioquic.h3.events import DatagramReceived, HeadersReceived  # noqa: E402
from aioquic.quic.configuration import QuicConfiguration  # noqa: E402
from operator_site import site, striped_jpeg, TIMEOUT_S  # noqa: E402
from sph_stab_ros.operator import datagrams  # noqa: E402
from sph_stab_ros.operator.certificate import own_identity  # noqa: E402
from sph_stab_ros.operator.encryption import context  # noqa: E402
from sph_stab_ros.operator.pairing import Picture  # noqa: E402
from sph_stab_ros.operator.video import Video  # noqa: E402

PATIENCE_S = 0.5


class Visitor(QuicConnectionProtocol):
    """The far end of a connection, as a browser's is; ``got`` are the datagrams that came."""

    def __init__(self, *args, **kwargs):
        super().__init__(*args, **kwargs)
        self._http = H3Connection(self._quic, enable_webtransport=True)
        self._status = self._loop.create_future()
        self.got, self.deaf, self._stream = [], False, 0

    def datagram_received(self, data, addr):
        """Take in a packet, or lose it."""
        if not self.deaf:
            super().datagram_received(data, addr)

    def quic_event_received(self, event):
        """Note what is answered."""
        for one in self._http.handle_event(event):
            if isinstance(one, HeadersReceived):
                self._status.set_result(int(dict(one.headers)[b':status']))
            elif isinstance(one, DatagramReceived):
                self.got.append(one.data)

    async def ask(self, port, path, origin=None):
        """Ask for a session; return the status of the answer."""
        authority = f'127.0.0.1:{port}'
        self._stream = self._quic.get_next_available_stream_id()
        self._http.send_headers(self._stream, [
            (b':method', b'CONNECT'), (b':scheme', b'https'), (b':protocol', b'webtransport'),
            (b':authority', authority.encode()), (b':path', path.encode()),
            (b'origin', (origin or f'https://{authority}').encode())])
        self.transmit()
        return await self._status

    def say(self, data):
        """Send a datagram."""
        self._http.send_datagram(self._stream, data)
        self.transmit()

    async def is_sent_away(self):
        """Wait until the connection is closed, although it is in use."""
        while not self._closed.is_set():
            self.say(b'')
            await asyncio.sleep(0.1)

    def say_command(self, kind, **values):
        """Send a command."""
        self.say(json.dumps({'type': kind, **values}).encode())


@asynccontextmanager
async def visiting(port):
    """Give a Visitor, connected."""
    configuration = QuicConfiguration(
        alpn_protocols=H3_ALPN, verify_mode=False, max_datagram_frame_size=1 << 16)
    async with connect('127.0.0.1', port, configuration=configuration,
                       create_protocol=Visitor) as visitor:
        yield visitor


@pytest.fixture(autouse=True)
def impatience(monkeypatch):
    """Spare the tests long waits."""
    monkeypatch.setattr(datagrams, 'PATIENCE_S', PATIENCE_S)


@pytest.fixture(autouse=True)
def no_tracebacks(caplog):
    """Check that nothing that strangers send looks like a fault of our own in the log."""
    yield
    assert not [one for one in caplog.get_records('call') if one.exc_info]


@pytest.fixture
def encrypted(tmp_path):
    """Return what gives an encrypted Site whose video goes by datagrams too."""
    @asynccontextmanager
    async def encrypted():
        identity = own_identity(tmp_path, {'localhost'}, set())
        warnings = []

        def warn(kind, text):
            warnings.append(text)

        async with site(tls=context(identity.file), video=Video(warn),
                        datagrams=datagrams.Datagrams(warn)) as one:
            one.url = f'https://localhost:{one.port}'
            one.trusted = ssl.create_default_context(cadata=identity.authority_pem.decode())
            one.warnings = warnings
            yield one
    return encrypted


def run(test, encrypted):
    """Run a coroutine function of a Site."""
    async def with_site():
        async with encrypted() as one:
            await asyncio.wait_for(test(one), 2 * TIMEOUT_S)
    asyncio.run(with_site())


async def until(condition, site=None):
    """Wait until a condition holds; a Site shows pictures meanwhile."""
    end_s = asyncio.get_running_loop().time() + TIMEOUT_S
    number = 0
    while not condition():
        assert asyncio.get_running_loop().time() < end_s, 'waited in vain'
        if site:
            number += 1
            site.server.show(Picture(number, striped_jpeg(number), 0.))
        await asyncio.sleep(0.01)


async def watch(site):
    """Return a browser that takes video, and the path that it is told."""
    browser = await site.connect('?video=h264')
    return browser, (await browser.receive('datagrams'))['path']


async def goes_on(site, browser):
    """Check that a browser still gets pictures by its WebSocket, a key picture first."""
    getting = asyncio.create_task(browser.receive('picture'))
    await until(getting.done, site)
    await browser.send('drawn', sequence=getting.result()['sequence'])


def test_a_secret_lets_one_in_once_and_pictures_come_that_way(encrypted):
    async def test(site):
        _, path = await watch(site)
        async with visiting(site.port) as visitor:
            assert await visitor.ask(site.port, path) == 200
            await until(lambda: len(visitor.got) > 3, site)
        async with visiting(site.port) as visitor:
            assert await visitor.ask(site.port, path) == 403
    run(test, encrypted)


@pytest.mark.parametrize('path, origin', [
    ('/', None), ('/datagrams/', None), ('/datagrams/' + 'A' * 22, None),
    (None, 'https://elsewhere.example'), (None, 'http://127.0.0.1')], ids=str)
def test_others_are_refused(encrypted, path, origin):
    async def test(site):
        browser, secret = await watch(site)
        async with visiting(site.port) as visitor:
            assert await visitor.ask(site.port, path or secret, origin) == 403
            await visitor.is_sent_away()
        await goes_on(site, browser)
    run(test, encrypted)


def test_nobody_is_let_in_for_a_browser_that_has_gone(encrypted):
    async def test(site):
        browser, path = await watch(site)
        await browser.socket.close()
        await until(lambda: not site.server._browsers)
        async with visiting(site.port) as visitor:
            assert await visitor.ask(site.port, path) == 403
    run(test, encrypted)


def test_who_asks_for_nothing_has_to_go(encrypted):
    async def test(site):
        async with visiting(site.port) as visitor:
            await visitor.is_sent_away()
    run(test, encrypted)


def test_garbage_disturbs_nobody(encrypted):
    async def test(site):
        browser, path = await watch(site)
        random = Random(0)
        async with visiting(site.port) as visitor:
            assert await visitor.ask(site.port, path) == 200
            with socket.socket(type=socket.SOCK_DGRAM) as stranger:
                for n in range(500):
                    packet = bytearray(random.randbytes(random.randrange(1, 1400)))
                    # Of every second one a beginning of QUIC's.
                    packet[:5] = b'\xc3\x00\x00\x00\x01' if n % 2 else packet[:5]
                    stranger.sendto(packet, ('127.0.0.1', site.port))
            before = len(visitor.got)
            await until(lambda: len(visitor.got) > before + 3, site)
    run(test, encrypted)


BAD = [b'', b'\xff\xfe', b'{}', b'{"type": "level"}', b'{"type": "take_control"}',
       b'{"type": "look", "direction": [0, 0, 0, 1]}', b'{"type": "arrived", "sequence": 1}',
       b'{"type": "arrived", "sequence": 1, "newest": -1}',
       b'{"type": "drawn", "sequence": 1}' * 2]


@pytest.mark.parametrize('data', BAD, ids=repr)
def test_what_no_page_says_ends_the_session_alone(encrypted, data):
    async def test(site):
        browser, path = await watch(site)
        async with visiting(site.port) as visitor:
            assert await visitor.ask(site.port, path) == 200
            visitor.say(data)
            await visitor.wait_closed()
        assert any('dropped' in text for text in site.warnings)
        await goes_on(site, browser)
    run(test, encrypted)


def test_a_flood_ends_the_session_alone(encrypted):
    async def test(site):
        browser, path = await watch(site)
        async with visiting(site.port) as visitor:
            assert await visitor.ask(site.port, path) == 200
            flooding = asyncio.create_task(visitor.wait_closed())
            while not flooding.done():
                visitor.say_command('drawn', sequence=1)
                await asyncio.sleep(0)
        assert any('too m' in text for text in site.warnings)
        await goes_on(site, browser)
    run(test, encrypted)


def test_who_acknowledges_pictures_but_no_packets_is_dropped(encrypted, monkeypatch):
    """Or all that is sent would have to be remembered."""
    monkeypatch.setattr(datagrams, 'MAX_IN_FLIGHT_BYTES', 50_000)

    async def test(site):
        browser, path = await watch(site)
        async with visiting(site.port) as visitor:
            assert await visitor.ask(site.port, path) == 200
            await until(lambda: visitor.got, site)
            visitor.deaf = True

            def dropped():
                visitor.say_command('drawn', sequence=2**53 - 1)
                return any('no answer' in text for text in site.warnings)
            await until(dropped, site)
        await goes_on(site, browser)
    run(test, encrypted)
