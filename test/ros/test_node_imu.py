# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The real node with an IMU: level horizon, gyro, clocks that go back, bad samples."""

from collections import Counter
from dataclasses import replace
from itertools import count
import time
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from simulated_imu import imu_samples
from sph_stab_ros.geometry.conventions import R_CAMERA_BODY
from sph_stab_ros.simulation import flights
from sph_stab_ros.stabilization.imu import ImuSample, mount_rotation
from sph_stab_ros.stabilization.level import GRAVITY_M_S2, heading, UP
from synthetic import angle_deg, textured_sphere

pytest.importorskip('rclpy', reason='rclpy is not installed')
from diagnostic_msgs.msg import DiagnosticStatus  # noqa: E402, I100
from node_harness import stabilizer, stamp_ns  # noqa: E402
from rclpy.qos import ReliabilityPolicy  # noqa: E402

WIDTH = 256
NS_PER_S = 10**9
PERIOD_NS = NS_PER_S // 30
MOUNT = mount_rotation(*np.deg2rad((10., 20., -40.)))
PARAMETERS = [word for name, value in (
    ('level', 'imu'), ('imu.roll_deg', '10.0'), ('imu.pitch_deg', '20.0'),
    ('imu.yaw_deg', '-40.0'), ('working_width', '256')) for word in ('-p', f'{name}:={value}')]
NOT_MEASURED = [-1.] + 8 * [0.]
HOURS = count(1)


@pytest.fixture(scope='module')
def running(tmp_path_factory):
    """Return the Peer of a node that is levelled by an IMU that sits like MOUNT."""
    with stabilizer(tmp_path_factory.mktemp('imu'), *PARAMETERS,
                    topics=('orientation', '/diagnostics')) as peer:
        yield peer


@pytest.fixture
def peer(running):
    """Return the Peer of a node that has to begin anew."""
    running.reset()
    return running


def resting(R_level_camera, from_ns, to_ns, rate_hz=200):
    """Return the ImuSamples after ``from_ns`` of an IMU that sits like MOUNT on a still camera."""
    force = (R_level_camera * MOUNT).inv().apply(GRAVITY_M_S2 * UP)
    return [ImuSample(int(ns), force, np.zeros(3))
            for ns in np.arange(to_ns, from_ns, -NS_PER_S // rate_hz)[::-1]]


def rested(peer, R_level_camera, until_ns, seconds=0.3):
    """Let the node feel a camera that stood still, and give it the time to take that in."""
    peer.feel(*resting(R_level_camera, until_ns - round(seconds * NS_PER_S), until_ns))
    peer.spin_for(0.3)


def seen(R_level_camera):
    """Return what a camera sees of the level world."""
    return textured_sphere(WIDTH, R_level_camera)


def turning_flight(frames, seed=0):
    """Return a flight that turns where it is, with what its camera is in the level world."""
    flight = flights.synthetic(seed, frames, rotation_amplitude_deg=40., max_frequency_hz=1.)
    flight = replace(flight, position=lambda t: np.zeros((*np.shape(t), 3)))
    R_level_camera = R_CAMERA_BODY * flight.R_mocap_camera(flight.frame_times_s)
    return flight, heading(R_level_camera[0]).inv() * R_level_camera


def test_orientations_are_level_from_the_first_picture_on_and_the_gyro_bridges_the_dark(peer):
    """Longer than prediction is trusted, and while the turn changes its direction."""
    flight, R_level_camera = turning_flight(60)
    dark = range(15, 45)
    samples = imu_samples(flight, MOUNT, rate_hz=100, force_noise_m_s2=0.05)
    statuses = set()
    for i, (ns, R) in enumerate(zip(flight.stamps_ns, R_level_camera)):
        # Pictures come later than samples of the same time, as cameras have it.
        felt = [one for one in samples if one.stamp_ns <= ns + NS_PER_S // 10]
        samples = samples[len(felt):]
        peer.feel(*felt)
        if i == 0:
            peer.spin_for(0.3)
        image = seen(R)
        R_world_camera = peer.stabilize(np.zeros_like(image) if i in dark else image, ns)
        assert angle_deg(R_world_camera, R) < 0.5
        if i in (dark[-1], len(R_level_camera) - 1):
            statuses.add(peer.diagnostics(lambda values: True)['tracking'])
    assert statuses == {'ok', 'predicted'}
    # Had it turned on steadily, or stopped, it would look elsewhere.
    turn = R_level_camera[13].inv() * R_level_camera[14]
    for frames in (0, 15, 30):
        gone_on = R_level_camera[14] * Rotation.from_rotvec(frames * turn.as_rotvec())
        assert angle_deg(gone_on, R_level_camera[44]) > 5


def test_after_a_reset_the_next_picture_is_level_at_once_with_heading_zero(peer):
    start_ns = 100 * NS_PER_S
    R_level_camera = Rotation.from_euler('YX', (70, 25), degrees=True)
    rested(peer, R_level_camera, start_ns)
    for i in range(3):
        peer.stabilize(seen(R_level_camera), start_ns + i * PERIOD_NS)
    peer.reset()
    R_world_camera = peer.stabilize(seen(R_level_camera), start_ns + 3 * PERIOD_NS)
    assert angle_deg(R_world_camera, Rotation.from_euler('X', 25, degrees=True)) < 0.01


@pytest.mark.parametrize('back_s', (0.3, 50))
def test_when_time_goes_back_the_level_is_that_of_the_new_time(peer, back_s):
    start_ns = 200 * NS_PER_S
    before, after = Rotation.from_euler('ZX', ((20, 10), (-15, 30)), degrees=True)
    rested(peer, before, start_ns)
    for i in (-2, -1, 0):
        R_world_camera = peer.stabilize(seen(before), start_ns + i * PERIOD_NS)
        assert angle_deg(R_world_camera, heading(before).inv() * before) < 0.01
    rested(peer, before, start_ns + PERIOD_NS, seconds=0.02)
    back_ns = start_ns - round(back_s * NS_PER_S)
    believed(peer, after, back_ns)
    rested(peer, after, back_ns)
    R_world_camera = peer.stabilize(seen(after), back_ns)
    assert angle_deg(R_world_camera, heading(after).inv() * after) < 0.01
    # Back among what was felt; of the new time nothing was yet.
    back_ns -= NS_PER_S // 7
    believed(peer, after, back_ns)
    assert peer.stabilize(seen(after), back_ns).magnitude() < 1e-9


def believed(peer, R_level_camera, time_ns):
    """Show two pictures before a time from the past, which the third in a row makes believed."""
    for i in (2, 1):
        peer.stabilize(seen(R_level_camera), time_ns - i * PERIOD_NS)


def samples_heard(peer):
    """Return how many samples of the IMU were used so far."""
    return int(peer.diagnostics(lambda values: True)['imu_samples'])


def test_what_an_imu_at_1_khz_says_in_a_second_is_heard_whole(peer):
    before = samples_heard(peer)
    samples = resting(Rotation.identity(), 799 * NS_PER_S, 800 * NS_PER_S, rate_hz=1000)
    for i in range(0, 1000, 50):
        peer.feel(*samples[i:i + 50])
        # What the peer itself can hand over.
        peer.spin_for(0.01)
    peer.diagnostics(lambda values: int(values['imu_samples']) == before + 1000)


@pytest.mark.slow
def test_an_imu_at_1_khz_costs_no_picture(peer):
    """Every other second there is one, and as many pictures are answered as without."""
    image, force = seen(Rotation.identity()), GRAVITY_M_S2 * MOUNT.inv().apply(UP)
    start_ns, start_s, heard_before = 900 * NS_PER_S, time.monotonic(), samples_heard(peer)
    answers = peer.received['orientation']
    answers.clear()
    samples, felt, with_imu = 0, 0, []
    while (now_s := time.monotonic() - start_s) < 20:
        is_felt = int(now_s) % 2 == 1
        for i in range(samples, int(now_s * 1000)):
            if is_felt:
                peer.feel(ImuSample(start_ns + i * NS_PER_S // 1000, force, np.zeros(3)))
                felt += 1
        samples = int(now_s * 1000)
        if len(with_imu) < now_s * 30:
            peer.send(image, start_ns + len(with_imu) * PERIOD_NS)
            with_imu.append(is_felt)
        peer.spin_for(0.001)
    heard = int(peer.diagnostics(
        lambda values: int(values['imu_samples']) >= heard_before + felt)['imu_samples'])
    answered = Counter(with_imu[(stamp_ns(msg) - start_ns) // PERIOD_NS] for msg in answers)
    assert heard == heard_before + felt
    assert answered[True] > 0.9 * answered[False]


def test_samples_that_are_none_are_refused_with_a_reason_and_the_others_used(peer):
    start_ns = 300 * NS_PER_S
    tilt = Rotation.from_euler('X', 20, degrees=True)
    before = int(peer.diagnostics(lambda values: True)['imu_refused'])
    one, = resting(tilt, start_ns - 1, start_ns)
    said = peer.output().count('imu ignored')
    peer.feel(one, linear_acceleration_covariance=NOT_MEASURED,
              angular_velocity_covariance=NOT_MEASURED)
    for force in ((0, 0, 0), (0, np.nan, 9.8), (np.inf, 0, 0), (0, 1e300, 0)):
        peer.feel(SimpleNamespace(stamp_ns=start_ns - 1, specific_force_m_s2=force,
                                  angular_velocity_rad_s=(0, 0, 0)))
    peer.feel(SimpleNamespace(stamp_ns=start_ns - 1, specific_force_m_s2=(0, 0, 9.8),
                              angular_velocity_rad_s=(1e200, 0, 0)))
    counted = peer.diagnostics(lambda values: int(values['imu_refused']) == before + 6)
    assert counted['imu_rate_hz'] == '0.0'
    assert peer.output().count('imu ignored') == said + 1
    assert 'measures neither force nor angular velocity' in peer.output()

    rested(peer, tilt, start_ns)
    assert angle_deg(peer.stabilize(seen(tilt), start_ns), tilt) < 0.01


def test_what_an_imu_does_not_measure_is_not_used(peer):
    """REP 145: an element -1 of the covariance says so, whatever the values are."""
    start_ns = 400 * NS_PER_S
    tilt = Rotation.from_euler('X', 20, degrees=True)
    nonsense = resting(Rotation.from_euler('Z', 80, degrees=True), start_ns - NS_PER_S, start_ns)
    peer.feel(*nonsense, linear_acceleration_covariance=NOT_MEASURED)
    peer.spin_for(0.3)
    assert peer.stabilize(seen(tilt), start_ns).magnitude() < 1e-9
    peer.reset()
    rested(peer, tilt, start_ns + NS_PER_S)
    assert angle_deg(peer.stabilize(seen(tilt), start_ns + NS_PER_S), tilt) < 0.01


@pytest.mark.parametrize('force, cause', (
    (None, 'none is heard'),
    ((0, 0, 0), 'the specific force is zero'),
    ((0, 0, 1.), 'they are of 1.00 m/s², as if they were in g'),
))
def test_an_imu_that_is_of_no_use_is_told_of_with_the_cause(peer, force, cause):
    # After what others have felt.
    stamps_ns = iter(next(HOURS) * 3600 * NS_PER_S + PERIOD_NS * np.arange(10**5))
    image = seen(Rotation.identity())

    def told():
        stamp_ns = next(stamps_ns)
        if force:
            peer.feel(SimpleNamespace(stamp_ns=stamp_ns, specific_force_m_s2=force,
                                      angular_velocity_rad_s=(0, 0, 0)))
        peer.stabilize(image, stamp_ns)
        return [msg.status[0] for msg in peer.received['/diagnostics']
                if 'no usable force from the IMU' in msg.status[0].message
                and cause in msg.status[0].message]

    peer.received['/diagnostics'].clear()
    status = peer.wait_until(told)[0]
    assert status.level == DiagnosticStatus.WARN


def test_the_imu_is_listened_to_only_where_it_is_of_use(tmp_path):
    with stabilizer(tmp_path, '-p', 'working_width:=256', '-p',
                    'qos_overrides./imu.subscription.depth:=7', '-p',
                    'qos_overrides./imus.subscription.depth:=7',
                    topics=('orientation', '/diagnostics')) as peer:
        assert not peer.subscribers('/imu')
        assert 'imu_rate_hz' not in peer.diagnostics(lambda values: True)
        # That it is of no use yet makes no misspelling of it.
        assert peer.output().count('there is no parameter') == 1

        for _ in range(2):
            assert peer.set_parameters(level='imu') == ['']
            peer.wait_until(lambda: peer.subscribers('/imu') == ['stabilizer'])
            assert peer.qos('/imu').reliability is ReliabilityPolicy.BEST_EFFORT
            assert peer.get_parameters('qos_overrides./imu.subscription.depth') == [7]
            now_ns = 600 * NS_PER_S
            peer.feel(*resting(MOUNT, now_ns - NS_PER_S, now_ns))
            peer.diagnostics(lambda values: float(values['imu_rate_hz']) > 0)
            assert peer.set_parameters(level='first_frame') == ['']
            peer.wait_until(lambda: not peer.subscribers('/imu'))


def test_the_level_service_levels_the_horizon_or_says_why_not(tmp_path):
    def refusal():
        response = peer.level()
        assert not response.success
        return response.message

    R_level_camera = Rotation.from_euler(
        'YXZ', np.outer(np.linspace(0, 1, 10), (25, 15, -10)), degrees=True)
    stamps_ns = iter(700 * NS_PER_S + PERIOD_NS * np.arange(1000))
    with stabilizer(tmp_path, '-p', 'working_width:=256') as peer:
        assert 'no picture' in refusal()
        for R in R_level_camera:
            R_before = peer.stabilize(seen(R), next(stamps_ns))
        assert angle_deg(R_before, R_level_camera[-1]) < 0.5

        response = peer.level()
        assert response.success and response.message
        last = R_before
        for _ in range(200):
            R = peer.stabilize(seen(R_level_camera[-1]), next(stamps_ns))
            # It glides there.
            assert angle_deg(R, last) < 0.4
            last = R
        assert angle_deg(R, heading(R_before)) < 0.5

        peer.reset()
        assert 'no picture' in refusal()
        assert peer.set_parameters(level='imu') == ['']
        peer.stabilize(seen(R_level_camera[-1]), next(stamps_ns))
        assert refusal() == 'the IMU says what is level'
