# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What cameras measured comes out of their files as it went in, in the body's axes."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from sph_stab_ros.geometry.conventions import R_CAMERA_BODY
from sph_stab_ros.recording import open_recording, RecordingError
from sph_stab_ros.recording.telemetry import read_telemetry, stabilized_by
from sph_stab_ros.stabilization.recorded_imu import find_imu_topic, RecordedImu
from telemetry_files import (
    body_forces, body_rates, camm, gopro, gopro_settings, insta360, orientation, with_track)
from tiny_recordings import turning_spheres, write_video

pytest.importorskip('av')

# A sensor's own clock.
RATE_HZ = 201.7
SECONDS = 6.
# How finely shorts of GPMF and raw samples of Insta360 count: rates in rad/s, forces in m/s².
STEP = 0.0006, 0.003


@pytest.fixture
def video(tmp_path):
    """Return a video of three pictures from time zero on."""
    return write_video(tmp_path / 'video.mp4', turning_spheres(3, 128)[0],
                       np.arange(3) * 33_333_333)


def times(start_s=0.):
    return start_s + np.arange(0, SECONDS, 1 / RATE_HZ)


def trailed(path, trailer):
    path.write_bytes(path.read_bytes() + trailer)
    return path


FORMATS = {
    'GPMF with stamps': lambda path, t, *of: with_track(path, b'gpmd', gopro(t, *of), 1000),
    'GPMF without stamps': lambda path, t, *of: with_track(
        path, b'gpmd', gopro(t, *of, stamps=False), 1000),
    'CAMM': lambda path, t, *of: with_track(path, b'camm', camm(t, *of)),
    'Insta360': lambda path, t, *of: trailed(path, insta360(t, *of)),
    'Insta360, list of places': lambda path, t, *of: trailed(path, insta360(t, *of, places=True)),
    'Insta360, raw': lambda path, t, *of: trailed(path, insta360(t, *of, raw=True))}


@pytest.fixture(params=FORMATS)
def write(request):
    return FORMATS[request.param]


def off(series, of):
    """Return the largest differences from what was measured, by the samples' own times."""
    return np.abs(series.vectors - of(series.stamps_ns / 1e9)).max()


def test_what_was_measured_comes_out_at_its_time(video, write):
    t = times()
    found = read_telemetry(write(video, t, body_rates(t), body_forces(t)))
    assert len(found.rates_rad_s.stamps_ns) == len(found.forces_m_s2.stamps_ns) == len(t)
    # Without stamps seconds tell the time to within a sample; a rate changes by 3 rad/s².
    late_s = found.rates_rad_s.stamps_ns / 1e9 - t
    assert np.abs(late_s).max() < 1.5 / RATE_HZ
    assert off(found.rates_rad_s, body_rates) < STEP[0] + 4 * np.abs(late_s).max()
    assert off(found.forces_m_s2, body_forces) < STEP[1] + 20 * np.abs(late_s).max()


@pytest.mark.parametrize('name', [one for one in FORMATS if one != 'GPMF without stamps'])
def test_where_samples_have_stamps_their_times_are_exact(name, video):
    t = times()
    found = read_telemetry(FORMATS[name](video, t, body_rates(t), body_forces(t)))
    assert found.rates_rad_s.stamps_ns / 1e9 == pytest.approx(t, abs=1e-3)


@pytest.mark.parametrize('order', ['XzY', 'ZXY', 'yXZ', 'YxZ'])
def test_axes_are_those_that_a_gopro_names(order, video):
    t = times()
    found = read_telemetry(with_track(
        video, b'gpmd', gopro(t, body_rates(t), body_forces(t), order), 1000))
    assert found.source == 'GoPro GPMF, GoPro Max'
    assert off(found.forces_m_s2, body_forces) < 0.05


@pytest.mark.parametrize('device, name, order', [
    ('Hero6 Black', 'Gyroscope', 'YxZ'), ('Hero6 Black', 'Gyroscope (z,x,y)', 'ZXY'),
    ('Fusion', 'Gyroscope (z,x,y)', 'yXZ'), ('Camera', 'Gyroscope (z,x,y)', 'ZXY')])
def test_axes_are_known_of_goproes_that_do_not_name_them(device, name, order, video):
    t = times()
    found = read_telemetry(with_track(video, b'gpmd', gopro(
        t, body_rates(t), body_forces(t), order, device=device, name=name,
        says_order=False), 1000))
    assert off(found.forces_m_s2, body_forces) < 0.05


def test_a_lost_payload_moves_no_others(video):
    t = times()
    payloads = gopro(t, body_rates(t), body_forces(t))
    whole = read_telemetry(with_track(video, b'gpmd', payloads, 1000)).rates_rad_s
    time_s, damaged = payloads[2]
    payloads[2] = time_s, damaged[:60] + bytes(len(damaged) - 60)
    found = read_telemetry(with_track(
        write_video(video.with_name('lost.mp4'), turning_spheres(3, 128)[0]), b'gpmd', payloads,
        1000)).rates_rad_s
    kept = (t < 2) | (t >= 3)
    assert len(found.stamps_ns) == np.count_nonzero(kept)
    assert found.stamps_ns / 1e9 == pytest.approx(whole.stamps_ns[kept] / 1e9, abs=1e-5)
    assert found.vectors.tolist() == whole.vectors[kept].tolist()


def test_orientations_of_camm(video):
    t = times()
    found = read_telemetry(with_track(video, b'camm', camm(t, R_world_camera=orientation(t))))
    assert found.rates_rad_s is found.forces_m_s2 is None and not found.is_of_imu
    R_world_body = Rotation.from_rotvec(found.orientations_rad.vectors)
    assert (R_world_body.inv() * orientation(t) * R_CAMERA_BODY).magnitude().max() < 1e-5


def test_samples_reach_an_imu_in_order_and_in_time(video, write):
    t = times()
    recording = open_recording(write(video, t, body_rates(t), body_forces(t)))
    imu = RecordedImu(recording, find_imu_topic(recording))
    first, rest = list(imu.until(10**9)), list(imu.until(10**12))
    stamps_ns = [one.stamp_ns for one in first + rest]
    assert stamps_ns == sorted(stamps_ns) and first[-1].stamp_ns <= 10**9 < rest[0].stamp_ns
    assert imu.samples == 2 * len(t) and not imu.refused
    forces = [one.specific_force_m_s2 for one in first + rest
              if one.specific_force_m_s2 is not None]
    assert np.linalg.norm(forces, axis=1) == pytest.approx(9.80665, abs=0.01)


def test_a_video_without_has_none(video):
    recording = open_recording(video)
    assert recording.telemetry is None and not stabilized_by(video)
    with pytest.raises(RecordingError, match="no IMU to level by.*camera's own"):
        find_imu_topic(recording)


def test_other_tracks_of_data_are_none(video):
    with_track(video, b'tmcd', [(0., bytes(4)), (1., bytes(4))])
    assert read_telemetry(video) is None


@pytest.mark.parametrize('stabilized', [False, True])
@pytest.mark.parametrize('maker', ['GoPro', 'Insta360'])
def test_what_the_camera_stabilised_is_told(maker, stabilized, video, caplog):
    t = times()
    of = t, body_rates(t), body_forces(t)
    if maker == 'GoPro':
        with_track(video, b'gpmd', gopro(*of), 1000, gopro_settings(stabilized))
    else:
        trailed(video, insta360(*of, stabilized=stabilized))
    open_recording(video)
    told = [line for line in caplog.messages if 'stabilised the pictures itself' in line]
    assert len(told) == stabilized and all(maker in line for line in told)


def test_a_damaged_trailer_is_told_in_a_line(video):
    t = times()
    trailer = insta360(t, body_rates(t), body_forces(t))
    at = len(trailer) - 72 - 4
    trailed(video, trailer[:at] + b'\xff\xff\xff\x7f' + trailer[at + 4:])
    recording = open_recording(video)
    with pytest.raises(RecordingError, match='trailer is damaged'):
        find_imu_topic(recording)
