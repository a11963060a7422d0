# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The operator's server with video: who gets which pictures, whoever else is there."""

import asyncio
import tracemalloc

import pytest

pytest.importorskip('aiohttp', reason='aiohttp is not installed')
pytest.importorskip('av', reason='PyAV is not installed')
from operator_site import site, striped_jpeg, TIMEOUT_S  # noqa: E402, I100
from sph_stab_ros.operator.flow_control import MAX_VIDEO_UNDRAWN  # noqa: E402
from sph_stab_ros.operator.pairing import Picture  # noqa: E402
from sph_stab_ros.operator.video import Video  # noqa: E402


def picture(number):
    """Return a Picture of stripes that move with the number."""
    return Picture(number, striped_jpeg(number), 0.)


def with_video(**options):
    """Run a test, a coroutine function of a Site that has a Video."""
    def decorate(test):
        def run():
            async def run_it():
                warnings = []
                video = Video(lambda kind, text: warnings.append(text))
                async with site(video=video, **options) as one:
                    one.video_warnings = warnings
                    await asyncio.wait_for(test(one), 3 * TIMEOUT_S)
            asyncio.run(run_it())
        run.__name__ = test.__name__
        return run
    return decorate


async def film(site, numbers, *browsers, period_s=0.01):
    """Show pictures to browsers that draw them; return the headers that each has got."""
    got = [[] for _ in browsers]

    async def draw(browser, headers):
        while True:
            header = await browser.receive('picture')
            headers.append(header)
            await browser.send('drawn', sequence=header['sequence'])

    drawing = [asyncio.create_task(draw(*one)) for one in zip(browsers, got)]
    for n in numbers:
        site.server.show(picture(n))
        await asyncio.sleep(period_s)
    # Any may be left out, so the last one is shown until all have it.
    end_s = asyncio.get_running_loop().time() + TIMEOUT_S
    while not all(headers and int(headers[-1]['stamp_ns']) == n for headers in got):
        assert asyncio.get_running_loop().time() < end_s, 'the last picture does not come'
        site.server.show(picture(n))
        await asyncio.sleep(0.03)
    for one in drawing:
        one.cancel()
    await asyncio.gather(*drawing, return_exceptions=True)
    return got


@with_video()
async def test_who_asks_for_video_gets_one_and_others_files(site):
    video = await site.connect('?video=h264')
    others = [await site.connect(query) for query in ('', '?video=av1', '?video=')]
    assert (await video.receive('state'))['can_video']
    got, *files = await film(site, range(1, 40), video, *others)
    assert [one['chunk'] for one in got[:3]] == ['key', 'delta', 'delta']
    assert all(files)
    assert not any(one['chunk'] for headers in files for one in headers)
    sequences = [one['sequence'] for one in got]
    assert sequences == sorted(set(sequences))
    assert all(int(one['stamp_ns']) == min(one['sequence'], 39) for one in got)


@with_video()
async def test_a_late_joiner_gets_a_key_picture_at_once_and_who_asks_too(site):
    first = await site.connect('?video=h264')
    await film(site, range(20), first)
    second = await site.connect('?video=h264')
    _, late = await film(site, range(20, 200), first, second)
    assert late[0]['chunk'] == 'key' and late[1]['chunk'] == 'delta'
    await first.send('need_key')
    await asyncio.sleep(0.05)
    asked, _ = await film(site, range(200, 220), first, second)
    assert 'key' in [one['chunk'] for one in asked]


@with_video()
async def test_a_browser_that_acknowledges_nothing_delays_no_other(site):
    """Nor one that says the strangest things."""
    good = await site.connect('?video=h264')
    stuck, liar = [await site.connect('?video=h264') for _ in range(2)]
    await liar.send('drawn', sequence=2**53 - 1)
    had = []

    async def look_on():
        # Who does not even read cannot answer, and is dropped.
        while True:
            had.append(await stuck.receive('picture'))

    looking_on = asyncio.create_task(look_on())
    got, = await film(site, range(300), good, period_s=0.004)
    looking_on.cancel()
    # They cost it key pictures, but few.
    assert sum(one['chunk'] == 'key' for one in got) < len(got) / 4
    assert 0 < len(had) <= MAX_VIDEO_UNDRAWN
    # Once it draws, more come.
    await stuck.send('drawn', sequence=had[-1]['sequence'])
    await film(site, [300], stuck)


@with_video()
async def test_memory_is_flat_whatever_is_not_read(site):
    """One that does not even read, over pictures of which each is big."""
    good = await site.connect('?video=h264')
    _, writer = await site.bare_socket()
    tracemalloc.start()
    await film(site, range(100), good, period_s=0.004)
    before, _ = tracemalloc.get_traced_memory()
    await film(site, range(100, 400), good, period_s=0.004)
    after, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert after - before < 300_000
    writer.transport.abort()


@with_video()
async def test_broken_pictures_are_left_out(site):
    browser = await site.connect('?video=h264')
    await film(site, range(10), browser)
    site.server.show(Picture(99, b'\xff\xd8 no picture', 0.))
    await asyncio.sleep(0.1)
    got, = await film(site, range(100, 120), browser)
    assert 99 not in [int(one['stamp_ns']) for one in got]
    assert len(site.video_warnings) == 1


@with_video()
async def test_nothing_is_encoded_for_nobody(site):
    browser = await site.connect('?video=h264')
    await film(site, range(5), browser)
    site.server.show(picture(5))
    await browser.socket.close()
    while site.robot.watched:
        await asyncio.sleep(0.01)
    rungs = [site.server._video._full, site.server._video._half]
    while any(rung._encoder for rung in rungs):
        await asyncio.sleep(0.01)
    site.server.show(picture(6))
    assert not any(rung._work for rung in rungs)


@with_video()
async def test_the_time_comes_back_with_the_number(site):
    browser = await site.connect()
    await browser.send('echo', sent_ms=12.5)
    answer = await browser.receive('echo')
    assert answer['sent_ms'] == 12.5
    assert answer['server_ms'] > 1e12
