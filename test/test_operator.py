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

"""The operator's page without a browser: pairing, protocol, and a server with a robot of straw."""

import asyncio
from collections import Counter
from contextlib import asynccontextmanager
from dataclasses import asdict, dataclass
import json
from struct import unpack_from

import numpy as np
import pytest

aiohttp = pytest.importorskip('aiohttp', reason='aiohttp is not installed')
from sph_stab_ros.operator import access  # noqa: E402, I100
from sph_stab_ros.operator.access import Access  # noqa: E402
from sph_stab_ros.operator.client import BURST, MAX_UNDRAWN  # noqa: E402
from sph_stab_ros.operator.pairing import (  # noqa: E402
    MAX_WAITING, Orientation, Pairing, Picture, SILENCE_S)
from sph_stab_ros.operator.protocol import (  # noqa: E402
    COMMANDS, Look, MAX_MESSAGE_BYTES, parse_command, picture_message, ProtocolError)
from sph_stab_ros.operator.server import OperatorServer, RobotError  # noqa: E402

TIMEOUT_S = 20.
IDENTITY = (0., 0., 0., 1.)
LOOK = json.dumps({'type': 'look', 'direction': IDENTITY})


class Clock:
    """A clock that stands still unless it is moved."""

    def __init__(self):
        self.now_s = 100.

    def __call__(self):
        """Return the time in seconds."""
        return self.now_s


def picture(stamp_ns, size=10):
    """Return a Picture without orientation."""
    return Picture(stamp_ns, b'\xff\xd8' + bytes(size), 0.)


def orientation(number):
    """Return an Orientation that can be told from others."""
    return Orientation((0., 0., 0., 1.), (float(number), 0., 0., 0.))


# Pairing.

@pytest.mark.parametrize('seed', range(20))
def test_every_picture_has_the_orientation_of_its_stamp(seed):
    rng = np.random.default_rng(seed)
    paired = []
    pairing = Pairing(paired.append, Clock())
    pairing.add_orientation(1, orientation(1))
    # Each arrives late by its own delay; the node leaves some pictures out.
    events = [(n + rng.uniform(0, 5), 'picture', n) for n in range(2, 200)]
    events += [(n + rng.uniform(0, 5), 'orientation', n) for n in range(2, 200)
               if rng.random() < 0.8]
    in_order = {'picture': [], 'orientation': []}
    for time_s, kind, n in sorted(events, key=lambda event: event[2]):
        # The middleware keeps each topic in order.
        time_s = max([time_s, *(at_s for at_s, _ in in_order[kind][-1:])])
        in_order[kind].append((time_s, n))
    for _, kind, n in sorted((time_s, kind, n) for kind, list_ in in_order.items()
                             for time_s, n in list_):
        if kind == 'picture':
            pairing.add_picture(picture(n))
        else:
            pairing.add_orientation(n, orientation(n))
    assert [one.stamp_ns for one in paired] == [n for _, n in in_order['orientation']]
    assert all(one.orientation == orientation(one.stamp_ns) for one in paired)


def test_pictures_go_out_alone_when_no_node_is_heard():
    emitted, clock = [], Clock()
    pairing = Pairing(emitted.append, clock)
    pairing.add_picture(picture(1))
    assert emitted == [picture(1)]
    pairing.add_orientation(2, orientation(2))
    pairing.add_picture(picture(3))
    assert len(emitted) == 1
    clock.now_s += SILENCE_S
    pairing.add_picture(picture(4))
    assert [one.stamp_ns for one in emitted] == [1, 4]
    assert emitted[-1].orientation is None


def test_what_waits_is_bounded():
    emitted = []
    pairing = Pairing(emitted.append, Clock())
    pairing.add_orientation(1, orientation(1))
    for n in range(2, 10 * MAX_WAITING):
        pairing.add_picture(picture(n))
    pairing.add_orientation(2, orientation(2))
    assert not emitted


def test_a_camera_without_stamps_gets_the_newest_picture():
    emitted = []
    pairing = Pairing(emitted.append, Clock())
    pairing.add_orientation(1, orientation(1))
    for size in (1, 2, 3):
        pairing.add_picture(picture(0, size))
    pairing.add_orientation(99, orientation(99))
    assert [(one.data, one.orientation) for one in emitted] == [
        (picture(0, 3).data, orientation(99))]


# Protocol.

@pytest.mark.parametrize('of', [orientation(3), None])
def test_picture_message(of):
    stamp_ns = 2**63 - 1
    message = picture_message(7, Picture(stamp_ns, b'\xff\xd8picture', 0., of))
    length, = unpack_from('<I', message)
    header = json.loads(message[4:4 + length])
    assert message[4 + length:] == b'\xff\xd8picture'
    assert header['sequence'] == 7 and int(header['stamp_ns']) == stamp_ns
    assert header['orientation'] == (of and json.loads(json.dumps(asdict(of))))


def test_commands_of_the_page():
    direction = [0.6, 0., 0., 0.8001]
    look = parse_command(json.dumps({'type': 'look', 'direction': direction}))
    assert isinstance(look, Look)
    assert np.linalg.norm(look.direction) == pytest.approx(1, abs=1e-12)
    np.testing.assert_allclose(look.direction, direction, atol=1e-3)
    assert parse_command('{"type": "drawn", "sequence": 3}').sequence == 3
    assert parse_command('{"type": "set_mode", "mode": "lock"}').mode == 'lock'


BAD = [
    '', '{', 'null', '3', '[]', '"look"', '{}', '{"type": null}', '{"type": ["look"]}',
    '{"type": "shutdown"}', '{"type": "look"}', '{"type": "look", "direction": "up"}',
    '{"type": "look", "direction": [0, 0, 0]}', '{"type": "look", "direction": [0, 0, 0, 2]}',
    '{"type": "look", "direction": [NaN, 0, 0, 1]}',
    '{"type": "look", "direction": [0, 0, 0, 1e999]}',
    '{"type": "look", "direction": [0, 0, 0, true]}',
    '{"type": "look", "direction": [0, 0, 0, 1], "more": 1}',
    '{"type": "drawn", "sequence": -1}', '{"type": "drawn", "sequence": 1.5}',
    '{"type": "drawn", "sequence": 99999999999999999999}', '{"type": "drawn", "sequence": "1"}',
    '{"type": "set_mode", "mode": ""}', '{"type": "set_mode", "mode": 1}',
    '{"type": "level", "really": true}', '[' * 1000,
]


@pytest.mark.parametrize('text', BAD)
def test_other_texts_are_refused(text):
    with pytest.raises(ProtocolError):
        parse_command(text)


def test_no_text_does_more_than_be_refused():
    rng = np.random.default_rng(0)
    whole = [json.dumps({'type': 'look', 'direction': [0, 0, 0, 1]}),
             json.dumps({'type': 'drawn', 'sequence': 12}),
             json.dumps({'type': 'set_mode', 'mode': 'follow'})]
    outcomes = Counter()
    for n in range(3000):
        text = bytearray(whole[n % 3].encode())
        for _ in range(rng.integers(1, 4)):
            text[rng.integers(len(text))] = rng.integers(32, 127)
        try:
            outcomes[type(parse_command(text.decode()))] += 1
        except ProtocolError:
            outcomes['refused'] += 1
    assert outcomes['refused'] > 1000
    assert outcomes.keys() - {'refused'} <= set(COMMANDS.values())


# Server.

@dataclass(frozen=True)
class StrawState:
    """What there is to tell of a robot of straw."""

    tracking: str = 'ok'


class StrawRobot:
    """Notes what it is asked for."""

    state = StrawState()

    def __init__(self):
        self.watched = None
        self.looks = []
        self.levelling = asyncio.Event()

    def watch(self, watched):
        """Note whether somebody looks."""
        self.watched = watched

    def look(self, direction):
        """Note a look."""
        self.looks.append(direction)

    async def reset_heading(self):
        """Do as told."""
        return 'done'

    async def level(self):
        """Take a long time."""
        await self.levelling.wait()
        return 'level'

    async def set_mode(self, mode):
        """Refuse."""
        raise RobotError(f'no {mode}')


class Browser:
    """The other end of a WebSocket, as the page is."""

    def __init__(self, socket):
        self.socket = socket

    async def receive(self, kind, condition=lambda message: True):
        """Return the next message of a kind, a dict, that meets a condition; skip others."""
        while True:
            message = await asyncio.wait_for(self.socket.receive(), TIMEOUT_S)
            assert message.type in (aiohttp.WSMsgType.TEXT, aiohttp.WSMsgType.BINARY), message
            if message.type is aiohttp.WSMsgType.TEXT:
                values = json.loads(message.data)
            else:
                length, = unpack_from('<I', message.data)
                values = {'type': 'picture', **json.loads(message.data[4:4 + length])}
            if values['type'] == kind and condition(values):
                return values

    async def control(self, value):
        """Wait until control is 'yours', 'taken' or 'free'."""
        await self.receive('state', lambda state: state['control'] == value)

    async def send(self, kind, **values):
        """Send a command."""
        await self.socket.send_str(json.dumps({'type': kind, **values}))

    async def closed(self):
        """Wait for the end; return the close code."""
        while not (await asyncio.wait_for(self.socket.receive(), TIMEOUT_S)).type in (
                aiohttp.WSMsgType.CLOSE, aiohttp.WSMsgType.CLOSED, aiohttp.WSMsgType.ERROR):
            pass
        return self.socket.close_code


class Site:
    """A server with a robot of straw, and ways to it."""

    def __init__(self, server, robot, port, session, warnings):
        self.server, self.robot, self.port = server, robot, port
        self.session, self.warnings = session, warnings
        self.url = f'http://127.0.0.1:{port}'

    async def status(self, path, **headers):
        """Return the status of an answer."""
        async with self.session.get(self.url + path, headers=headers) as answer:
            return answer.status

    async def connect(self, query='', **headers):
        """Open a WebSocket as the page does."""
        return Browser(await self.session.ws_connect(
            f'{self.url}/socket{query}', headers={'Origin': self.url, **headers}))

    async def refusal(self, query='', **headers):
        """Return the status with which a WebSocket is refused."""
        with pytest.raises(aiohttp.WSServerHandshakeError) as refused:
            await self.connect(query, **headers)
        return refused.value.status


@asynccontextmanager
async def site(token=None, **options):
    """Serve on a free port."""
    robot, warnings = StrawRobot(), []
    server = OperatorServer(robot, Access('127.0.0.1', token),
                            lambda kind, text: warnings.append(text), **options)
    runner = await server.start('127.0.0.1', 0)
    try:
        async with aiohttp.ClientSession() as session:
            yield Site(server, robot, runner.addresses[0][1], session, warnings)
    finally:
        await runner.cleanup()


def served(**options):
    """Run a test, a coroutine function of a Site, in an event loop."""
    def decorate(test):
        def run():
            async def with_site():
                async with site(**options) as one:
                    await asyncio.wait_for(test(one), 2 * TIMEOUT_S)
            asyncio.run(with_site())
        run.__name__ = test.__name__
        return run
    return decorate


@served()
async def test_page_and_nothing_else(site):
    async with site.session.get(site.url) as answer:
        assert answer.status == 200
        assert answer.content_type == 'text/html'
        policy = answer.headers['Content-Security-Policy']
        assert "default-src 'none'" in policy and f'ws://127.0.0.1:{site.port}' in policy
        assert '<main>' in await answer.text()
    async with site.session.get(site.url + '/main.js') as answer:
        assert 'javascript' in answer.content_type
    for path in ('/robot.py', '/..%2frobot.py', '/%2e%2e/robot.py', '/page/main.js'):
        assert await site.status(path) in (403, 404), path


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
    await site.connect(Host=f'localhost:{site.port}', Origin=f'http://localhost:{site.port}')


def test_no_access_from_outside_without_a_token():
    for host in ('0.0.0.0', '::', '192.168.0.7', 'robot.local'):
        with pytest.raises(ValueError):
            Access(host)
        Access(host, 'token')
    for host in ('127.0.0.1', '127.3.2.1', '::1', 'localhost'):
        Access(host)


async def next_picture(site, browser, stamp_ns):
    """Show a picture; return its message when the browser has it and has said so."""
    site.server.show(picture(stamp_ns))
    received = await browser.receive('picture')
    assert int(received['stamp_ns']) == stamp_ns
    await browser.send('drawn', sequence=received['sequence'])
    return received


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
async def test_a_browser_that_draws_nothing_delays_no_other(site):
    fast = await site.connect()
    stuck = await site.connect()
    await stuck.receive('state')
    for n in range(50):
        await next_picture(site, fast, n)
    stuck_has = [await stuck.receive('picture') for _ in range(MAX_UNDRAWN)]
    assert [int(one['stamp_ns']) for one in stuck_has] == list(range(MAX_UNDRAWN))
    # Once it has drawn, it goes on with the newest, not with what it has missed.
    await stuck.send('drawn', sequence=stuck_has[-1]['sequence'])
    assert int((await stuck.receive('picture'))['stamp_ns']) == 49


@served()
async def test_a_browser_that_does_not_even_read_delays_no_other(site):
    fast = await site.connect()
    reader, writer = await asyncio.open_connection('127.0.0.1', site.port, limit=1)
    writer.write((f'GET /socket HTTP/1.1\r\nHost: 127.0.0.1:{site.port}\r\nOrigin: {site.url}\r\n'
                  'Connection: Upgrade\r\nUpgrade: websocket\r\nSec-WebSocket-Version: 13\r\n'
                  'Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n\r\n').encode())
    await fast.receive('state', lambda state: state['browsers'] == 2)
    for n in range(20):
        site.server.show(picture(n, 3_000_000))
        received = await fast.receive('picture')
        assert int(received['stamp_ns']) == n
        await fast.send('drawn', sequence=received['sequence'])
    writer.transport.abort()
    await fast.receive('state', lambda state: state['browsers'] == 1)


@served()
async def test_control_goes_from_hand_to_hand(site):
    first = await site.connect()
    await first.control('yours')
    second = await site.connect()
    await second.control('taken')
    await second.send('look', direction=[0, 1, 0, 0])
    await second.send('reset_heading')
    assert not (await second.receive('notice'))['ok']
    await first.send('look', direction=[1, 0, 0, 0])
    await second.send('take_control')
    await second.control('yours')
    await first.control('taken')
    await second.send('look', direction=[0, 0, 1, 0])
    await second.send('reset_heading')
    assert (await second.receive('notice'))['done'] == 'ResetHeading'
    assert site.robot.looks == [(1, 0, 0, 0), (0, 0, 1, 0)]
    await second.socket.close()
    await first.control('free')
    # Whoever only watches is not made to steer; whoever comes may.
    third = await site.connect()
    await third.control('yours')
    await first.control('taken')


@served(max_clients=2)
async def test_no_more_browsers_than_allowed(site):
    browsers = [await site.connect() for _ in range(2)]
    assert await (await site.connect()).closed() == 1013
    await browsers[0].socket.close()
    await browsers[1].receive('state', lambda state: state['browsers'] == 1)
    await (await site.connect()).receive('state')


@served()
async def test_the_robot_takes_its_time_and_the_pictures_go_on(site):
    browser = await site.connect()
    await browser.control('yours')
    await browser.send('level')
    await browser.send('reset_heading')
    assert 'still' in (await browser.receive('notice'))['text']
    await next_picture(site, browser, 1)
    site.robot.levelling.set()
    assert (await browser.receive('notice'))['text'] == 'level'
    await browser.send('set_mode', mode='cartwheel')
    assert await browser.receive('notice') == {'type': 'notice', 'text': 'no cartwheel',
                                               'ok': False}


@served()
async def test_the_robot_knows_whether_anybody_looks(site):
    assert not site.robot.watched
    browsers = [await site.connect() for _ in range(2)]
    await browsers[0].receive('state', lambda state: state['browsers'] == 2)
    assert site.robot.watched
    await browsers[0].socket.close()
    await browsers[1].receive('state', lambda state: state['browsers'] == 1)
    assert site.robot.watched
    await browsers[1].socket.close()
    while site.robot.watched:
        await asyncio.sleep(0.01)


@served()
async def test_latency_includes_all_since_the_picture_came(site):
    browser = await site.connect()
    received = Picture(1, b'\xff\xd8', asyncio.get_running_loop().time() - 3)
    site.server.show(received)
    await browser.send('drawn', sequence=(await browser.receive('picture'))['sequence'])
    state = await browser.receive('state', lambda state: state['latency_ms'] is not None)
    assert 3000 <= state['latency_ms'] < 3000 + 1000 * TIMEOUT_S


@served()
async def test_connections_that_ask_for_nothing_are_closed(site):
    browser = await site.connect()
    idle = [await asyncio.open_connection('127.0.0.1', site.port) for _ in range(100)]
    for reader, writer in idle:
        writer.write(b'GET / HT')
        assert await asyncio.wait_for(reader.read(), TIMEOUT_S) == b''
        writer.close()
    await next_picture(site, browser, 1)
    assert any('asked for nothing' in text for text in site.warnings)


@pytest.fixture(autouse=True)
def impatience(monkeypatch):
    """Spare the tests long waits."""
    monkeypatch.setattr(access, 'FIRST_REQUEST_S', 0.5)


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


# Command line.

@pytest.mark.parametrize('arguments', [
    ['--port', 'x'], ['--port', '70000'], ['--browsers', '0'], ['--colour', 'red'],
    ['--token-file', '/nowhere'], ['--ros-args', '-r', 'x']])
def test_wrong_calls(arguments, capsys):
    pytest.importorskip('rclpy', reason='rclpy is not installed')
    from sph_stab_ros.operator.__main__ import main
    try:
        status = main(arguments)
    except SystemExit as ending:
        status = ending.code
    said = capsys.readouterr().err
    assert status == 2
    assert len(said.splitlines()) == 1 and said.startswith('operator: ')


def test_addresses():
    pytest.importorskip('rclpy', reason='rclpy is not installed')
    from sph_stab_ros.operator.__main__ import address
    assert address('127.0.0.1', 80, None) == 'http://127.0.0.1:80/'
    assert address('::1', 80, 'abc') == 'http://[::1]:80/?token=abc'
    assert '0.0.0.0' not in address('0.0.0.0', 80, 'abc')
