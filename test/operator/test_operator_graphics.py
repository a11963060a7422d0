# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The operator's page on graphics cards that take little, fail, or are taken away."""

import asyncio
from threading import Thread

import cv2
import pytest

pytest.importorskip('rclpy', reason='rclpy is not installed')
pytest.importorskip('aiohttp', reason='aiohttp is not installed')
from graphics_cards import BLIND, NO_CARD, NO_MEMORY, SMALL_CARD  # noqa: E402, I100
from operator_harness import Page, wait_until, world_with_disc  # noqa: E402
from operator_site import IDENTITY, site  # noqa: E402
from sph_stab_ros.operator.pairing import Orientation, Picture  # noqa: E402

PERIOD_S = 0.05
DRAWN_BY = {'graphics card', 'processor'}


class Camera(Thread):
    """A server that shows a bright disc straight ahead, twice as wide as some cards take."""

    def __init__(self):
        super().__init__()
        self.url, self.on = None, True
        self._file = cv2.imencode('.jpg', world_with_disc())[1].tobytes()
        self._ending = False

    def run(self):
        """Serve until the end."""
        asyncio.run(self._serve())

    async def _serve(self):
        async with site() as one:
            self.url = one.url
            while not self._ending:
                now_s = asyncio.get_running_loop().time()
                if self.on:
                    one.server.show(Picture(round(1e9 * now_s), self._file, now_s,
                                            Orientation(IDENTITY, IDENTITY)))
                await asyncio.sleep(PERIOD_S)

    def end(self):
        """End serving."""
        self._ending = True
        self.join()


@pytest.fixture(scope='module')
def camera():
    camera = Camera()
    camera.start()
    wait_until(lambda: camera.url)
    try:
        yield camera
    finally:
        camera.end()


@pytest.fixture
def opened(camera, browser):
    """Return what opens a page in a browser that a script has changed."""
    pages = []

    def open_page(change='() => {}', query='?renderer=webgl'):
        pages.append(Page(browser, 'about:blank'))
        pages[-1].context.add_init_script(f'({change})();')
        pages[-1].page.goto(camera.url + query)
        return pages[-1]
    yield open_page
    for page in pages:
        page.context.close()


def drawn_by(page):
    wait_until(lambda: page.page.text_content('#drawn-by') in DRAWN_BY, page.situation)
    return page.page.text_content('#drawn-by')


def is_black(page):
    """Tell whether the processor has drawn nothing."""
    return page.page.evaluate("""() => {
        const canvas = document.querySelector('#picture canvas');
        const {data} = canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height);
        return data.every((value, n) => n % 4 === 3 || value === 0);
    }""")


def test_a_card_of_a_telephone_draws_what_it_takes(opened):
    page = opened(SMALL_CARD)
    page.wait_for_situation('stabilized')
    assert drawn_by(page) == 'graphics card'
    assert abs(page.disc_deg()) < 1
    assert not page.errors


@pytest.mark.parametrize('change, reason', [
    (NO_CARD, 'This browser has no WebGL 2.'),
    (NO_MEMORY, 'The graphics card fails (WebGL error 1285).'),
    (BLIND, 'The graphics card draws nothing.')])
def test_the_processor_draws_where_the_card_does_not_and_that_is_said(opened, change, reason):
    page = opened(change)
    wait_until(lambda: page.page.text_content('#notice').startswith(reason), page.situation)
    page.wait_for_situation('stabilized')
    assert drawn_by(page) == 'processor'
    assert abs(page.disc_deg()) < 1
    assert not page.errors


def test_without_a_card_nothing_is_said(opened):
    """It is as it always is there."""
    page = opened(NO_CARD, '')
    page.wait_for_situation('stabilized')
    assert drawn_by(page) == 'processor'
    assert page.page.text_content('#notice') == ''


LOSE = """() => document.querySelector('#picture canvas').getContext('webgl2')
    .getExtension('WEBGL_lose_context').loseContext()"""


def test_a_card_that_is_taken_away_is_replaced(opened):
    page = opened()
    page.wait_for_situation('stabilized')
    assert drawn_by(page) == 'graphics card'
    page.page.evaluate(LOSE)
    wait_until(lambda: page.page.text_content('#notice').startswith(
        'The graphics card was taken away.'), page.situation)
    page.wait_for_picture_after(page.stamp_ns)
    page.wait_for_situation('stabilized')
    assert drawn_by(page) == 'processor'
    assert abs(page.disc_deg()) < 1
    # What is dragged still moves.
    page.page.mouse.move(550, 300)
    page.page.mouse.down()
    page.page.mouse.move(630, 300, steps=4)
    page.page.mouse.up()
    page.wait_for_picture_after(page.stamp_ns)
    assert page.disc()[0] == pytest.approx(80, abs=6)
    assert not page.errors


def test_a_page_that_shows_nothing_says_so(opened, camera):
    """The camera is silent when the card is taken away: what was on the screen is gone."""
    page = opened()
    page.wait_for_situation('stabilized')
    camera.on = False
    try:
        wait_until(lambda: page.page.get_attribute('html', 'data-situation') == 'silent')
        page.page.evaluate(LOSE)
        wait_until(lambda: drawn_by(page) == 'processor')
        assert is_black(page)
        page.wait_for_situation('silent')
    finally:
        camera.on = True
    page.wait_for_situation('stabilized')
    assert not is_black(page)


def test_a_browser_that_cannot_draw_at_all_says_so(opened):
    page = opened("""() => { HTMLCanvasElement.prototype.getContext = () => null; }""", '')
    page.wait_for_situation('unable')
    assert 'no canvas to draw on' in page.page.inner_text('#alarm')
