# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

from dataclasses import replace

import cv2
import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from scipy.spatial.transform import Rotation

from sph_stab_ros.geometry.conventions import R_BODY_CAMERA
from sph_stab_ros.geometry.equirect import pixels_from_bearings
from sph_stab_ros.geometry.warp import rotate_equirect
from sph_stab_ros.recording import RecordingError
from sph_stab_ros.simulation import flights, recordings
from sph_stab_ros.simulation.__main__ import main
from sph_stab_ros.simulation.renderer import render, RenderOptions
from sph_stab_ros.simulation.room import Room

WIDTH = 256
CLEAN = RenderOptions(noise_std=0.0)
FLIGHT = flights.synthetic(seed=5)
MIDDLE = np.array([0.3, -0.2, 1.5])


@pytest.fixture(scope='module')
def room():
    return Room(FLIGHT, seed=1, people=1, texels_per_m=50)


@pytest.fixture(scope='module')
def empty_room():
    return Room(FLIGHT, seed=1, furniture=0, people=0, texels_per_m=50)


def still(R_mocap_camera, p_mocap_camera=MIDDLE):
    """Return a flight that stays at one pose."""
    return replace(FLIGHT, rotation=lambda t_s: R_mocap_camera,
                   position=lambda t_s: np.asarray(p_mocap_camera))


def orientations(seed, count):
    return Rotation.random(count, np.random.default_rng(seed))


def colours_at(image, bearings):
    """Return the colours (N, 3) of an image in directions (N, 3), between the pixels."""
    uv = pixels_from_bearings(bearings, image.shape[1]).astype(np.float32)
    padded = cv2.copyMakeBorder(image, 1, 1, 1, 1, cv2.BORDER_WRAP)
    return cv2.remap(padded, uv[:, :1] + 1, uv[:, 1:] + 1, cv2.INTER_LINEAR)[:, 0].astype(float)


def difference(a, b):
    return np.abs(a.astype(float) - b).mean()


@pytest.mark.parametrize('seed', range(3))
def test_turning_the_camera_turns_the_picture(room, seed):
    R_mocap_a, R_mocap_b = orientations(seed, 2)
    a, b = (render(room, still(R), 0.0, WIDTH, CLEAN) for R in (R_mocap_a, R_mocap_b))
    turned = rotate_equirect(a, R_mocap_a.inv() * R_mocap_b)
    assert difference(turned, b) < 2.5
    assert difference(turned, b) < 0.1 * difference(a, b)


@pytest.mark.parametrize('seed', range(3))
def test_picture_has_no_seam(room, seed):
    image = render(room, still(orientations(seed, 1)[0]), 0.0, WIDTH, CLEAN).astype(float)
    across_seam = np.abs(image[:, 0] - image[:, -1]).mean()
    elsewhere = np.abs(np.diff(image, axis=1)).mean(axis=(0, 2))
    assert across_seam < 1.5 * np.percentile(elsewhere, 95)


@pytest.mark.parametrize('seed', range(4))
def test_lamps_are_seen_where_they_hang(empty_room, seed):
    rng = np.random.default_rng(seed)
    p = MIDDLE + rng.uniform(-1, 1, 3) * (1, 1, 0.4)
    R_mocap_camera = orientations(seed, 1)[0]
    image = render(empty_room, still(R_mocap_camera, p), 0.0, 512, CLEAN)
    size = np.array(FLIGHT.room_size_m)
    corners = np.array([(x, y) for x in (-1, 1) for y in (-1, 1)])
    half_sides = np.array((0.6, 0.15))
    for lamp in corners:
        centre = size[:2] * (0.25, 0.2) * lamp
        for margin, bright in ((-0.08, True), (0.08, False)):
            points = np.column_stack((centre + corners * (half_sides + margin), 4 * [size[2]]))
            bearings = R_mocap_camera.inv().apply(points - p)
            # The ceiling around them has about 210 levels.
            assert ((colours_at(image, bearings) > 225).all(axis=1) == bright).all()


def test_points_on_the_walls_keep_their_colours_from_everywhere(empty_room):
    rng = np.random.default_rng(0)
    size = np.array(FLIGHT.room_size_m)
    points = rng.uniform(-0.5, 0.5, (3000, 3))
    side = rng.integers(0, 3, 3000)
    points[np.arange(3000), side] = rng.choice((-0.5, 0.5), 3000)
    points = points * size + [0, 0, size[2] / 2]
    seen = []
    for R, p in zip(orientations(1, 2), ((0.5, 0.4, 1.4), (-0.2, -0.3, 1.9))):
        image = cv2.GaussianBlur(render(empty_room, still(R, p), 0.0, 512, CLEAN), (0, 0), 1)
        seen.append(colours_at(image, R.inv().apply(points - p)))
    for kind in range(3):
        a, b = (colours[side == kind].ravel() for colours in seen)
        assert np.corrcoef(a, b)[0, 1] > 0.9
        assert np.abs(a - b).mean() < 5


def test_equal_arguments_give_equal_pictures():
    pictures = [render(Room(FLIGHT, seed, texels_per_m=20), FLIGHT, 0.5, 64)
                for seed in (1, 1, 2)]
    np.testing.assert_array_equal(pictures[0], pictures[1])
    assert difference(pictures[0], pictures[2]) > 5


def test_stitch_error_turns_the_lenses_against_each_other(room):
    error = Rotation.from_rotvec(np.deg2rad(2.0) * np.array((2, 2, 1)) / 3)
    R = orientations(0, 1)[0]
    image = render(room, still(R), 0.0, WIDTH, replace(CLEAN, stitch_error_deg=4.0))
    front, rear = (render(room, still(R * lens), 0.0, WIDTH, CLEAN)
                   for lens in (error, error.inv()))
    middle = slice(WIDTH // 4 + 1, 3 * WIDTH // 4 - 1)
    outside = np.r_[:WIDTH // 4 - 1, 3 * WIDTH // 4 + 1:WIDTH]
    assert difference(image[:, middle], front[:, middle]) < 0.1
    assert difference(image[:, outside], rear[:, outside]) < 0.1
    assert difference(image[:, middle], rear[:, middle]) > 1


def test_rolling_shutter_exposes_row_by_row(empty_room):
    flight, t_s, readout_s = flights.shake(seed=0), 1.0, 0.05
    rolling = render(empty_room, flight, t_s, WIDTH, replace(CLEAN, readout_s=readout_s))
    rows = WIDTH // 2
    at_once = render(empty_room, flight, t_s, WIDTH, CLEAN)
    to_same_time, to_middle = [], []
    for row in (*range(0, rows // 4, 5), *range(3 * rows // 4, rows, 5)):
        moment = t_s + ((row + 0.5) / rows - 0.5) * readout_s
        same_time = render(empty_room, flight, moment, WIDTH, CLEAN)
        to_same_time.append(difference(rolling[row], same_time[row]))
        to_middle.append(difference(rolling[row], at_once[row]))
    assert np.mean(to_same_time) < 0.2 * np.mean(to_middle)
    assert difference(rolling[rows // 2], at_once[rows // 2]) < 0.5


def test_motion_blur_averages_over_the_exposure(empty_room):
    blurring = replace(CLEAN, exposure_s=0.06, blur_samples=3)
    flight = flights.shake(seed=0)
    moments = [render(empty_room, flight, 1.0 + dt, WIDTH, CLEAN) for dt in (-0.02, 0.0, 0.02)]
    blurred = render(empty_room, flight, 1.0, WIDTH, blurring)
    # The mean is rounded, hence half a level at most.
    assert np.abs(blurred - np.mean(moments, axis=0)).max() < 0.51
    assert difference(blurred, moments[1]) > 0.5


def test_noise_is_as_strong_as_stated_and_fresh_in_every_frame(empty_room):
    flight, noisy = still(orientations(0, 1)[0]), RenderOptions(noise_std=3.0)
    a, b = (render(empty_room, flight, t_s, WIDTH, noisy).astype(float) for t_s in (0.0, 0.1))
    assert np.std(a - b) == pytest.approx(3.0 * np.sqrt(2), rel=0.05)


def test_exposure_changes_in_steps(empty_room):
    flight, steps = still(orientations(0, 1)[0]), replace(CLEAN, exposure_step=0.3)
    means = [render(empty_room, flight, t_s, 64, steps).mean() for t_s in (0.0, 1.4, 1.6)]
    assert means[0] == means[1]
    assert abs(means[2] / means[0] - 1) > 0.02


def test_robot_is_fixed_in_the_camera(room):
    shown = replace(CLEAN, robot=True)
    R = orientations(3, 1)[0]
    upright = render(room, still(R_BODY_CAMERA), 0.0, WIDTH, shown)
    tilted = render(room, still(R), 0.0, WIDTH, shown)
    body = (upright != render(room, still(R_BODY_CAMERA), 0.0, WIDTH, CLEAN)).any(axis=-1)
    inside = cv2.erode(body.astype(np.uint8), np.ones((5, 5))) > 0
    assert inside[-1].all() and not inside[:WIDTH // 4].any()
    np.testing.assert_array_equal(upright[inside], tilted[inside])
    areas = np.cos((np.arange(WIDTH // 2) + 0.5) / (WIDTH // 2) * np.pi - np.pi / 2)
    assert 0.03 < (body * areas[:, None]).sum() / (WIDTH * areas.sum()) < 0.15


@pytest.mark.parametrize('name', ['synthetic', 'drone', 'pioneer', 'handheld'])
def test_nothing_stands_or_walks_in_the_way(name, request):
    flight = FLIGHT
    if name != 'synthetic':
        logs = request.getfixturevalue('shared_data') / 'rotation_logs'
        flight = getattr(flights, name)(logs)
    room = Room(flight, seed=0, people=3, texels_per_m=10)
    assert len(room.boxes) >= 6 + 2 * 3
    for t_s in np.linspace(0, flight.duration_s, 100):
        for box in room.boxes:
            gap = np.abs(flight.p_mocap_camera(t_s) - box.centre_m(t_s)) - box.size_m / 2
            assert gap.max() > 0.25


def test_truth_is_the_flight_seen_from_the_markers():
    stamps_ns, R_mocap_markers, p_mocap_markers = recordings.truth(FLIGHT)
    assert (np.diff(stamps_ns) == 10_000_000).all()
    assert stamps_ns[0] < FLIGHT.stamps_ns[0] and stamps_ns[-1] > FLIGHT.stamps_ns[-1]
    assert not np.isin(stamps_ns, FLIGHT.stamps_ns).any()
    t_s = (stamps_ns - FLIGHT.stamps_ns[0]) * 1e-9
    R_mocap_camera = R_mocap_markers * recordings.R_CAMERA_MARKERS.inv()
    assert (R_mocap_camera.inv() * FLIGHT.R_mocap_camera(t_s)).magnitude().max() < 1e-9
    camera = p_mocap_markers - R_mocap_camera.apply(recordings.P_CAMERA_MARKERS_M)
    np.testing.assert_allclose(camera, FLIGHT.p_mocap_camera(t_s), atol=1e-9)


def read(path):
    """Return images by stamp, poses by stamp, and the times of reception in order."""
    images, poses, received = {}, {}, []
    with AnyReader([path]) as reader:
        for connection, timestamp, data in reader.messages():
            msg = reader.deserialize(data, connection.msgtype)
            stamp_ns = msg.header.stamp.sec * 10**9 + msg.header.stamp.nanosec
            received.append(timestamp)
            if connection.topic == '/theta/image_raw/compressed':
                assert msg.header.frame_id == 'theta_camera' and 'jpeg' in msg.format
                images[stamp_ns] = cv2.imdecode(msg.data, cv2.IMREAD_COLOR)
            else:
                assert connection.topic == '/vrpn/pose' and msg.header.frame_id == 'mocap'
                poses[stamp_ns] = msg.pose
    return images, poses, received


def test_recording_holds_pictures_and_truth(tmp_path):
    flight = FLIGHT.cut(0, 6)
    pictures = np.random.default_rng(0).integers(0, 255, (6, 1, 1, 3)) * np.ones((32, 64, 1))
    recordings.write_recording(tmp_path / 'bag', flight, pictures.astype(np.uint8))
    images, poses, received = read(tmp_path / 'bag')
    assert sorted(p.name for p in tmp_path.iterdir()) == ['bag']
    assert list(images) == flight.stamps_ns.tolist()
    assert difference(np.array(list(images.values())), pictures) < 3
    assert received == sorted(images.keys() | poses.keys())
    stamps_ns, R_mocap_markers, p_mocap_markers = recordings.truth(flight)
    assert list(poses) == stamps_ns.tolist()
    q = [(p.orientation.x, p.orientation.y, p.orientation.z, p.orientation.w)
         for p in poses.values()]
    assert (Rotation.from_quat(q).inv() * R_mocap_markers).magnitude().max() < 1e-9
    np.testing.assert_allclose([(p.position.x, p.position.y, p.position.z)
                                for p in poses.values()], p_mocap_markers, atol=1e-12)


@pytest.mark.parametrize('count', [0, 2, 4])
def test_wrong_number_of_pictures_leaves_nothing_behind(tmp_path, count):
    pictures = np.zeros((count, 32, 64, 3), np.uint8)
    with pytest.raises(RecordingError, match='pictures'):
        recordings.write_recording(tmp_path / 'bag', FLIGHT.cut(0, 3), pictures)
    assert not list(tmp_path.iterdir())


def simulate(*words):
    return main([str(word) for word in words])


def test_command_writes_a_recording_and_never_over_another(tmp_path, capsys):
    call = ('synthetic', tmp_path / 'bag', '--frames-limit', 3, '--width', 64)
    assert simulate(*call) == 0
    images, _, _ = read(tmp_path / 'bag')
    assert [image.shape for image in images.values()] == 3 * [(32, 64, 3)]
    assert simulate(*call, '--seed', 1) == 1
    assert 'exists already' in capsys.readouterr().err
    again, _, _ = read(tmp_path / 'bag')
    np.testing.assert_array_equal(list(again.values()), list(images.values()))
    assert simulate(*call, '--seed', 1, '--force') == 0
    other, _, _ = read(tmp_path / 'bag')
    assert difference(np.array(list(other.values())), np.array(list(images.values()))) > 5


def test_command_makes_hard_recordings(tmp_path):
    hard = [word for name in ('plain', 'blur', 'rolling', 'stitch', 'exposure')
            for word in ('--hard', name)]
    assert simulate('synthetic', tmp_path / 'bag', '--every', 2, '--frames-limit', 2,
                    '--width', 32, *hard) == 0
    stamps_ns = list(read(tmp_path / 'bag')[0])
    assert np.diff(stamps_ns) == pytest.approx(10**9 / 15, abs=2)


def test_command_takes_rendered_frames(tmp_path, capsys):
    frames = tmp_path / 'frames'
    frames.mkdir()
    for number in range(4, 7):
        cv2.imwrite(str(frames / f'{number:06d}.png'), np.full((32, 64, 3), 30 * number, np.uint8))
    call = ('synthetic', tmp_path / 'bag', '--frames', frames, '--first-frame', 4)
    assert simulate(*call, '--frames-limit', 3) == 0
    images, _, _ = read(tmp_path / 'bag')
    assert list(images) == flights.synthetic(seed=0).stamps_ns[4:7].tolist()
    assert [image.mean() for image in images.values()] == pytest.approx([120, 150, 180], abs=2)
    assert simulate(*call, '--frames-limit', 4, '--force') == 1
    assert '000007.png is missing' in capsys.readouterr().err
    assert len(read(tmp_path / 'bag')[0]) == 3


@pytest.mark.parametrize('words, complaint', [
    (('drone',), 'needs --logs'),
    (('teapot',), 'invalid choice'),
    (('synthetic', '--width', '50'), '--width'),
    (('synthetic', '--width', '0'), '--width'),
    (('synthetic', '--quality', '0'), '--quality'),
    (('synthetic', '--seed', '-1'), '--seed'),
    (('synthetic', '--first-frame', '60'), 'too few'),
    (('synthetic', '--first-frame', '-1'), 'too few'),
    (('synthetic', '--frames-limit', '61'), 'too few'),
    (('synthetic', '--every', '0'), 'every 0'),
    (('synthetic', '--frames', 'x', '--hard', 'blur'), '--hard'),
])
def test_wrong_call_is_one_line(tmp_path, capsys, words, complaint):
    with pytest.raises(SystemExit) as error:
        simulate(words[0], tmp_path / 'bag', *words[1:])
    assert error.value.code == 2
    line, = capsys.readouterr().err.splitlines()
    assert complaint in line
    assert not list(tmp_path.iterdir())


def test_missing_logs_are_one_line(tmp_path, capsys):
    assert simulate('drone', tmp_path / 'bag', '--logs', tmp_path) == 1
    line, = capsys.readouterr().err.splitlines()
    assert 'euroc_V102_drone.csv cannot be read' in line
