# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
"""The operator's page in a headset, by an emulator of one: what its two eyes see."""

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from sph_stab_ros.geometry.warp import rotate_equirect, view_rotation

pytest.importorskip('rclpy', reason='rclpy is not installed')
pytest.importorskip('aiohttp', reason='aiohttp is not installed')
from operator_harness import Page, wait_until, world_with_disc, yaw_deg  # noqa: E402, I100
from operator_served import Served, State  # noqa: E402
from sph_stab_ros.operator.pairing import Orientation, Picture  # noqa: E402
from xr_emulator import emulator  # noqa: E402

# What a new picture takes, signs left out, and what each eye does.
COUNT = """() => {
    const card = WebGL2RenderingContext.prototype, {texImage2D, drawArraysInstanced} = card;
    window.counted = {uploads: 0, spheres: 0};
    card.texImage2D = function (...all) {
        window.counted.uploads += !(all.at(-1) instanceof OffscreenCanvas);
        return texImage2D.apply(this, all);
    };
    card.drawArraysInstanced = function (...all) {
        window.counted.spheres += all[3] > 2;
        return drawArraysInstanced.apply(this, all);
    };
}"""
LOCKED = Rotation.identity()
TURN = """([x, y, z, w]) => window.worn.quaternion.set(x, y, z, w)"""
ALARM_BGR = 0, 176, 255
# When the next two pictures of the display are there.
SHOWN = """() => new Promise(resolve =>
    requestAnimationFrame(() => requestAnimationFrame(() => requestAnimationFrame(resolve))))"""


class Turning(Served):
    """Serves the sphere with a disc as a camera sees that is turned."""

    def __init__(self, **options):
        super().__init__(**options)
        self._world = world_with_disc()
        self.turn(0)

    def turn(self, yaw_deg, roll_deg=0, R_world_virtual=LOCKED):
        """Turn the camera, and what follows it; return a list for the first stamp from then."""
        R = view_rotation(np.deg2rad(yaw_deg), 0, np.deg2rad(roll_deg))
        file = cv2.imencode('.jpg', rotate_equirect(self._world, R))[1].tobytes()
        first_ns = []
        self._shown = file, Orientation(*(
            tuple(one.as_quat().tolist()) for one in (R, R_world_virtual))), first_ns
        return first_ns

    def picture(self, now_s):
        """Return what the camera gives next."""
        file, orientation, first_ns = self._shown
        stamp_ns = round(1e9 * now_s)
        if not first_ns:
            first_ns.append(stamp_ns)
        return Picture(stamp_ns, file, now_s, orientation)


class Wearer(Page):
    """Somebody who wears a headset, and looks ahead."""

    EYE_WH = 550, 600
    # The headset's field of view is 90° high.
    FOCAL_PX = 300.

    def __init__(self, browser, served):
        super().__init__(browser, 'about:blank')
        self.context.add_init_script(emulator())
        self.page.goto(served.url)
        self.wait_for_situation('stabilized')
        self.enter()

    def enter(self):
        """Put it on."""
        wait_until(lambda: self.page.is_visible('#headset'))
        self.page.keyboard.press('h')
        wait_until(self.is_worn)
        self.wait_for_situation('stabilized')

    def wait_for(self, first_ns):
        """Wait for what a Turning camera has turned to."""
        wait_until(lambda: first_ns and self.stamp_ns >= first_ns[0], self.situation)
        self.page.evaluate(SHOWN)

    def is_worn(self):
        """Tell whether there is a session."""
        return self.page.evaluate('Boolean(window.worn.activeSession)')

    def turn(self, yaw_deg, pitch_deg=0, roll_deg=0):
        """Turn the head, and wait until that is shown."""
        x, y, z, w = view_rotation(*np.deg2rad((yaw_deg, pitch_deg, roll_deg))).as_quat()
        # WebXR has y up and z backwards.
        self.page.evaluate(TURN, [x, -y, -z, w])
        self.page.evaluate(SHOWN)

    def press(self, button, value=1):
        """Press a button of the right hand's controller, or let it go."""
        self.page.evaluate(
            '([id, value]) => window.worn.controllers.right.updateButtonValue(id, value)',
            [button, value])
        self.page.evaluate(SHOWN)

    def push(self, right):
        """Push the right hand's stick to the right."""
        self.page.evaluate(
            "x => window.worn.controllers.right.updateAxes('thumbstick', x, 0)", right)
        self.page.evaluate(SHOWN)

    def sees_alarm(self):
        """Tell whether there is a sign in both eyes, in the colour of alarms."""
        return all((np.abs(eye.astype(int) - ALARM_BGR).max(axis=2) < 40).sum() > 1000
                   for eye in self.eyes())

    def has_tunnel(self):
        """Tell whether both eyes see nothing at their edges."""
        return all(eye[:, :10].max() < 5 for eye in self.eyes())

    def eyes(self):
        """Return what the left and the right eye see."""
        shot = cv2.imdecode(np.frombuffer(self.page.screenshot(), np.uint8), cv2.IMREAD_COLOR)
        width = self.EYE_WH[0]
        return shot[:, :width], shot[:, width:]

    def disc_deg(self):
        """Return how far the disc is right of and below the middle, by eye."""
        return [self._disc_deg(eye) for eye in self.eyes()]

    def _disc_deg(self, eye):
        # Alarms are as bright, but yellow; letters are not as large.
        bright = (eye.min(axis=2) > 200).astype(np.uint8)
        assert bright.any(), 'no disc in the picture'
        _, _, stats, centres = cv2.connectedComponentsWithStats(bright)
        n = 1 + np.argmax(stats[1:, cv2.CC_STAT_AREA])
        assert stats[n, cv2.CC_STAT_AREA] > 200, 'no disc in the picture'
        x, y = centres[n] - (np.array(self.EYE_WH) - 1) / 2
        return np.rad2deg(np.arctan2((x, y), (self.FOCAL_PX, np.hypot(self.FOCAL_PX, x))))


@pytest.fixture(scope='module')
def served():
    with Turning() as served:
        yield served


@pytest.fixture
def wearer(served, browser):
    served.state, served.on = State(), True
    served.turn(0)
    wearer = Wearer(browser, served)
    yield wearer
    wearer.context.close()
    assert not wearer.errors


@pytest.fixture
def look(served):
    """Return what tells the R_virtual_view that was published last."""
    return lambda: Rotation.from_quat(served.robot.looks[-1])


def test_both_eyes_see_the_world(wearer):
    left, right = wearer.disc_deg()
    np.testing.assert_allclose(left, 0, atol=1)
    np.testing.assert_allclose(right, 0, atol=1)


def test_a_turned_head_sees_the_world_turned_at_once(served, wearer):
    """Also while no picture comes: nothing is asked of anybody, nothing goes to the card."""
    served.on = False
    wearer.wait_for_situation('silent')
    wait_until(lambda: wearer.stamp_ns == served.last_ns)
    wearer.wait_for_situation('silent')
    wearer.page.evaluate(COUNT)
    for left_deg, up_deg in ((30, 0), (0, 30)):
        wearer.turn(left_deg, up_deg)
        for angles in wearer.disc_deg():
            np.testing.assert_allclose(angles, (left_deg, up_deg), atol=1)
    counted = wearer.page.evaluate('window.counted')
    assert counted['spheres'] >= 8
    assert counted['uploads'] == 0


def test_the_world_stands_while_the_robot_turns(served, wearer):
    for left_deg, roll_deg in ((30, 0), (-60, 20)):
        wearer.wait_for(served.turn(left_deg, roll_deg))
        for angles in wearer.disc_deg():
            np.testing.assert_allclose(angles, 0, atol=1)


@pytest.mark.slow
def test_the_horizon_is_level_and_what_is_seen_is_published(served, wearer, look):
    """Also where the stabilizer's view leans, as it may when it follows."""
    R_world_virtual = view_rotation(*np.deg2rad((20, 5, 15)))
    wearer.wait_for(served.turn(0, 0, R_world_virtual))
    wearer.turn(-15)
    for angles in wearer.disc_deg():
        np.testing.assert_allclose(angles, (5, 0), atol=1)
    seen = view_rotation(np.deg2rad(5), 0)
    wait_until(lambda: (R_world_virtual * look() * seen.inv()).magnitude() < 0.01)


@pytest.mark.slow
def test_who_only_watches_publishes_nothing(served, wearer, look, browser):
    other = Page(browser, served.url)
    try:
        other.page.click('#take')
        wait_until(lambda: 'another operator' in wearer.page.text_content('#control'))
        served.robot.looks.clear()
        wearer.turn(20)
        wearer.wait_for_picture_after(wearer.stamp_ns)
        # The other one looks ahead.
        assert all(Rotation.from_quat(R).magnitude() < 0.01 for R in served.robot.looks)
        # The trigger takes control.
        wearer.press('trigger')
        wearer.press('trigger', 0)
        wait_until(lambda: served.robot.looks and yaw_deg(look()) == pytest.approx(20, abs=1))
        wait_until(lambda: 'another operator' in other.page.text_content('#control'))
    finally:
        other.context.close()


@pytest.mark.slow
@pytest.mark.parametrize('button', ['a-button', 'squeeze'])
def test_a_button_puts_ahead_before_the_head(wearer, button):
    wearer.turn(30)
    wearer.press(button)
    wearer.press(button, 0)
    for angles in wearer.disc_deg():
        np.testing.assert_allclose(angles, 0, atol=1)


@pytest.mark.slow
def test_the_stick_turns_in_steps(wearer):
    wearer.push(1)
    wearer.page.evaluate(SHOWN)
    assert wearer.disc_deg()[0][0] == pytest.approx(-30, abs=1)
    assert not wearer.has_tunnel()
    wearer.push(0)
    wearer.push(-1)
    assert wearer.disc_deg()[0][0] == pytest.approx(0, abs=1)


@pytest.mark.slow
def test_smooth_turns_are_behind_a_vignette(wearer, look):
    wearer.press('thumbstick')
    wearer.press('thumbstick', 0)
    wearer.push(0.2)
    wait_until(wearer.has_tunnel)
    wait_until(lambda: yaw_deg(look()) < -5)
    wearer.push(0)
    wait_until(lambda: not wearer.has_tunnel())
    stays_deg = yaw_deg(look())
    wearer.page.evaluate(SHOWN)
    assert yaw_deg(look()) == pytest.approx(stays_deg, abs=0.1)


@pytest.mark.slow
def test_lost_tracking_is_seen_within_the_eyes(served, wearer):
    assert not wearer.sees_alarm()
    served.state = State(tracking='lost', healthy=False)
    wait_until(wearer.sees_alarm)
    # The picture may turn: not much of it is seen.
    wait_until(wearer.has_tunnel)
    served.state = State()
    wait_until(lambda: not wearer.sees_alarm())


@pytest.mark.slow
def test_a_broken_connection_is_seen_within_the_eyes(wearer):
    wearer.context.set_offline(True)
    wearer.page.evaluate('WebSocket.prototype.send = function () { this.close(); }')
    wait_until(wearer.sees_alarm)


@pytest.mark.slow
def test_the_session_ends_cleanly(served, wearer):
    """By the page, by the headset; the page goes on where the head has looked, and once more."""
    for leave in (lambda: wearer.page.keyboard.press('h'),
                  lambda: wearer.page.evaluate('window.worn.activeSession.end()')):
        assert wearer.page.get_attribute('#headset', 'aria-pressed') == 'true'
        wearer.turn(30)
        leave()
        wait_until(lambda: wearer.page.get_attribute('#headset', 'aria-pressed') == 'false')
        assert not wearer.is_worn()
        wait_until(lambda: wearer.page.get_attribute('html', 'class') == '')
        wearer.wait_for_situation('stabilized')
        wearer.wait_for_picture_after(wearer.stamp_ns)
        assert Page.disc_deg(wearer) == pytest.approx(30, abs=1)
        wearer.turn(0)
        wearer.page.keyboard.press('Home')
        wearer.enter()


@pytest.mark.slow
def test_a_card_that_fails_in_the_headset_leaves_the_page(wearer):
    # The session takes its time to end: more pictures come meanwhile.
    wearer.page.evaluate(
        """() => {
            const session = window.worn.activeSession, end = session.end.bind(session);
            session.end = () => new Promise(ended => setTimeout(() => ended(end()), 1000));
            WebGL2RenderingContext.prototype.texImage2D = () => { throw new Error('no memory'); };
        }""")
    wait_until(lambda: 'The headset has stopped: no memory'
               in wearer.page.text_content('#notice'), wearer.situation)
    wearer.wait_for_situation('stabilized')
    wearer.wait_for_picture_after(wearer.stamp_ns)
    assert not wearer.is_worn()


@pytest.mark.slow
def test_a_headset_that_refuses_leaves_the_page(served, wearer):
    wearer.page.keyboard.press('h')
    wait_until(lambda: not wearer.is_worn())
    wearer.page.evaluate("""() => {
        navigator.xr.requestSession = async () => { throw new Error('not allowed'); }; }""")
    wearer.page.keyboard.press('h')
    wait_until(lambda: wearer.page.text_content('#notice') == 'not allowed')
    wearer.wait_for_situation('stabilized')
    wearer.wait_for_picture_after(wearer.stamp_ns)
    assert wearer.page.get_attribute('#headset', 'aria-pressed') == 'false'


@pytest.mark.slow
def test_lenses_may_be_off_their_middle(wearer):
    """As a headset's are: what is straight ahead is where the projection has it."""
    x, y = wearer.page.evaluate("""async () => {
        const {SphereRenderer} = await import('/sphere_renderer.js');
        const image = new OffscreenCanvas(512, 256), context = image.getContext('2d');
        context.fillStyle = '#fff';
        context.fillRect(252, 124, 8, 8);
        const canvas = Object.assign(document.createElement('canvas'), {width: 200, height: 200});
        const renderer = new SphereRenderer(canvas);
        renderer.load(await createImageBitmap(image));
        renderer.drawInto({x: 0, y: 0, width: 200, height: 200}, [1, 1, 0.2, -0.4],
                          [1, 0, 0, 0, 1, 0, 0, 0, 1]);
        const pixels = new Uint8Array(4 * 200 * 200), {gl} = renderer;
        gl.readPixels(0, 0, 200, 200, gl.RGBA, gl.UNSIGNED_BYTE, pixels);
        let sum = 0, x = 0, y = 0;
        for (let n = 0; n < 200 * 200; n++) {
            sum += pixels[4 * n];
            x += pixels[4 * n] * (n % 200);
            y += pixels[4 * n] * Math.floor(n / 200);
        }
        return [x / sum, y / sum];
    }""")
    # Elements 8 and 9 of OpenGL's projection, by which places are less than the tangents.
    assert (x - 99.5) / 100 == pytest.approx(-0.2, abs=0.01)
    assert (y - 99.5) / 100 == pytest.approx(0.4, abs=0.01)


def test_what_a_laptop_has_not_is_not_offered(served, browser):
    page = Page(browser, served.url)
    try:
        page.wait_for_situation('stabilized')
        assert not page.page.is_visible('#headset')
        assert not page.page.is_visible('#sensor')
    finally:
        page.context.close()
