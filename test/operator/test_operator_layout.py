# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""How the operator's page looks and sounds: screens, alarms, contrast, landmarks."""

import asyncio
from dataclasses import dataclass
from threading import Thread

import cv2
import numpy as np
import pytest

pytest.importorskip('rclpy', reason='rclpy is not installed')
pytest.importorskip('aiohttp', reason='aiohttp is not installed')
from operator_harness import chromium, Page, wait_until  # noqa: E402, I100
from operator_site import IDENTITY, site  # noqa: E402
from sph_stab_ros.operator.pairing import Orientation, Picture  # noqa: E402

SCREENS = (360, 640), (640, 360), (740, 360), (600, 960), (820, 1180), (1366, 768), (3840, 2160)
PERIOD_S = 0.05


@dataclass(frozen=True)
class State:
    """What the page is told of a robot, see RobotState."""

    camera: bool = True
    tracking: str = 'ok'
    healthy: bool = True
    message: str = 'ok'
    rate_hz: str = '30.0'
    latency_ms: str = '20.0'
    modes: tuple = ('lock', 'follow', 'yaw_follow')
    mode: str = 'lock'
    can_reset: bool = True
    can_level: bool = True


class Served(Thread):
    """A server that shows grey pictures of a robot in the State ``state``."""

    def __init__(self):
        super().__init__()
        self.state, self.late_s, self.url = State(), 0., None
        self._file = cv2.imencode('.jpg', np.full((64, 128, 3), 128, np.uint8))[1].tobytes()
        self._ending = False

    def run(self):
        """Serve until the end."""
        asyncio.run(self._serve())

    async def _serve(self):
        async with site() as one:
            self.url = one.url
            while not self._ending:
                one.robot.state = self.state
                now_s = asyncio.get_running_loop().time()
                one.server.show(Picture(
                    round(1e9 * now_s), self._file, now_s - self.late_s,
                    Orientation(IDENTITY, IDENTITY)))
                await asyncio.sleep(PERIOD_S)

    def end(self):
        """End serving."""
        self._ending = True
        self.join()


@pytest.fixture(scope='module')
def browser():
    with chromium() as browser:
        yield browser


@pytest.fixture(scope='module')
def served():
    served = Served()
    served.start()
    try:
        yield served
    finally:
        served.end()


@pytest.fixture(scope='module')
def shared_page(served, browser):
    wait_until(lambda: served.url)
    page = Page(browser, served.url)
    yield page
    assert not page.errors
    page.context.close()


@pytest.fixture
def page(served, shared_page):
    served.state, served.late_s = State(), 0.
    shared_page.wait_for_situation('stabilized')
    return shared_page


PANELS = """() => [...document.querySelectorAll(
        'header > :not(h1), #alarm, #attitude, #control, nav')]
    .filter(one => one.checkVisibility()).map(one => [one, one.getBoundingClientRect()])"""
OUTSIDE = """() => [...document.querySelectorAll(
        'header > :not(h1), header dd, nav button, nav label, #attitude, #alarm')]
    .filter(one => one.checkVisibility()).filter(one => {
        const box = one.getBoundingClientRect();
        return box.left < 0 || box.top < 0 || box.right > innerWidth || box.bottom > innerHeight ||
            one.scrollWidth > one.clientWidth + 1;
    }).map(one => one.id || one.textContent)"""
OVERLAPPING = f"""() => {{
    const panels = ({PANELS})();
    return panels.flatMap(([one, a], n) => panels.slice(n + 1).filter(([, b]) =>
        a.left < b.right && b.left < a.right && a.top < b.bottom && b.top < a.bottom
    ).map(([other]) => `${{one.id}} ${{other.id}}`));
}}"""
SMALL = """() => [...document.querySelectorAll('nav button, nav label, #take')]
    .filter(one => one.checkVisibility()).map(one => [one, one.getBoundingClientRect()])
    .filter(([, box]) => box.width < 44 || box.height < 44)
    .map(([one, {width, height}]) => `${one.id || one.textContent} ${width}x${height}`)"""


def at_all_sizes(page, faults):
    """Return a script's findings by the sizes of screens that have any."""
    found = {}
    for width, height in SCREENS:
        page.page.set_viewport_size({'width': width, 'height': height})
        if faulty := page.page.evaluate(faults):
            found[width, height] = faulty
    return found


@pytest.mark.parametrize('state, name', [
    (State(), 'stabilized'), (State(tracking='lost', healthy=False), 'lost'),
    (State(healthy=False, message='no rotation found: predicted'), 'doubtful')],
    ids=['ok', 'lost', 'doubtful'])
def test_everything_is_on_the_screen(served, page, browser, state, name):
    """Also for who watches, and when the pictures are late."""
    served.state, served.late_s = state, 1.
    watching = Page(browser, served.url, has_touch=True)
    try:
        for one in (page, watching):
            one.wait_for_situation(name)
            wait_until(lambda: one.page.is_visible('#latency.late'))
            assert not at_all_sizes(one, OUTSIDE)
            assert not at_all_sizes(one, OVERLAPPING)
        assert not at_all_sizes(watching, SMALL)
    finally:
        watching.context.close()


def test_landmarks(page):
    for role in ('banner', 'main', 'navigation'):
        assert page.page.get_by_role(role).count() == 1
    assert page.page.get_by_role('application', name='Live view').count() == 1
    unnamed = page.page.evaluate(
        '[...document.querySelectorAll("button")].filter(b => !(b.ariaLabel || '
        'b.textContent.trim())).map(b => b.id)')
    assert not unnamed


def test_text_can_be_read_by_day_and_by_night(page):
    """Contrast is that of WCAG, on the panels over the blackest and the whitest picture."""
    for scheme in ('light', 'dark'):
        page.page.emulate_media(color_scheme=scheme)
        assert page.page.evaluate(CONTRAST) > 4.5


CONTRAST = """() => {
    const style = getComputedStyle(document.documentElement);
    const rgba = name => {
        const hex = style.getPropertyValue(name).trim().slice(1);
        const whole = hex.length < 6 ? [...hex].map(c => c + c).join('') : hex;
        return whole.match(/../g).map(c => parseInt(c, 16) / 255);
    };
    const luminance = ([r, g, b]) => {
        const [R, G, B] = [r, g, b].map(
            c => c <= .04045 ? c / 12.92 : ((c + .055) / 1.055) ** 2.4);
        return .2126 * R + .7152 * G + .0722 * B;
    };
    const [r, g, b, alpha = 1] = rgba('--panel');
    let worst = Infinity;
    for (const behind of [0, 1]) {
        const panel = [r, g, b].map(c => c * alpha + behind * (1 - alpha));
        for (const name of ['--text', '--quiet', '--accent', '--robot']) {
            const [low, high] = [luminance(rgba(name)), luminance(panel)].sort((a, b) => a - b);
            worst = Math.min(worst, (high + .05) / (low + .05));
        }
    }
    return worst;
}"""


@pytest.mark.parametrize('changes, name, alarm', [
    ({}, 'stabilized', False),
    ({'raw': True}, 'raw', False),
    ({'robot': {'tracking': 'predicted'}}, 'doubtful', False),
    ({'robot': {'tracking': 'uncertain'}}, 'doubtful', False),
    ({'robot': {'tracking': 'ok', 'message': 'images are refused', 'healthy': False}},
     'doubtful', False),
    ({'robot': {'tracking': 'lost'}}, 'lost', True),
    ({'robot': {'tracking': 'lost'}, 'raw': True}, 'lost', True),
    ({'stabilized': False, 'robot': {'tracking': 'lost'}}, 'unstabilized', True),
    ({'pictureAt': 8000, 'stabilized': False}, 'silent', True),
    ({'pictureAt': None, 'connectedAt': 9000}, 'connecting', False),
    ({'pictureAt': None, 'connectedAt': 1000}, 'silent', True),
    ({'connectedAt': None, 'pictureAt': 8000}, 'offline', True),
    ({'failure': 'no WebGL'}, 'unable', True)], ids=str)
def test_the_worst_is_said_first(page, changes, name, alarm):
    state = {'failure': '', 'connectedAt': 0, 'reason': '', 'pictureAt': 9990, 'now': 10000,
             'stabilized': True, 'raw': False, 'robot': {'tracking': 'ok', 'healthy': True}}
    said = page.page.evaluate(
        'async state => (await import("/situation.js")).situation(state)', {**state, **changes})
    assert said['name'] == name
    assert bool(said.get('alarm')) == alarm
    # Colour is not the only sign.
    assert said['text'] and said['icon']


def test_lost_tracking_is_seen_and_heard(served, page):
    served.state = State(tracking='lost', healthy=False)
    page.wait_for_situation('lost')
    alarm = page.page.get_by_role('alert')
    assert alarm.is_visible() and 'Tracking lost' in alarm.inner_text()
    # Stripes around all of it.
    assert page.page.evaluate(
        'getComputedStyle(document.body, "::after").borderImageSource').startswith('repeating')
    served.state = State()
    page.wait_for_situation('stabilized')
    assert page.page.get_by_role('alert').count() == 0
