# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Who is let in by the operator's server, and what becomes of strangers and of the hostile."""

import asyncio
import json

import pytest

aiohttp = pytest.importorskip('aiohttp', reason='aiohttp is not installed')
from operator_site import BAD, LOOK, next_picture, served, TIMEOUT_S  # noqa: E402, I100
from sph_stab_ros.operator import access  # noqa: E402
from sph_stab_ros.operator.access import Access, ConnectionGuard  # noqa: E402
from sph_stab_ros.operator.client import BURST  # noqa: E402
from sph_stab_ros.operator.protocol import MAX_MESSAGE_BYTES  # noqa: E402


@served(token='sesame')
async def test_token(site):
    assert await site.status('/?token=sesame') == 200
    for query in ('', '?token=', '?token=sesam', '?token=sesame1', '?token=%C3%A9',
                  '?Token=sesame'):
        assert await site.status('/' + query) == 403
        assert await site.refusal(query) == 403
    browser = await site.connect('?token=sesame')
    await browser.receive('state')
    assert any('token' in text for text in site.warnings)
    assert not any('sesam' in text for text in site.warnings)


@served()
async def test_pages_from_elsewhere_are_refused(site):
    for origin in ('http://evil.example', 'null', '', f'http://127.0.0.1:{site.port + 1}',
                   f'http://127.0.0.1:{site.port}.evil.example'):
        assert await site.refusal(Origin=origin) == 403
    # A name of their own that points here.
    evil = f'evil.example:{site.port}'
    assert await site.status('/', Host=evil) == 403
    assert await site.refusal(Host=evil, Origin=f'http://{evil}') == 403
    # Hosts that are none.
    for host in ('[', ']', '::', '[::1', 'a@b', f'127.0.0.1:{site.port}@evil.example', 'x:y:z'):
        assert await site.status('/', Host=host) == 403
        assert await site.refusal(Host=host, Origin=f'http://{host}') == 403
        assert await site.refusal(Origin=f'http://{host}') == 403
    await site.connect(Host=f'localhost:{site.port}', Origin=f'http://localhost:{site.port}')


def test_no_access_from_outside_without_a_token():
    for host in ('0.0.0.0', '::', '192.168.0.7', 'robot.local'):
        with pytest.raises(ValueError):
            Access(host)
        Access(host, 'token')
    for host in ('127.0.0.1', '127.3.2.1', '::1', 'localhost'):
        Access(host)


OVERSIZE = json.dumps({'type': 'set_mode', 'mode': 'x' * MAX_MESSAGE_BYTES})


@pytest.mark.parametrize('message', [*BAD[:8], OVERSIZE, b'binary', [LOOK] * int(BURST + 100)],
                         ids=lambda message: 'flood' if isinstance(message, list) else None)
def test_hostile_browser_is_dropped_and_disturbs_nobody(message):
    @served()
    async def test(site):
        good = await site.connect()
        await good.control('yours')
        bad = await site.connect()
        for one in message if isinstance(message, list) else [message]:
            send = bad.socket.send_bytes if isinstance(one, bytes) else bad.socket.send_str
            try:
                await send(one)
            except ConnectionError:
                break
        assert await bad.closed() in (1008, 1009, 1006, None)
        assert any('dropped' in text for text in site.warnings)
        for n in range(5):
            await next_picture(site, good, n)
        assert (await good.receive('state', lambda state: state['browsers'] == 1))['control'] \
            == 'yours'
    test()


@served()
async def test_connections_that_ask_for_nothing_are_closed(site):
    browser = await site.connect()
    idle = [await asyncio.open_connection('127.0.0.1', site.port) for _ in range(100)]
    for reader, writer in idle:
        writer.write(b'GET / HT')
        assert await asyncio.wait_for(reader.read(), TIMEOUT_S) == b''
        writer.close()
    await next_picture(site, browser, 1)
    assert any('led to nothing' in text for text in site.warnings)


@served(token='sesame')
async def test_connections_of_the_refused_are_closed(site):
    for path in ('/', '/main.js', '/nothing', '/socket?token=sesame'):
        reader, writer = await asyncio.open_connection('127.0.0.1', site.port)
        writer.write(f'GET {path} HTTP/1.1\r\nHost: 127.0.0.1:{site.port}\r\n\r\n'.encode())
        # To its end.
        assert (await asyncio.wait_for(reader.read(), TIMEOUT_S)).startswith(b'HTTP/1.1 ')
        writer.close()


@pytest.fixture(autouse=True)
def impatience(monkeypatch):
    """Spare the tests long waits."""
    monkeypatch.setattr(access, 'PATIENCE_S', 0.5)


@served()
async def test_what_is_no_http_is_answered_and_forgotten(site):
    browser = await site.connect()
    for nonsense in (b'\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03\r\n\r\n',
                     b'GET / HTTP/1.1\r\n' + b'X: ' + b'y' * 100_000 + b'\r\n\r\n',
                     b'POST /socket HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 9999999999\r\n'
                     b'\r\n'):
        reader, writer = await asyncio.open_connection('127.0.0.1', site.port)
        writer.write(nonsense)
        answer = await asyncio.wait_for(reader.readline(), TIMEOUT_S)
        assert b' 40' in answer, answer
        writer.close()
    await next_picture(site, browser, 1)
    assert any('a request refused' in text for text in site.warnings)
    assert all(len(text.splitlines()) == 1 for text in site.warnings)


@pytest.fixture(autouse=True)
def no_tracebacks(caplog):
    """Check that nothing that strangers send looks like a fault of our own in the log."""
    yield
    assert not [one for one in caplog.get_records('call') if one.exc_info]


def test_a_connection_that_lingers_is_closed_once():
    """With encryption both ends say goodbye first."""
    class Connection:
        closed = 0

        def force_close(self):
            self.closed += 1
    now_s = [0.]
    guard = ConnectionGuard(lambda: now_s[0])
    crowd = [Connection() for _ in range(access.MAX_CONNECTIONS + 2)]
    assert [guard.close_idle(crowd) for _ in range(2)] == [2, 0]
    now_s[0] = access.PATIENCE_S
    assert [guard.close_idle(crowd[1:]) for _ in range(2)] == [access.MAX_CONNECTIONS, 0]
    assert {one.closed for one in crowd} == {1}
    # Those that have come meanwhile have all their time.
    assert guard.close_idle([Connection(), *crowd]) == 0
