# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
"""Looking around by turning the phone, in a browser that is told how it is turned."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

pytest.importorskip('rclpy', reason='rclpy is not installed')
pytest.importorskip('aiohttp', reason='aiohttp is not installed')
from operator_harness import Page, wait_until, world_with_disc  # noqa: E402, I100
from operator_served import Served  # noqa: E402
import cv2  # noqa: E402, I100

# Upright before the face, its back to the north.
UPRIGHT = {'alpha': 0, 'beta': 90, 'gamma': 0}


@pytest.fixture(scope='module')
def served():
    with Served() as served:
        served.file = cv2.imencode('.jpg', world_with_disc())[1].tobytes()
        yield served


@pytest.fixture
def phone(served, browser):
    """Return the page in a browser of a phone, that does not know yet how it is turned."""
    page = Page(browser, served.url, has_touch=True)
    page.wait_for_situation('stabilized')
    page.sensors = page.context.new_cdp_session(page.page)
    yield page
    page.context.close()
    assert not page.errors


def hold(page, **angles):
    """Tell a browser how its phone is held, in degrees."""
    page.sensors.send('DeviceOrientation.setDeviceOrientationOverride', {**UPRIGHT, **angles})


def disc_px(page):
    """Return where the disc is from the centre (x, y), NaN where it is not in view."""
    try:
        return np.array(page.disc())
    except AssertionError:
        return np.full(2, np.nan)


def px(angle_deg):
    """Return how far an angle is from the centre of the view."""
    return Page.SIZE_WH[0] / 2 / np.tan(np.deg2rad(50)) * np.tan(np.deg2rad(angle_deg))


def look(served):
    """Return the R_virtual_view that was published last."""
    return Rotation.from_quat(served.robot.looks[-1])


def test_a_phone_is_a_window(served, phone):
    wait_until(lambda: phone.page.is_visible('#sensor'))
    phone.page.tap('#sensor')
    # However it is held: what is ahead stays so.
    hold(phone, alpha=70)
    wait_until(lambda: served.robot.looks)
    hold(phone)
    wait_until(lambda: abs(phone.heading_deg() - 70) < 1)
    phone.page.tap('#centre')
    wait_until(lambda: abs(disc_px(phone)[0]) < 4)
    # To the left by 20°: what was ahead is to the right.
    hold(phone, alpha=20)
    wait_until(lambda: abs(disc_px(phone)[0] - px(20)) < 8)
    wait_until(lambda: abs(phone.heading_deg() + 20) < 1)
    # Its back points upwards, as far as the disc is not hidden by what stands above and below.
    hold(phone, beta=95)
    wait_until(lambda: abs(disc_px(phone)[1] - px(5)) < 4)
    # Leaning to the right by 30°.
    lean = Rotation.from_euler('z', 30, degrees=True)
    alpha, beta, gamma = angles_of(rotation_of(**UPRIGHT) * lean.inv())
    hold(phone, alpha=alpha, beta=beta, gamma=gamma)
    wait_until(lambda: (look(served) * lean.inv()).magnitude() < 0.02)
    hold(phone)
    wait_until(lambda: look(served).magnitude() < 0.02)
    # What is dragged is turned further.
    phone.page.mouse.move(550, 300)
    phone.page.mouse.down()
    phone.page.mouse.move(650, 300, steps=4)
    phone.page.mouse.up()
    wait_until(lambda: abs(disc_px(phone)[0] - 100) < 4)
    hold(phone, alpha=350)
    # 100 px are 12.2° here.
    wait_until(lambda: abs(disc_px(phone)[0] - px(2.2)) < 6)
    # Off again it says nothing more.
    phone.page.tap('#sensor')
    assert phone.page.get_attribute('#sensor', 'aria-pressed') == 'false'
    hold(phone, alpha=100)
    phone.wait_for_picture_after(phone.stamp_ns)
    assert abs(disc_px(phone)[0] - px(2.2)) < 6


@pytest.mark.parametrize('answer, reason', [
    ('denied', 'does not let this page know'), ('granted', 'does not tell how it is turned')])
def test_without_a_sensor_or_leave_that_is_told(phone, answer, reason):
    phone.page.evaluate(
        'answer => { DeviceOrientationEvent.requestPermission = async () => answer; }', answer)
    phone.page.tap('#sensor')
    wait_until(lambda: reason in phone.page.text_content('#notice'), phone.situation)
    assert phone.page.get_attribute('#sensor', 'aria-pressed') == 'false'


def rotation_of(alpha, beta, gamma):
    """Return R_earth_device as the standard has it: intrinsic, about z, x and y."""
    return Rotation.from_euler('ZXY', (alpha, beta, gamma), degrees=True)


def angles_of(R_earth_device):
    """Return alpha, beta and gamma of ``rotation_of``, within the standard's bounds."""
    alpha, beta, gamma = R_earth_device.as_euler('ZXY', degrees=True)
    if abs(gamma) > 90:
        alpha, beta, gamma = alpha + 180, 180 - beta, gamma - np.copysign(180, gamma)
    return alpha % 360, beta, gamma


def test_the_angles_of_phones_are_those_of_the_standard(phone):
    rng = np.random.default_rng(0)
    for _ in range(20):
        alpha, beta, gamma = rng.uniform((0, -180, -90), (360, 180, 90))
        screen_deg = float(rng.choice([0, 90, 180, 270]))
        got = Rotation.from_quat(phone.page.evaluate("""async angles => {
            const {lookOf} = await import('/phone_sensor.js');
            return lookOf(...angles);
        }""", [alpha, beta, gamma, screen_deg]))
        R_earth_screen = rotation_of(alpha, beta, gamma) * Rotation.from_euler(
            'z', -screen_deg, degrees=True)
        # East, down, north; right, down, away from the eye.
        level = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])
        np.testing.assert_allclose(
            got.as_matrix(), level @ R_earth_screen.as_matrix() @ np.diag([1, -1, -1]),
            atol=1e-9)
