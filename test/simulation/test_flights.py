# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

import numpy as np
import pytest

from sph_stab_ros.geometry.conventions import R_BODY_CAMERA
from sph_stab_ros.simulation import flights
from sph_stab_ros.simulation.flights import PAD_S

SYNTHETIC = ('synthetic', 'hover', 'shake')
FROM_LOGS = ('drone', 'pioneer', 'handheld')


@pytest.fixture(params=SYNTHETIC + FROM_LOGS)
def flight(request):
    if request.param in SYNTHETIC:
        return getattr(flights, request.param)(seed=1)
    logs = request.getfixturevalue('shared_data') / 'rotation_logs'
    return getattr(flights, request.param)(logs)


@pytest.fixture
def logs(shared_data):
    return shared_data / 'rotation_logs'


def body_angles_deg(flight, t_s):
    """Return yaw, pitch and roll (N, 3) of the upright body in degrees, without jumps."""
    angles = (flight.R_mocap_camera(t_s) * R_BODY_CAMERA.inv()).as_euler('ZYX')
    return np.rad2deg(np.unwrap(angles, axis=0))


def per_frame_deg(flight):
    R = flight.R_mocap_camera(flight.frame_times_s)
    return np.rad2deg((R[:-1].inv() * R[1:]).magnitude())


def speeds_m_s(flight):
    steps = np.diff(flight.p_mocap_camera(flight.frame_times_s), axis=0)
    return np.linalg.norm(steps, axis=1) * flight.frame_rate_hz


def test_frames_come_at_the_stated_rate(flight):
    assert flight.stamps_ns.dtype == np.int64
    periods_s = np.diff(flight.stamps_ns) * 1e-9
    np.testing.assert_allclose(periods_s, 1 / flight.frame_rate_hz, atol=1e-8)


def test_motion_is_continuous(flight):
    step_s = 0.001
    t_s = np.arange(-PAD_S, min(flight.duration_s, 20) + PAD_S, step_s)
    R = flight.R_mocap_camera(t_s)
    rates_deg_s = np.rad2deg((R[:-1].inv() * R[1:]).magnitude()) / step_s
    assert rates_deg_s.max() < 250
    # A jump of rate within a millisecond would be a kink.
    assert np.abs(np.diff(rates_deg_s)).max() < 10
    velocities_m_s = np.diff(flight.p_mocap_camera(t_s), axis=0) / step_s
    assert np.linalg.norm(velocities_m_s, axis=1).max() < 2.5
    assert np.abs(np.diff(velocities_m_s, axis=0)).max() < 0.1


def test_camera_stays_clear_of_the_walls(flight):
    p = flight.p_mocap_camera(np.linspace(-PAD_S, flight.duration_s + PAD_S, 5000))
    size = np.array(flight.room_size_m)
    assert (np.abs(p[:, :2]) <= size[:2] / 2 - 0.6).all()
    assert (p[:, 2] >= 0.6).all() and (p[:, 2] <= size[2] - 0.6).all()


def test_scalar_time_equals_array(flight):
    t_s = 0.123
    R, p = flight.R_mocap_camera(t_s), flight.p_mocap_camera(t_s)
    assert (R.inv() * flight.R_mocap_camera(np.array([t_s]))[0]).magnitude() < 1e-12
    np.testing.assert_allclose(p, flight.p_mocap_camera(np.array([t_s]))[0], atol=1e-12)


def test_time_outside_is_refused(flight):
    with pytest.raises(ValueError, match='outside'):
        flight.R_mocap_camera(flight.duration_s + PAD_S + 0.1)
    with pytest.raises(ValueError, match='outside'):
        flight.p_mocap_camera(np.array([0.0, -PAD_S - 0.1]))


def test_cut_is_the_same_motion(flight):
    cut = flight.cut(10, 5, every=2)
    np.testing.assert_array_equal(cut.stamps_ns, flight.stamps_ns[10:20:2])
    assert cut.frame_rate_hz == flight.frame_rate_hz / 2
    later = flight.frame_times_s[10:20:2]
    R = cut.R_mocap_camera(cut.frame_times_s).inv() * flight.R_mocap_camera(later)
    assert R.magnitude().max() < 1e-9
    np.testing.assert_allclose(cut.p_mocap_camera(cut.frame_times_s),
                               flight.p_mocap_camera(later), atol=1e-9)


@pytest.mark.parametrize('part', [(-1, 2, 1), (0, 0, 1), (0, 61, 1), (59, 2, 1), (0, 31, 2)])
def test_cut_that_the_flight_does_not_have_is_refused(part):
    with pytest.raises(ValueError, match='synthetic has 60 frames'):
        flights.synthetic(seed=0).cut(*part)


@pytest.mark.parametrize('name', SYNTHETIC)
def test_seed_decides_the_motion(name):
    def directions(seed):
        return getattr(flights, name)(seed=seed).R_mocap_camera(np.arange(5) / 5).as_quat()
    np.testing.assert_array_equal(directions(3), directions(3))
    assert np.abs(directions(3) - directions(4)).max() > 0.01


def test_synthetic_keeps_to_its_amplitudes():
    flight = flights.synthetic(2, 1800, 30.0, 25.0, 0.5)
    t_s = flight.frame_times_s
    rotvec = (flight.R_mocap_camera(t_s) * R_BODY_CAMERA.inv()).as_rotvec(degrees=True)
    np.testing.assert_allclose(np.abs(rotvec).max(axis=0), 25.0, rtol=0.02)
    p = flight.p_mocap_camera(t_s) - [0, 0, flight.room_size_m[2] / 2]
    np.testing.assert_allclose(np.abs(p).max(axis=0), 0.5, rtol=0.02)


def test_hover_is_closed_after_a_minute():
    flight = flights.hover(seed=0, laps=3)
    t_s = np.linspace(0, 59, 50)
    difference = flight.R_mocap_camera(t_s).inv() * flight.R_mocap_camera(t_s + 120)
    assert difference.magnitude().max() < 1e-9
    np.testing.assert_allclose(flight.p_mocap_camera(t_s), flight.p_mocap_camera(t_s + 60),
                               atol=1e-9)


def test_shake_is_the_same_whatever_its_length():
    flight, short = flights.shake(seed=0), flights.shake(seed=0, frames=40)
    assert per_frame_deg(flight).max() == pytest.approx(8.0, abs=0.01)
    np.testing.assert_allclose(per_frame_deg(short), per_frame_deg(flight)[:39], atol=1e-6)


def test_drone_flies_as_described(logs):
    flight = flights.drone(logs)
    yaw, pitch, roll = body_angles_deg(flight, np.arange(-PAD_S, flight.duration_s, 0.005)).T
    assert len(flight.stamps_ns) == 500 and flight.frame_rate_hz == 30
    assert np.ptp(yaw) >= 360
    assert [pitch.min(), pitch.max()] == pytest.approx([-15, 15], abs=0.2)
    assert [roll.min(), roll.max()] == pytest.approx([-25, 15], abs=0.2)
    assert 0.5 < np.median(per_frame_deg(flight)) < 2
    assert per_frame_deg(flight).max() < 4


def test_drone_keeps_the_yaw_of_the_log(logs):
    flight = flights.drone(logs)
    t, R_log_sensor = flights._read_rotations(logs / 'euroc_V102_drone.csv')
    # Sensor z is the body's x: its heading in the log's level plane is the yaw.
    forward = R_log_sensor[8200:8200 + 3000:50].apply([0, 0, 1])
    yaw_deg = np.rad2deg(np.unwrap(np.arctan2(forward[:, 1], forward[:, 0])))
    flown_deg = body_angles_deg(flight, t[8200:8200 + 3000:50] - t[8200])[:, 0]
    np.testing.assert_allclose(flown_deg - flown_deg[0], yaw_deg - yaw_deg[0], atol=1e-6)


def test_pioneer_drives_on_a_plane(logs):
    flight = flights.pioneer(logs)
    t_s = flight.frame_times_s
    yaw, pitch, roll = body_angles_deg(flight, t_s).T
    p = flight.p_mocap_camera(t_s)
    assert np.ptp(yaw) > 90
    assert 0.2 < max(np.abs(pitch).max(), np.abs(roll).max()) < 0.5
    np.testing.assert_allclose(p[:, 2], 1.0, atol=0.006)
    np.testing.assert_allclose(speeds_m_s(flight), 0.5, atol=0.05)
    course_deg = np.rad2deg(np.unwrap(np.arctan2(*np.diff(p[:, 1::-1], axis=0).T)))
    apart = course_deg - (yaw[1:] + yaw[:-1]) / 2
    np.testing.assert_allclose((apart + 180) % 360 - 180, 0, atol=1.0)


def test_handheld_walks_upright(logs):
    flight = flights.handheld(logs)
    angles = body_angles_deg(flight, flight.frame_times_s)
    assert np.ptp(angles[:, 0]) > 90
    assert np.abs(angles[:, 1:]).max() < 15
    assert 0.2 < np.median(per_frame_deg(flight)) < 2
    assert 0.3 < np.median(speeds_m_s(flight)) < 1.5


@pytest.mark.parametrize('content, complaint', [
    (None, 'cannot be read'),
    ('no numbers', 'cannot be read'),
    ('', 'cannot be read'),
    ('0,1,0,0\n1,1,0,0\n', 'should have 5 columns'),
    ('0,1,0,0,nan\n1,1,0,0,0\n', 'should have 5 columns'),
    ('0,1,0,0,0\n1,1,0,0,0\n2,1,0,0,0\n', 'does not cover'),
])
def test_bad_log_is_named(tmp_path, content, complaint):
    if content is not None:
        (tmp_path / 'kitti00_car.csv').write_text(content)
    with pytest.raises(flights.LogError, match=complaint):
        flights.pioneer(tmp_path)


@pytest.mark.parametrize('frames', [0, 501])
def test_length_that_the_log_does_not_have_is_refused(logs, frames):
    with pytest.raises(ValueError, match='1 to 500 frames'):
        flights.drone(logs, frames)
