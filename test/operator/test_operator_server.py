# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The operator's server with a robot of straw, seen by bare WebSockets."""

import asyncio

import pytest

pytest.importorskip('aiohttp', reason='aiohttp is not installed')
from operator_site import next_picture, picture, served, TIMEOUT_S  # noqa: E402, I100
from sph_stab_ros.operator.flow_control import MAX_UNDRAWN  # noqa: E402
from sph_stab_ros.operator.pairing import Picture  # noqa: E402


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
        assert answer.headers['Cross-Origin-Resource-Policy'] == 'same-origin'
    # Without its token the page has no other name.
    assert await site.status('/index.html') == 404
    for path in ('/robot.py', '/..%2frobot.py', '/%2e%2e/robot.py', '/page/main.js'):
        assert await site.status(path) in (403, 404), path


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
    _, writer = await site.bare_socket()
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


@served()
async def test_who_comes_back_is_the_same_and_steers_on(site):
    """The connection of before went silent without an end that the server could have seen."""
    other = await site.connect('?page=b')
    first = await site.connect('?page=a')
    await first.send('take_control')
    await first.control('yours')
    await other.control('taken')
    again = await site.connect('?page=a')
    assert (await again.receive('state'))['control'] == 'yours'
    await first.closed()
    # Those who do not name themselves are nobody's former selves.
    strangers = [await site.connect() for _ in range(2)]
    assert (await other.receive('state', lambda state: state['browsers'] == 4))['control'] \
        == 'taken', strangers


@served()
async def test_pictures_that_cannot_be_drawn_do_not_count(site):
    """They make room for the next ones all the same."""
    browser = await site.connect()
    for n in range(3 * MAX_UNDRAWN):
        site.server.show(picture(n))
        received = await browser.receive('picture')
        assert int(received['stamp_ns']) == n
        await browser.send('skipped', sequence=received['sequence'])
    state = await browser.receive('state')
    assert state['rate_hz'] == 0 and state['latency_ms'] is None


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
