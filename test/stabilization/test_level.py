# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""A level horizon: by gravity, however the IMU sits and the camera moves, or as told."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from simulated_imu import imu_samples
from sph_stab_ros.config import ImuConfig, StabilizerConfig, TrackerConfig
from sph_stab_ros.geometry.conventions import R_CAMERA_BODY
from sph_stab_ros.images.frame import Frame
from sph_stab_ros.simulation import flights
from sph_stab_ros.stabilization.imu import (
    ImuError, ImuSample, ImuSamples, mount_rotation, NEITHER)
from sph_stab_ros.stabilization.imu_history import ImuHistory
from sph_stab_ros.stabilization.level import (
    Gravity, GRAVITY_M_S2, heading, level_rotation, Leveler, LevelError, UP)
from sph_stab_ros.stabilization.pipeline import Stabilizer
from sph_stab_ros.stabilization.stabilized_frame import StabilizationEvent
from sph_stab_ros.tracking import TrackingStatus
from synthetic import angle_deg, textured_sphere, unit

PERIOD_NS = 33_333_333
MOUNT = mount_rotation(*np.deg2rad((10., 20., -40.)))


def tilt_deg(R_world_origin, up_origin):
    """Return how far from upwards the true upwards direction is."""
    up = R_world_origin.apply(up_origin)
    return np.rad2deg(np.arctan2(np.linalg.norm(np.cross(up, UP)), up @ UP))


def levelled(flight, samples, R_camera_imu=MOUNT, heard_from=0):
    """Return R_world_origin and its tilt in degrees at each frame, orientations being true."""
    gravity, leveler, imu = Gravity(), Leveler(), ImuHistory()
    R_origin_camera = flight.R_mocap_camera(flight.frame_times_s)
    up_origin = R_origin_camera[0].inv().apply((0, 0, 1))
    R_origin_camera = R_origin_camera[0].inv() * R_origin_camera
    samples = list(samples)
    rotations = []
    for i, stamp_ns in enumerate(flight.stamps_ns.tolist()):
        while samples and samples[0].stamp_ns <= stamp_ns:
            sample = samples.pop(0)
            if i >= heard_from:
                imu.add(ImuSamples.of((sample,)), R_camera_imu)
        gravity.weigh(stamp_ns, R_origin_camera[i], imu)
        rotations.append(leveler.update(stamp_ns, R_origin_camera[i], gravity.up))
    return Rotation.concatenate(rotations), np.array([tilt_deg(R, up_origin) for R in rotations])


def resting(R_level_camera, seconds=1., rate_hz=100, until_ns=0):
    """Return the samples of an IMU that sits like MOUNT on a camera at rest."""
    force = (R_level_camera * MOUNT).inv().apply(GRAVITY_M_S2 * UP)
    stamps_ns = until_ns - np.arange(round(seconds * rate_hz))[::-1] * (10**9 // rate_hz)
    return [ImuSample(int(stamp_ns), force, np.zeros(3)) for stamp_ns in stamps_ns]


def still(seconds=2):
    """Return a flight that stays where it is, tilted."""
    R = Rotation.from_euler('ZYX', (1., 0.4, -0.5)) * R_CAMERA_BODY.inv()
    flight = flights.synthetic(0, frames=30 * seconds)
    return replace(flight, rotation=lambda t: Rotation.from_quat(
        np.broadcast_to(R.as_quat(), (*np.shape(t), 4))),
        position=lambda t: np.zeros((*np.shape(t), 3)))


# The geometry.

def test_a_level_camera_has_up_upwards_and_heading_zero():
    rng = np.random.default_rng(0)
    for up in (*rng.normal(size=(200, 3)), UP, -UP, (0, 0, 1), (0, 0, -1), (1, 0, 0)):
        R = level_rotation(np.array(up, float))
        np.testing.assert_allclose(R.apply(unit(np.array(up))), UP, atol=1e-9)
        if heading(R) is not None:
            assert heading(R).magnitude() < 1e-9


def test_a_heading_is_level_and_looks_the_same_way():
    for R in Rotation.random(200, random_state=1):
        x, y, z = R.apply((0, 0, 1))
        if abs(y) > np.cos(np.deg2rad(15)):
            assert heading(R) is None
        else:
            np.testing.assert_allclose(heading(R).apply((0, 0, 1)), unit(np.array((x, 0, z))),
                                       atol=1e-9)
            np.testing.assert_allclose(heading(R).apply(UP), UP, atol=1e-12)


def test_the_mount_is_that_of_a_urdf():
    """Forward is the image centre, up its top; yaw is left, pitch down, roll to the right."""
    def seen(axis, **angles):
        angles = {'roll_rad': 0, 'pitch_rad': 0, 'yaw_rad': 0, **angles}
        return np.round(mount_rotation(**angles).apply(axis), 9)
    np.testing.assert_array_equal(seen((1, 0, 0)), (0, 0, 1))
    np.testing.assert_array_equal(seen((0, 0, 1)), (0, -1, 0))
    np.testing.assert_array_equal(seen((1, 0, 0), yaw_rad=np.pi / 2), (-1, 0, 0))
    np.testing.assert_array_equal(seen((1, 0, 0), pitch_rad=np.pi / 2), (0, 1, 0))
    np.testing.assert_array_equal(seen((0, 0, 1), roll_rad=np.pi / 2), (1, 0, 0))
    # About fixed axes, roll first: yaw does not change the inclination of the IMU.
    np.testing.assert_array_equal(seen((0, 0, 1), roll_rad=np.pi / 2, yaw_rad=np.pi / 2),
                                  (0, 0, 1))


# Gravity.

def test_with_exact_gravity_the_vertical_is_vertical_from_the_first_picture_on():
    flight = still()
    R_world_origin, tilts_deg = levelled(flight, imu_samples(flight, MOUNT))
    assert tilts_deg.max() < 1e-4
    # And the first picture looks where heading is zero.
    assert heading(R_world_origin[0]).magnitude() < 1e-6


def test_between_pictures_the_camera_turns_steadily():
    """So that few of them, without a gyro, will do."""
    gravity, imu = Gravity(), ImuHistory()
    for i in range(200):
        R_level_camera = Rotation.from_rotvec((1.5 * i / 100, 0, 0))
        force = (R_level_camera * MOUNT).inv().apply(GRAVITY_M_S2 * UP)
        imu.add(ImuSamples.of((ImuSample(i * 10**7, force),)), MOUNT)
        if i % 20 == 0:
            gravity.weigh(i * 10**7, R_level_camera, imu)
    np.testing.assert_allclose(gravity.up, GRAVITY_M_S2 * UP, atol=1e-6)


@pytest.mark.parametrize('seed', (0, *(
    pytest.param(seed, marks=pytest.mark.thorough) for seed in (1, 2))))
def test_accelerations_turns_noise_and_bias_are_averaged_out(seed):
    """Flying with up to 3.5 m/s²; a bias of 0.07 m/s² alone makes 0.4°."""
    flight = flights.synthetic(seed, frames=1200)
    samples = imu_samples(flight, MOUNT, force_noise_m_s2=0.5, rate_noise_rad_s=0.02,
                          force_bias_m_s2=(0.04, -0.04, 0.04), seed=seed)
    _, tilts_deg = levelled(flight, samples)
    # After 10 s velocities of 2 m/s are worth 2/98 rad, 1.2°.
    assert tilts_deg[300:].max() < 0.4 + 1.2
    assert tilts_deg[-1] < 0.4 + 0.4


@pytest.mark.parametrize('name', ('drone', 'handheld', 'pioneer'))
def test_real_motions_are_levelled(shared_data, name):
    flight = getattr(flights, name)(shared_data / 'rotation_logs')
    samples = imu_samples(flight, MOUNT, force_noise_m_s2=0.5, rate_noise_rad_s=0.02)
    _, tilts_deg = levelled(flight, samples)
    assert tilts_deg[300:].max() < 1.2


def test_the_world_turns_slowly_once_there_is_a_picture():
    """Also when the IMU is first heard during the flight: 10°/s at most, and soon there."""
    flight = flights.synthetic(4, frames=400)
    samples = imu_samples(flight, MOUNT, force_noise_m_s2=0.5)
    R_world_origin, tilts_deg = levelled(flight, samples, heard_from=30)
    steps_deg = angle_deg(R_world_origin[1:], R_world_origin[:-1])
    assert steps_deg.max() < 10 / 30 + 1e-3
    assert tilts_deg[0] > 5 and tilts_deg[-1] < 1.2
    # The force of the latest second hardly counts any more.
    assert steps_deg[300:].max() < 0.05


def test_however_the_imu_sits_the_level_is_the_same():
    flight = flights.synthetic(5, frames=60)
    results = [levelled(flight, imu_samples(flight, mount), mount)[0]
               for mount in (MOUNT, *Rotation.random(3, random_state=2))]
    for other in results[1:]:
        assert angle_deg(results[0], other).max() < 1e-6


def test_turning_the_flight_about_the_vertical_changes_nothing():
    flight = flights.synthetic(6, frames=60)
    turn = Rotation.from_euler('z', 2.)
    turned = replace(flight, rotation=lambda t: turn * flight.rotation(t),
                     position=lambda t: turn.apply(flight.position(t)))
    here, there = (levelled(one, imu_samples(one, MOUNT))[0] for one in (flight, turned))
    assert angle_deg(here, there).max() < 1e-6


def test_an_upside_down_camera_is_set_upright():
    stabilizer = levelling_stabilizer()
    R_level_camera = Rotation.from_euler('ZX', (178, 10), degrees=True)
    for sample in resting(R_level_camera):
        stabilizer.add_imu(sample)
    R = stabilizer.process(picture(0)).R_world_camera
    assert angle_deg(R, heading(R_level_camera).inv() * R_level_camera) < 1e-6


# Samples that are none.

@pytest.mark.parametrize('values, reason', (
    ({'specific_force_m_s2': (0, 0, 0)}, 'specific force is zero'),
    ({'specific_force_m_s2': (0, np.nan, 9.8)}, 'specific force is .*nan'),
    ({'specific_force_m_s2': (0, 9.8)}, 'not three'),
    ({'angular_velocity_rad_s': (0, 0, np.inf)}, 'angular velocity is .*inf'),
    ({'specific_force_m_s2': (0, -1e300, 9.8)}, 'specific force is .*impossible: beyond 2000'),
    ({'angular_velocity_rad_s': (0, 0, 1e200)}, 'angular velocity is .*impossible: beyond 100'),
))
def test_samples_that_cannot_be_are_refused_with_the_reason(values, reason):
    with pytest.raises(ImuError, match=reason):
        ImuSample(0, **values)


def test_many_samples_are_judged_as_single_ones_are():
    values = np.array((0, 0.1, -9.8, 99, 101, 1999, -2001, 1e300, np.nan, -np.inf))
    rng = np.random.default_rng(0)
    forces, rates = rng.choice(values, (2, 2000, 3))
    forces[::5] = (0, 0, 9.8)
    rates[::3] = 0
    has_force, has_rate = rng.random((2, 2000)) < 0.7
    taken, reasons = [], []
    for i in range(2000):
        try:
            if not has_force[i] and not has_rate[i]:
                raise ImuError(NEITHER)
            taken.append(ImuSample(i, forces[i] if has_force[i] else None,
                                   rates[i] if has_rate[i] else None))
        except ImuError as error:
            reasons.append(str(error))
    samples, errors = ImuSamples.usable(np.arange(2000), forces, rates, has_force, has_rate)
    assert list(map(str, errors)) == reasons and len({*reasons}) > 5 and len(taken) > 100
    of_single = ImuSamples.of(taken)
    np.testing.assert_array_equal(samples.stamps_ns, of_single.stamps_ns)
    np.testing.assert_array_equal(samples.forces_m_s2, of_single.forces_m_s2)
    np.testing.assert_array_equal(samples.rates_rad_s, of_single.rates_rad_s)


def levelling_stabilizer(**options):
    """Return a Stabilizer for the small pictures here that an IMU, sitting like MOUNT, levels."""
    return Stabilizer(StabilizerConfig(
        tracker=TrackerConfig(working_width=256, **options), level='imu',
        imu=ImuConfig(roll_deg=10., pitch_deg=20., yaw_deg=-40.)))


def picture(i, R=Rotation.identity()):
    """Return the frame number i of a world at infinity."""
    return Frame(textured_sphere(256, R), i * PERIOD_NS)


@pytest.mark.parametrize('force, late_s, why', (
    (None, 0, 'none is heard'),
    ((0, 0, 1e-3), 0, 'they are of 0.00 m/s², as if gravity had been taken out'),
    ((0, 0.6, 0.8), 0, 'they are of 1.00 m/s², as if they were in g'),
    ((0, 0, 200.), 0, 'they are of 200 m/s², beyond'),
    ((0, 0, 9.8), 12.5, "the IMU's stamps are 12.5 s behind the pictures'"),
    ((0, 0, 9.8), -3600, "the IMU's stamps are 3600.0 s ahead of the pictures'"),
))
def test_without_usable_forces_the_first_picture_stays_level_and_it_is_told_why(
        force, late_s, why):
    stabilizer = levelling_stabilizer()
    events = set()
    for i in range(40):
        if force is not None:
            stabilizer.add_imu(ImuSample(i * PERIOD_NS - round(late_s * 1e9), force))
        stabilized = stabilizer.process(picture(i))
        events.update(stabilized.events)
    assert stabilized.why_no_gravity.startswith(why)
    assert stabilized.R_world_camera.magnitude() < 1e-3
    assert events == {StabilizationEvent.NO_GRAVITY}


def test_late_and_repeated_samples_and_clocks_set_back_harm_nothing():
    R_level_camera = Rotation.from_euler('XZ', (20, -10), degrees=True)
    samples = resting(R_level_camera, until_ns=10**10)
    swapped = [one for pair in zip(samples[1::2], samples[::2]) for one in pair]
    for order in (samples + samples, swapped, samples + resting(R_level_camera, until_ns=0)):
        stabilizer = levelling_stabilizer()
        for sample in order:
            stabilizer.add_imu(sample)
        frame = Frame(picture(0).image, order[-1].stamp_ns + 10**8 // 2)
        assert tilt_deg(stabilizer.process(frame).R_world_camera,
                        R_level_camera.inv().apply(UP)) < 1e-4


# In the stabiliser.

def test_the_stabilised_picture_is_level():
    stabilizer = levelling_stabilizer()
    R_level_camera = Rotation.from_euler('XZ', (30, -20), degrees=True)
    R_level_camera = heading(R_level_camera).inv() * R_level_camera
    for sample in resting(R_level_camera):
        stabilizer.add_imu(sample)
    stabilized = stabilizer.process(picture(0, R_level_camera))
    assert angle_deg(stabilized.R_world_camera, R_level_camera) < 1e-4
    difference = stabilized.sphere() - textured_sphere(256).astype(int)
    assert np.abs(difference).mean() < 4


def test_after_a_reset_the_next_picture_is_level_at_once_with_heading_zero():
    stabilizer = levelling_stabilizer()
    R_level_camera = Rotation.from_euler('YX', (80, 30), degrees=True)
    for i in range(3):
        if i == 2:
            stabilizer.reset()
        for sample in resting(R_level_camera, PERIOD_NS / 1e9, 200, i * PERIOD_NS):
            stabilizer.add_imu(sample)
        stabilized = stabilizer.process(picture(i, R_level_camera))
    assert angle_deg(stabilized.R_world_camera, Rotation.from_euler('X', 30, degrees=True)) < 1e-4


def test_a_mount_that_is_corrected_live_corrects_the_level():
    stabilizer = levelling_stabilizer()
    right, R_level_camera = stabilizer.config, Rotation.from_euler('X', 30, degrees=True)
    stabilizer.reconfigure(replace(right, imu=ImuConfig()))
    tilts_deg = []
    for i in range(240):
        if i == 20:
            stabilizer.reconfigure(right)
        for sample in resting(R_level_camera, PERIOD_NS / 1e9, 200, i * PERIOD_NS):
            stabilizer.add_imu(sample)
        R = stabilizer.process(picture(i, R_level_camera)).R_world_camera
        tilts_deg.append(tilt_deg(R, R_level_camera.inv().apply(UP)))
    assert tilts_deg[19] > 10 and tilts_deg[-1] < 0.2
    assert np.abs(np.diff(tilts_deg[19:])).max() < 10 / 30 + 0.05


def test_level_here_takes_roll_and_pitch_out_and_keeps_the_heading():
    stabilizer = Stabilizer(StabilizerConfig(tracker=TrackerConfig(working_width=256)))
    with pytest.raises(LevelError, match='no picture'):
        stabilizer.level_here()
    R = Rotation.from_euler('YXZ', np.outer(np.linspace(0, 1, 8), (30, 20, -12)), degrees=True)
    stabilized = [stabilizer.process(picture(i, one)) for i, one in enumerate(R)]
    R_before = stabilized[-1].R_world_camera
    assert angle_deg(R_before, R[-1]) < 0.3
    stabilizer.level_here()
    stabilized += [stabilizer.process(picture(8 + i, R[-1])) for i in range(300)]
    after = Rotation.concatenate([s.R_world_camera for s in stabilized[7:]])
    assert angle_deg(after[1:], after[:-1]).max() < 10 / 30 + 0.05
    assert angle_deg(after[-1], heading(R_before)) < 0.1


def test_level_here_is_refused_where_it_makes_no_sense():
    with pytest.raises(LevelError, match='IMU'):
        levelling_stabilizer().level_here()
    leveler = Leveler()
    leveler.update(0, Rotation.from_euler('X', 90, degrees=True))
    with pytest.raises(LevelError, match='no heading'):
        leveler.level_here()


# The gyro.

def test_turns_are_those_of_the_flight():
    flight = flights.synthetic(7, frames=45)
    imu = ImuHistory()
    samples = list(imu_samples(flight, MOUNT, rate_hz=400))
    # However they come together.
    while samples:
        batch, samples = samples[:17], samples[17:]
        imu.add(ImuSamples.of(batch), MOUNT)
    stamps_ns = np.random.default_rng(3).integers(*flight.stamps_ns[[0, -1]], (50, 2))
    for pair_ns in stamps_ns.tolist():
        R_from, R_to = flight.R_mocap_camera((np.array(pair_ns) - flight.stamps_ns[0]) * 1e-9)
        turn = imu.gyro_rotation(*pair_ns)
        assert angle_deg(turn, R_from.inv() * R_to) < 0.02
        assert angle_deg(turn.inv(), imu.gyro_rotation(*pair_ns[::-1])) < 1e-9


def test_turns_that_were_not_seen_are_not_made_up():
    imu = ImuHistory()
    assert imu.gyro_rotation(0, 1) is None
    imu.add(ImuSamples.of(ImuSample(int(stamp_s * 1e9), None, (0, 0, 1.))
                          for stamp_s in (0., 0.01, 0.02, 0.5, 0.51)), MOUNT)
    assert imu.gyro_rotation(0, 10**7) is None, 'before a silence'
    assert imu.gyro_rotation(500_000_000, 700_000_000) is None, 'too long after the last'
    turn = imu.gyro_rotation(500_000_000, 550_000_000)
    assert np.rad2deg(turn.magnitude()) == pytest.approx(np.rad2deg(0.05))


@pytest.mark.parametrize('estimator', ('anchored', 'moment'))
def test_black_frames_are_bridged_by_the_gyro(estimator):
    """Though the turn changes direction in the dark, and longer than prediction is trusted."""
    def R_world_camera(times_s):
        return Rotation.from_rotvec(np.outer(np.sin(2 * np.pi * times_s), (0.1, 0.3, 0.05)))

    stabilizer = levelling_stabilizer(estimator=estimator, flow='dis', max_prediction_s=0.1)
    rates = np.outer(2 * np.pi * np.cos(2 * np.pi * np.arange(-20, 300) / 200), (0.1, 0.3, 0.05))
    samples = [ImuSample(round(i * 1e9 / 200), None, MOUNT.inv().apply(rate))
               for i, rate in zip(range(-20, 300), rates)]
    truth = R_world_camera(np.arange(30) * PERIOD_NS * 1e-9)
    stabilized = []
    for i, R in enumerate(truth):
        while samples and samples[0].stamp_ns <= i * PERIOD_NS:
            stabilizer.add_imu(samples.pop(0))
        frame = picture(i, R)
        dark = 6 <= i < 20
        stabilized.append(stabilizer.process(
            Frame(np.zeros_like(frame.image), frame.stamp_ns) if dark else frame))
    assert {s.status for s in stabilized[6:20]} == {TrackingStatus.PREDICTED}
    assert {s.status for s in stabilized[20:]} == {TrackingStatus.OK}
    for s, R in zip(stabilized, truth):
        assert angle_deg(s.R_world_camera, R) < 0.5
