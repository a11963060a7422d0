# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The operator's page in a real browser, with a real stabilizer behind a real server."""

import signal
from urllib.parse import urlsplit

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from sph_stab_ros.geometry.warp import view_rotation
from synthetic import random_rotation

pytest.importorskip('rclpy', reason='rclpy is not installed')
pytest.importorskip('aiohttp', reason='aiohttp is not installed')
from operator_harness import (  # noqa: E402, I100
    find_chromium, Page, Robot, TOKEN, wait_until, yaw_deg)


@pytest.fixture(scope='module')
def robot(tmp_path_factory):
    find_chromium()
    robot = Robot(tmp_path_factory.mktemp('robot'))
    try:
        robot.start_stabilizer()
        robot.address = robot.start_operator()
        yield robot
        assert robot.stop('operator') == 0
    finally:
        robot.close()


@pytest.fixture(scope='module')
def shared_page(robot, browser):
    page = Page(browser, robot.address)
    yield page
    assert not page.errors
    page.context.close()


@pytest.fixture
def page(robot, shared_page):
    """Return the page as it is at the beginning: the robot looks ahead, and so do we."""
    robot.turn(0)
    shared_page.wait_for_situation('stabilized')
    shared_page.page.keyboard.press('Home')
    shared_page.page.click('#reset')
    wait_until(lambda: shared_page.page.text_content('#notice').startswith('Heading reset'))
    # Pictures taken before the reset may still be on their way: one of those defines nothing.
    shared_page.wait_for_picture_after(robot.turn(0))
    shared_page.page.evaluate('document.getElementById("notice").textContent = ""')
    return shared_page


def test_the_picture_appears_and_moves(page):
    stamps_ns = []
    for _ in range(5):
        stamps_ns.append(page.stamp_ns)
        page.wait_for_picture_after(stamps_ns[-1])
    assert sorted(set(stamps_ns)) == stamps_ns
    assert abs(page.disc_deg()) < 1
    wait_until(lambda: page.number('rate'))
    wait_until(lambda: page.number('latency'))


def test_nothing_is_asked_of_anybody_else(robot, page):
    hosts = {urlsplit(url).netloc for url in page.requests}
    assert hosts == {urlsplit(robot.address).netloc}


def test_the_world_stays_while_the_camera_turns(robot, page):
    shown_deg, raw_deg = [], []
    for turned_deg in np.arange(0, 30.1, 3):
        before_ns = robot.turn(turned_deg)
        # The one being taken may still be the last.
        page.wait_for_picture_after(before_ns + 10**9 // 10)
        shown_deg.append(page.disc_deg())
        if turned_deg in (0, 30):
            page.page.keyboard.press('b')
            page.wait_for_situation('raw')
            raw_deg.append(page.disc_deg())
            page.page.keyboard.press('b')
            page.wait_for_situation('stabilized')
    # To the left, and so all that it sees goes to the right.
    assert raw_deg[1] - raw_deg[0] == pytest.approx(30, abs=1)
    assert np.ptp(shown_deg) < 1
    wait_until(lambda: '30° to the left' in page.page.get_attribute('#tape', 'aria-label'))


def test_a_drag_moves_the_world_without_the_server(robot, page):
    """What is dragged stays under the pointer, also while the server stands still."""
    mouse = page.page.mouse
    x, y = page.disc()
    robot.looks.clear()
    robot.send_signal('operator', signal.SIGSTOP)
    try:
        mouse.move(550, 300)
        mouse.down()
        mouse.move(630, 320, steps=8)
        moved_x, moved_y = page.disc()
        mouse.up()
        assert moved_x - x == pytest.approx(80, abs=4)
        assert moved_y - y == pytest.approx(20, abs=4)
        assert not robot.looks
    finally:
        robot.send_signal('operator', signal.SIGCONT)
    heading_deg = page.heading_deg()
    assert heading_deg < -5
    wait_until(lambda: robot.looks and abs(yaw_deg(robot.looks[-1]) + heading_deg) < 0.6)


def test_keyboard_alone(robot, page):
    keyboard = page.page.keyboard
    robot.looks.clear()
    keyboard.down('ArrowRight')
    wait_until(lambda: page.heading_deg() > 5)
    keyboard.up('ArrowRight')
    wait_until(lambda: robot.looks and yaw_deg(robot.looks[-1]) < -5)
    keyboard.press('+')
    wait_until(lambda: page.number('fov') < 100)
    keyboard.press('?')
    assert page.page.get_by_role('dialog').is_visible()
    keyboard.press('Escape')
    keyboard.press('Home')
    wait_until(lambda: page.heading_deg() == 0)
    reached = []
    page.page.evaluate('document.activeElement.blur()')
    for _ in range(30):
        keyboard.press('Tab')
        reached.append(page.page.evaluate('document.activeElement.id'))
    assert {'picture', 'reset', 'level', 'centre', 'before', 'out', 'in', 'full', 'keys'} <= {
        *reached}
    page.page.evaluate('document.activeElement.blur()')


def test_reset_heading(robot, page):
    before_ns = robot.turn(12)
    page.wait_for_picture_after(before_ns + 10**9 // 10)
    assert abs(page.disc_deg()) < 1
    page.page.click('#reset')
    wait_until(lambda: abs(yaw_deg(robot.orientations[-1])) < 0.5)
    page.wait_for_picture_after(page.stamp_ns + 3 * 10**8)
    assert page.disc_deg() == pytest.approx(12, abs=1)
    assert page.heading_deg() == 0


def test_level(robot, page):
    robot.turn(0, roll_deg=10)
    wait_until(lambda: page.page.inner_text('#roll') == '+10°', page.situation)
    page.page.keyboard.press('l')
    wait_until(lambda: page.page.inner_text('#notice') == 'The present orientation becomes level.')
    wait_until(lambda: page.page.inner_text('#roll') == '0°', page.situation)


def test_modes(robot, page):
    page.page.locator('input[value=follow]').check()
    wait_until(page.page.locator('input[value=follow]').is_checked)
    # Arrow keys are for looking around again, not for the next mode.
    assert page.page.evaluate('document.activeElement.id') == 'picture'
    # The view comes after the camera, whatever way that went.
    robot.turn(10)
    wait_until(lambda: abs(page.heading_deg() + 10) < 2)
    page.page.keyboard.press('m')
    wait_until(page.page.locator('input[value=yaw_follow]').is_checked)
    page.page.locator('input[value=lock]').check()
    wait_until(page.page.locator('input[value=lock]').is_checked)


def test_gamepad(page):
    page.page.evaluate("""() => {
        const pad = {mapping: 'standard', index: 0, axes: [0, 0, 1, 0],
                     buttons: Array.from({length: 17}, () => ({pressed: false, value: 0}))};
        navigator.getGamepads = () => [pad];
        dispatchEvent(new Event('gamepadconnected'));
    }""")
    wait_until(lambda: page.heading_deg() > 20)
    page.page.evaluate("""() => {
        const [pad] = navigator.getGamepads();
        pad.axes[2] = 0;
        pad.buttons[0].pressed = true;
    }""")
    wait_until(lambda: page.heading_deg() == 0)
    # What there is without TLS in some browsers; keys go on working.
    page.page.evaluate('navigator.getGamepads = undefined')
    page.page.keyboard.down('ArrowRight')
    wait_until(lambda: page.heading_deg() > 10)
    page.page.keyboard.up('ArrowRight')


def test_rotations_are_those_of_the_package(page):
    rng = np.random.default_rng(0)
    for _ in range(20):
        yaw, pitch, roll = rng.uniform((-3.1, -1.5, -3.1), (3.1, 1.5, 3.1))
        R, S = random_rotation(rng, 100), view_rotation(yaw, pitch, roll)
        got = page.page.evaluate("""async ([yaw, pitch, R, S]) => {
            const {anglesOf, fromYawPitch, inverse, matrix, multiply} =
                await import('/rotation.js');
            return [fromYawPitch(yaw, pitch), multiply(R, inverse(S)), matrix(R), anglesOf(S)];
        }""", [yaw, pitch, *(one.as_quat().tolist() for one in (R, S))])
        assert (Rotation.from_quat(got[0]).inv() * view_rotation(yaw, pitch)).magnitude() < 1e-9
        assert (Rotation.from_quat(got[1]).inv() * (R * S.inv())).magnitude() < 1e-9
        np.testing.assert_allclose(np.reshape(got[2], (3, 3)).T, R.as_matrix(), atol=1e-12)
        np.testing.assert_allclose([got[3]['yaw'], got[3]['pitch'], got[3]['roll']],
                                   [yaw, pitch, roll], atol=1e-9)


def test_a_second_browser_watches_and_delays_nobody(robot, page, browser):
    second = Page(browser, robot.address)
    try:
        second.wait_for_situation('stabilized')
        assert second.page.inner_text('#control').startswith('Watching')
        # Nothing more comes from the second: it does not even say that it has drawn.
        second.page.evaluate('() => { WebSocket.prototype.send = () => {}; }')
        for _ in range(10):
            page.wait_for_picture_after(page.stamp_ns)
        stuck_ns = second.stamp_ns
        page.wait_for_picture_after(page.stamp_ns)
        assert second.stamp_ns == stuck_ns < page.stamp_ns
    finally:
        second.context.close()


def test_control_is_taken_by_a_click(robot, page, browser):
    second = Page(browser, robot.address)
    try:
        second.page.click('#take')
        wait_until(lambda: 'another operator' in page.page.inner_text('#control'))
        robot.looks.clear()
        second.page.keyboard.press('ArrowUp')
        wait_until(lambda: robot.looks and robot.looks[-1].magnitude() > 0.01)
        page.page.click('#take')
        wait_until(lambda: not page.page.is_visible('#control'))
    finally:
        second.context.close()


def test_what_is_no_sphere_is_not_shown_as_one(robot, page):
    robot.film(np.full((300, 512, 3), 128, np.uint8))
    page.wait_for_situation('unable')
    # Also where its video has half of the width.
    assert '512×300' in page.page.inner_text('#alarm')
    robot.turn(0)
    page.wait_for_situation('stabilized')


def test_pinch_zooms(robot, browser):
    page = Page(browser, robot.address, has_touch=True)
    try:
        page.wait_for_situation('stabilized')
        fingers = page.context.new_cdp_session(page.page)
        for kind, spread in (('touchStart', 40), ('touchMove', 80), ('touchMove', 120),
                             ('touchEnd', None)):
            points = [] if spread is None else [
                {'x': 400 + sign * spread, 'y': 300, 'id': n} for n, sign in enumerate((-1, 1))]
            fingers.send('Input.dispatchTouchEvent', {'type': kind, 'touchPoints': points})
        wait_until(lambda: page.number('fov') < 60)
    finally:
        page.context.close()


def test_a_wrong_token_gets_403(robot, browser):
    for query in ('', '?token=wrong'):
        page = Page(browser, robot.address.split('?')[0] + query)
        assert page.answer.status == 403
        page.context.close()
    assert TOKEN in robot.address


@pytest.mark.slow
def test_node_and_server_come_back_by_themselves(robot, page):
    robot.stop('stabilizer', signal.SIGKILL)
    page.wait_for_situation('unstabilized')
    assert page.page.get_by_role('alert').is_visible()
    # The picture goes on, with the warning.
    page.wait_for_picture_after(page.stamp_ns)
    robot.start_stabilizer()
    page.wait_for_situation('stabilized')
    robot.stop('operator', signal.SIGKILL)
    page.wait_for_situation('offline')
    robot.start_operator(urlsplit(robot.address).port)
    page.wait_for_situation('stabilized')
    page.wait_for_picture_after(page.stamp_ns)
