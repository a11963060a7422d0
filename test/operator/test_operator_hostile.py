# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Clients of the operator's server that are hostile, clumsy or half dead."""

import asyncio

import pytest

pytest.importorskip('aiohttp', reason='aiohttp is not installed')
from operator_site import frame, next_picture, served, TIMEOUT_S  # noqa: E402, I100
from sph_stab_ros.operator import browser_socket  # noqa: E402
from sph_stab_ros.operator.protocol import MAX_MESSAGE_BYTES  # noqa: E402

CONTINUATION, TEXT, PING, PONG = 0, 1, 9, 10
# More than the sockets of this machine hold.
MUCH = 40_000_000
ENDLESS = {
    'pings': frame(PING), 'long pings': frame(PING, b'x' * 125), 'pongs': frame(PONG, b'x'),
    'empty parts of a text': frame(CONTINUATION, final=False),
    'a text announced as long': b'x' * 10_000,
}
BEGINNINGS = {
    'empty parts of a text': frame(TEXT, final=False),
    'a text announced as long': b'\x81\xff' + (400_000_000).to_bytes(8, 'big') + bytes(4),
}


@pytest.fixture(autouse=True)
def impatience(monkeypatch):
    """Spare the tests long waits."""
    monkeypatch.setattr(browser_socket, 'HEARTBEAT_S', 0.5)


@pytest.fixture(autouse=True)
def no_tracebacks(caplog):
    """Check that nothing that strangers send looks like a fault of our own in the log."""
    yield
    assert not [one for one in caplog.get_records('call') if one.exc_info]


@pytest.mark.parametrize('reads', [True, False], ids=['reads', 'reads nothing'])
@pytest.mark.parametrize('kind', ENDLESS)
def test_a_flood_ends_with_its_connection(kind, reads):
    """Whatever it is of, and although all of it may be what the protocol allows."""
    @served()
    async def test(site):
        good = await site.connect()
        await good.control('yours')
        reader, writer = await site.bare_socket()
        await good.receive('state', lambda state: state['browsers'] == 2)
        reading = asyncio.create_task(read_on(reader)) if reads else None
        writer.write(BEGINNINGS.get(kind, b''))
        piece = ENDLESS[kind] * (100_000 // len(ENDLESS[kind]))
        with pytest.raises(ConnectionError):
            for _ in range(MUCH // len(piece)):
                writer.write(piece)
                await asyncio.wait_for(writer.drain(), TIMEOUT_S)
        await good.receive('state', lambda state: state['browsers'] == 1)
        assert any('dropped' in text for text in site.warnings)
        assert all(len(text.splitlines()) == 1 for text in site.warnings)
        if reading:
            await reading
        for n in range(5):
            await next_picture(site, good, n)
    test()


async def read_on(reader):
    """Read to the end, however that comes."""
    try:
        while await reader.read(1 << 16):
            pass
    except ConnectionError:
        pass


@pytest.mark.parametrize('answer', [frame(PONG), frame(PONG, b'12345678'), b''],
                         ids=['pongs', 'pongs with something in them', 'silence'])
def test_a_place_is_not_held_without_reading(answer):
    @served(max_clients=1)
    async def test(site):
        _, writer = await site.bare_socket()
        while not site.robot.watched:
            await asyncio.sleep(0.01)
        assert await (await site.connect()).closed() == 1013
        while site.robot.watched:
            writer.write(answer)
            await asyncio.sleep(0.05)
        await (await site.connect()).control('yours')
    test()


@served()
async def test_who_answers_stays(site):
    """Several heartbeats long, and although nothing is drawn."""
    browser = await site.connect()
    end_s = asyncio.get_running_loop().time() + 5 * browser_socket.HEARTBEAT_S
    while asyncio.get_running_loop().time() < end_s:
        await browser.receive('state')
    await next_picture(site, browser, 1)


@served()
async def test_a_few_pings_are_answered(site):
    browser = await site.connect()
    for n in range(10):
        await browser.socket.ping(str(n).encode())
    await next_picture(site, browser, 1)
    reader, writer = await site.bare_socket()
    writer.write(frame(PING, b'are you there'))
    seen = b''
    while frame_of_server(PONG, b'are you there') not in seen:
        piece = await asyncio.wait_for(reader.read(1 << 16), TIMEOUT_S)
        assert piece
        seen += piece
    writer.close()


def frame_of_server(opcode, payload):
    """Return a short WebSocket frame of a server, which masks nothing."""
    return bytes((0x80 | opcode, len(payload))) + payload


@served()
async def test_the_longest_message_and_a_longer_one(site):
    """Between them lies one byte."""
    browser = await site.connect()
    command = '{"type": "take_control"}'
    await browser.socket.send_str(command.ljust(MAX_MESSAGE_BYTES))
    await next_picture(site, browser, 1)
    await browser.socket.send_str(command.ljust(MAX_MESSAGE_BYTES + 1))
    assert await browser.closed() in (1008, 1009)


@served()
async def test_a_request_without_a_host(site):
    """Local names alone are served here, and none is looked up for those who name none."""
    looked_up = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr('socket.getfqdn', lambda name='': looked_up.append(name) or 'localhost')
        for path in ('/', '/main.js', '/socket'):
            reader, writer = await asyncio.open_connection('127.0.0.1', site.port)
            writer.write(f'GET {path} HTTP/1.0\r\n\r\n'.encode())
            answer = await asyncio.wait_for(reader.read(), TIMEOUT_S)
            assert answer.split()[1] == b'403', answer
            writer.close()
    assert not looked_up
