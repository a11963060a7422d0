# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""How the operator's page looks and sounds: screens, alarms, contrast, landmarks."""

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='rclpy is not installed')
pytest.importorskip('aiohttp', reason='aiohttp is not installed')
from operator_harness import Page, wait_until  # noqa: E402, I100
from operator_served import Served, State  # noqa: E402

SCREENS = (360, 640), (640, 360), (740, 360), (600, 960), (820, 1180), (1366, 768), (3840, 2160)
HEADSET = """Object.defineProperty(navigator, 'xr', {
    value: {isSessionSupported: async () => true}});"""
# A small phone on its side, and a laptop at 400 %: these scroll.
TINY = (568, 320), (320, 256)


@pytest.fixture(scope='module')
def served():
    served = Served()
    served.start()
    try:
        yield served
    finally:
        served.end()


class Offered(Page):
    """The page with every button that some browser offers."""

    def __init__(self, browser, address, **options):
        super().__init__(browser, 'about:blank', **options)
        self.context.add_init_script(HEADSET)
        self.page.goto(address)
        wait_until(lambda: self.page.is_visible('#headset'), self.situation)


@pytest.fixture(scope='module')
def shared_page(served, browser):
    wait_until(lambda: served.url)
    page = Offered(browser, served.url)
    yield page
    assert not page.errors
    page.context.close()


@pytest.fixture
def page(served, shared_page):
    served.state, served.late_s = State(), 0.
    shared_page.wait_for_situation('stabilized')
    return shared_page


PANELS = """() => [...document.querySelectorAll(
        'header > :not(h1), #alarm, #attitude, #control, #notice:not(:empty), nav')]
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
    pytest.param(State(healthy=False, message='no rotation found: predicted'), 'doubtful',
                 marks=pytest.mark.slow)],
    ids=['ok', 'lost', 'doubtful'])
def test_everything_is_on_the_screen(served, page, browser, state, name):
    """Also for who watches, and when the pictures are late."""
    served.state, served.late_s = state, 1.
    watching = Offered(browser, served.url, has_touch=True)
    try:
        for one in (page, watching):
            one.wait_for_situation(name)
            wait_until(lambda: one.page.is_visible('#latency.late'))
            assert not at_all_sizes(one, OUTSIDE)
            assert not at_all_sizes(one, OVERLAPPING)
        assert not at_all_sizes(watching, SMALL)
    finally:
        watching.context.close()


# Buttons that cannot be seen whole and pressed, wherever one scrolls to.
UNREACHABLE = """() => [...document.querySelectorAll('button, nav label')]
    .filter(one => one.checkVisibility()).filter(one => {
        one.scrollIntoView({block: 'center', behavior: 'instant'});
        const {left, top, right, bottom} = one.getBoundingClientRect();
        const [x, y] = [(left + right) / 2, (top + bottom) / 2];
        return left < 0 || top < 0 || right > innerWidth || bottom > innerHeight ||
            one.scrollWidth > one.clientWidth + 1 ||
            !one.contains(document.elementFromPoint(x, y));
    }).map(one => one.id || one.textContent)"""


def test_a_notice_covers_no_button(served, page, browser):
    watching = Offered(browser, served.url, has_touch=True)
    try:
        watching.wait_for_situation('stabilized')
        # Refused, as somebody else has control.
        watching.page.keyboard.press('r')
        wait_until(lambda: watching.page.inner_text('#notice'))
        for width, height in (*SCREENS, *TINY):
            watching.page.set_viewport_size({'width': width, 'height': height})
            watching.page.keyboard.press('r')
            assert not watching.page.evaluate(UNREACHABLE), (width, height)
            assert watching.page.inner_text('#notice')
    finally:
        watching.context.close()


@pytest.mark.parametrize('state', [State(), State(tracking='lost', healthy=False)],
                         ids=['ok', 'lost'])
def test_everything_is_reached_on_tiny_screens(served, page, browser, state):
    """By scrolling in one direction alone."""
    served.state = state
    watching = Offered(browser, served.url, has_touch=True)
    try:
        for one in (page, watching):
            one.wait_for_situation('lost' if state.tracking == 'lost' else 'stabilized')
            for width, height in TINY:
                one.page.set_viewport_size({'width': width, 'height': height})
                assert not one.page.evaluate(UNREACHABLE), (width, height)
                assert not one.page.evaluate(
                    'document.documentElement.scrollWidth > innerWidth'), (width, height)
    finally:
        watching.context.close()


def test_losing_control_is_said(served, page, browser):
    """In a place that was there, and empty, before: what comes with its text is not read out."""
    page.page.click('#take') if page.page.is_visible('#take') else None
    wait_until(lambda: not page.page.is_visible('#control'))
    wait_until(lambda: not page.page.text_content('#notice'))
    told = page.page.locator('#notice[role=status]')
    assert told.evaluate('one => one.checkVisibility()')
    other = Page(browser, served.url)
    try:
        other.page.click('#take')
        wait_until(lambda: page.page.inner_text('#notice')
                   == 'Another operator has taken control.')
    finally:
        other.context.close()
        wait_until(lambda: 'Nobody' in page.page.inner_text('#control'))
        page.page.click('#take')


def test_no_more_pixels_are_drawn_than_the_picture_has(served, page):
    """Where they are slow; a picture of 128 columns has 49 within 100°, 11 within 30°."""
    page.page.set_viewport_size({'width': 3840, 'height': 2160})
    size = '() => (one => [one.width, one.height])(document.querySelector("#picture canvas"))'
    wait_until(lambda: page.page.evaluate(size) == [49, 27], lambda: page.page.evaluate(size))
    for _ in range(20):
        page.page.keyboard.press('+')
    fov_deg = page.number('fov')
    columns = 128 * np.tan(np.deg2rad(fov_deg) / 2) / np.pi
    wait_until(lambda: abs(page.page.evaluate(size)[0] - columns) <= 1)
    for _ in range(20):
        page.page.keyboard.press('-')


@pytest.mark.parametrize('encrypted, secure, advised', [
    (True, True, False), (False, True, False), (False, False, True)])
def test_what_the_link_is_made_of_is_said(page, encrypted, secure, advised):
    text = page.page.evaluate('async link => (await import("/panels.js")).linkText(link)', {
        'encrypted': encrypted, 'secure': secure, 'slow': True})
    assert 'JPEG by ' + ('https' if encrypted else 'http,') in text and 'the processor' in text
    assert ('By https' in text) == advised
    # This page's, at loopback.
    page.page.keyboard.press('?')
    assert 'JPEG by http,' in page.page.inner_text('#link')
    page.page.keyboard.press('Escape')


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
