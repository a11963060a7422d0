# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The command line ``evaluate`` on small recordings, and its reading of truth."""

import json
import logging

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sph_stab_ros.evaluate import main
from sph_stab_ros.evaluation.ground_truth import find_truth_topic, read_truth
from sph_stab_ros.geometry.trajectory import read_tum, Trajectory
from sph_stab_ros.geometry.warp import rotate_equirect
from sph_stab_ros.recording import open_recording, RecordingError
from sph_stab_ros.recording.bag_writer import BagWriter

START_NS = 1_700_000_000_123_456_789
WIDTH = 256
MOUNT = Rotation.from_euler('ZYX', (20., -35., 100.), degrees=True)
KEYS = {
    'mean_abs_error_deg': {'roll', 'pitch', 'yaw'}, 'geodesic_deg': {'mean', 'max', 'end'},
    'per_frame_deg': {'median', 'p95', 'max'}, 'per_second_deg': {'median', 'p95', 'max'},
    'ms_per_frame': None, 'frames': None,
    'lost_frames': None, 'frames_not_evaluated': None, 'drift_deg_per_min': None}


def orientation(t):
    """Return R_world_camera of a smooth motion at times (N,) in seconds."""
    return Rotation.from_euler('YXZ', np.transpose((
        60 * np.sin(0.9 * t), 15 * np.sin(1.7 * t + 1) - 12, 20 * np.sin(1.3 * t + 2))),
        degrees=True)


def picture():
    """Return a sphere crowded with discs of equal size."""
    rng = np.random.default_rng(0)
    image = np.zeros((WIDTH // 2, WIDTH, 3), np.uint8)
    for lat, u in zip(np.arcsin(rng.uniform(-1, 1, 1500)), rng.integers(0, WIDTH, 1500)):
        v = round((0.5 - lat / np.pi) * WIDTH / 2)
        cv2.ellipse(image, (int(u), v), (round(3 / np.cos(lat)), 3), 0, 0, 360,
                    rng.uniform(0, 255, 3), -1, cv2.LINE_AA)
    return image


def ns(t):
    return START_NS + round(t * 1e9)


def pose_message(writer, stamp_ns, R_mocap_body):
    x, y, z, w = R_mocap_body.as_quat()
    of = writer.type
    return of('geometry_msgs/msg/PoseStamped')(
        header=writer.header(stamp_ns, 'mocap'),
        pose=of('geometry_msgs/msg/Pose')(
            position=of('geometry_msgs/msg/Point')(x=0., y=0., z=0.),
            orientation=of('geometry_msgs/msg/Quaternion')(x=x, y=y, z=z, w=w)))


def write_recording(path, clock_offset_s=0.4, seconds=8., black=()):
    """Write a user's bag: poses at 100 Hz, pictures at 15 Hz, other clocks, unknown mount."""
    image = picture()
    R_mocap_world = Rotation.from_rotvec((0.3, 2., -0.5))
    with BagWriter(path) as writer:
        for t in np.arange(-1.004, seconds + 1, 0.01):
            writer.write('/vrpn/pose', pose_message(
                writer, ns(t + clock_offset_s), R_mocap_world * orientation(t) * MOUNT.inv()),
                ns(t))
        for number, t in enumerate(np.arange(0, seconds, 1 / 15)):
            turned = rotate_equirect(image, orientation(t))
            writer.write_jpeg('/theta/image_raw/compressed', ns(t), 'theta_camera',
                              turned * (number not in black))
    return path


@pytest.fixture(scope='module')
def bag(tmp_path_factory):
    return write_recording(tmp_path_factory.mktemp('user') / 'bag')


def failure(capsys, *argv):
    """Return the exit status and the one line on stderr of a call that fails."""
    try:
        status = main([str(one) for one in argv])
    except SystemExit as exit_:
        status = exit_.code
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1, lines
    return status, lines[0]


def test_one_command_evaluates_a_bag_of_unknown_mount_and_clock(bag, tmp_path, capsys):
    file = tmp_path / 'figures.json'
    assert main([str(bag), '--estimators', 'moment', '--flows', 'farneback',
                 '--clock-offset', 'auto', '--json', str(file)]) == 0
    said = json.loads(file.read_text())
    assert abs(said['clock_offset_s'] - 0.4) < 1e-3
    assert said['mount']['source'] == 'solved'
    assert said['truth'] == '/vrpn/pose'
    figures = said['estimators']['moment/farneback']
    assert {key: set(value) if isinstance(value, dict) else None
            for key, value in figures.items()} == KEYS
    assert figures['frames'] == 120
    assert figures['lost_frames'] == 0
    assert figures['geodesic_deg']['mean'] < 0.5
    assert max(figures['mean_abs_error_deg'].values()) < 0.5
    out = capsys.readouterr().out
    assert 'clock offset, found' in out and 'moment/farneback' in out
    assert [file.name for file in tmp_path.iterdir()] == ['figures.json']


def test_trajectories_for_other_tools_tell_the_same_errors(bag, tmp_path):
    file, folder = tmp_path / 'figures.json', tmp_path / 'tum'
    assert main([str(bag), '--estimators', 'anchored,moment', '--flows', 'dis',
                 '--clock-offset', '0.4', '--max-frames', '20', '--working-width', '128',
                 '--json', str(file), '--tum', str(folder)]) == 0
    assert {one.name for one in folder.iterdir()} == {
        'truth.tum', 'anchored.tum', 'moment_dis.tum'}
    truth = read_tum(folder / 'truth.tum')
    stamps_ns = [ns(number / 15) for number in range(20)]
    assert truth.stamps_ns == pytest.approx(stamps_ns, abs=1)
    # What the bag was made of, through its mount, its clock and its interpolation.
    R_first_camera = Trajectory(stamps_ns, orientation(np.arange(20) / 15)).relative_to_first()
    assert np.rad2deg((truth.rotations.inv() * R_first_camera.rotations).magnitude()).max() < 0.5
    for name, figures in json.loads(file.read_text())['estimators'].items():
        estimate = read_tum(folder / f'{name.replace("/", "_")}.tum')
        assert np.array_equal(estimate.stamps_ns, truth.stamps_ns)
        errors_deg = np.rad2deg((truth.rotations.inv() * estimate.rotations).magnitude())
        assert errors_deg.mean() == pytest.approx(figures['geodesic_deg']['mean'], abs=1e-5)
        assert errors_deg.max() == pytest.approx(figures['geodesic_deg']['max'], abs=1e-5)


def test_every_estimator_with_every_flow(bag, tmp_path):
    file = tmp_path / 'figures.json'
    assert main([str(bag), '--estimators', 'pts,moment,pts_epipolar', '--flows', 'farneback,dis',
                 '--clock-offset', '0.4', '--max-frames', '12', '--working-width', '128',
                 '--json', str(file)]) == 0
    estimators = json.loads(file.read_text())['estimators']
    assert list(estimators) == [
        'pts', 'moment/farneback', 'moment/dis', 'pts_epipolar/farneback', 'pts_epipolar/dis']
    assert {one['frames'] for one in estimators.values()} == {12}


def test_offline_is_evaluated_beside_the_live_tracker(bag, tmp_path, capsys):
    """By truth and by rotations injected, with a row of its own."""
    for n, how in enumerate((('--clock-offset', 'auto'), ('--inject', '1', '--max-frames', '30'))):
        path = tmp_path / f'{n}.json'
        main([str(bag), '--estimators', 'anchored', '--offline', '--json', str(path), *how])
        figures = json.loads(path.read_text())['estimators']
        assert figures['anchored/offline']['geodesic_deg']['mean'] < 0.1
    assert capsys.readouterr().out.count('\nanchored/offline ') == 2


def test_unsaid_clock_offset_is_taken_as_zero(bag, tmp_path):
    file = tmp_path / 'figures.json'
    assert main([str(bag), '--estimators', 'moment', '--max-frames', '40',
                 '--json', str(file)]) == 0
    said = json.loads(file.read_text())
    assert said['clock_offset_s'] == 0
    assert said['estimators']['moment']['geodesic_deg']['mean'] > 3


def test_truth_that_does_not_belong_is_doubted(bag, caplog):
    assert main([str(bag), '--estimators', 'moment', '--max-frames', '40',
                 '--clock-offset=-1.5']) == 0
    assert 'turn differently' in caplog.text


def test_frames_without_truth_are_left_out_and_this_is_said(bag, tmp_path, capsys):
    file = tmp_path / 'figures.json'
    assert main([str(bag), '--estimators', 'moment', '--max-frames', '30',
                 '--clock-offset=-1.2', '--json', str(file)]) == 0
    figures = json.loads(file.read_text())['estimators']['moment']
    assert figures['frames'] + figures['frames_not_evaluated'] == 30
    assert f'{figures["frames_not_evaluated"]} frames are not evaluated' in capsys.readouterr().out


def test_black_frames_are_counted_as_lost(tmp_path):
    bag = write_recording(tmp_path / 'bag', 0., 3., black=(20, 21, 22))
    file = tmp_path / 'figures.json'
    assert main([str(bag), '--estimators', 'moment', '--json', str(file)]) == 0
    assert json.loads(file.read_text())['estimators']['moment']['lost_frames'] == 3


@pytest.mark.parametrize('argv, said', [
    (['--estimators', 'moment,magic'], "'magic' is none of"),
    (['--flows', 'lucas'], "'lucas' is none of"),
    (['--mount', '1,2'], "'1,2' is neither"),
    (['--mount', '0,0,0,0'], 'is neither'),
    (['--clock-offset', 'soon'], 'neither auto nor'),
    (['--clock-offset', 'nan'], 'neither auto nor'),
    (['--inject', '1', '--truth', '/a'], 'needs no --truth'),
    (['--inject', '1', '--tum', 'a'], 'needs no --truth'),
    (['--tum', 'nowhere/a'], "no folder 'nowhere'"),
    (['--inject', '1', '--body', 'lat:5'], '--body: mask'),
    (['--body', 'lat:-90,-60'], '--body needs --inject'),
    (['--every', '0'], '--every: must be a number of seconds above 0'),
    (['--every', 'nan'], '--every: must be a number of seconds'),
    (['--max-frames', '0'], 'at least 1'),
    (['--max-frames', 'all'], "--max-frames: 'all' is not a whole number"),
    (['--mask', 'lat:5'], 'lat:FROM,TO'),
    (['--inject', '1', '-p', 'level:=imu'], 'add -p level:=first_frame'),
    (['-p', 'level:=moon'], '-p: level is one of first_frame, imu'),
    (['--json', '/no/such/folder/a.json'], 'no folder'),
])
def test_wrong_calls_exit_with_2(bag, capsys, argv, said):
    status, line = failure(capsys, bag, *argv)
    assert status == 2 and said in line


@pytest.mark.parametrize('argv, said', [
    (['--truth', '/theta/image_raw/compressed'], 'as truth would do: /vrpn/pose'),
    (['--truth', '/nothing'], 'no topic /nothing'),
    (['--clock-offset', '3600'], 'do not overlap'),
    (['-p', 'level:=imu'], 'no IMU to level by'),
    (['--clock-offset', 'auto', '--max-frames', '1'], '1 frames are too few'),
])
def test_failures_exit_with_1(bag, capsys, argv, said):
    status, line = failure(
        capsys, bag, '--estimators', 'moment', '--max-frames', 12, *argv)
    assert status == 1 and said in line


def test_no_recording_exits_with_1(tmp_path, capsys):
    status, line = failure(capsys, tmp_path / 'nothing.mp4')
    assert status == 1 and 'does not exist' in line


class FakeRecording:
    """A recording whose messages are given."""

    name = 'fake'
    telemetry = None

    def __init__(self, **topics):
        self.topics = {f'/{name}': msgtype for name, (msgtype, _) in topics.items()}
        self._messages = {f'/{name}': messages for name, (_, messages) in topics.items()}

    def messages(self, topic):
        """Yield (time of receipt, message)."""
        yield from ((1, msg) for msg in self._messages[topic])


def message(stamp_ns, quaternion, field='quaternion', **others):
    """Return something with a header's stamp, and a quaternion at a dotted name."""
    def made(**fields):
        return type('Message', (), fields)
    sec, nanosec = divmod(stamp_ns, 10**9)
    inner = made(**dict(zip('xyzw', quaternion)))
    for name in reversed(field.split('.')):
        inner = made(**{name: inner})
    inner.header = made(stamp=made(sec=sec, nanosec=nanosec))
    for name, value in others.items():
        setattr(inner, name, value)
    return inner


STAMPED = 'geometry_msgs/msg/QuaternionStamped'


@pytest.mark.parametrize('msgtype, field', [
    ('geometry_msgs/msg/PoseStamped', 'pose.orientation'),
    ('geometry_msgs/msg/PoseWithCovarianceStamped', 'pose.pose.orientation'),
    (STAMPED, 'quaternion'),
    ('geometry_msgs/msg/TransformStamped', 'transform.rotation'),
    ('nav_msgs/msg/Odometry', 'pose.pose.orientation'),
    ('sensor_msgs/msg/Imu', 'orientation'),
])
def test_truth_of_every_type(msgtype, field):
    turn = Rotation.from_rotvec((0.1, 0.2, 0.3))
    messages = [message(stamp, turn.as_quat(), field, orientation_covariance=[0.] * 9)
                for stamp in (5 * 10**9, 6 * 10**9 + 7)]
    recording = FakeRecording(truth=(msgtype, messages))
    truth = read_truth(recording, find_truth_topic(recording))
    assert truth.stamps_ns.tolist() == [5 * 10**9, 6 * 10**9 + 7]
    assert (truth.rotations.inv() * turn).magnitude() == pytest.approx([0, 0], abs=1e-9)


def test_untidy_truth_is_put_right_and_said(caplog):
    turns = Rotation.from_rotvec(np.arange(15).reshape(5, 3) / 10)
    quaternions = turns.as_quat() * ((1.,), (1.1,), (-1.,), (1.,), (1.,))
    quaternions[3] = 0
    stamps = (40, 10, 30, 20, 30)
    recording = FakeRecording(truth=(STAMPED, list(map(message, stamps, quaternions))))
    with caplog.at_level(logging.WARNING):
        truth = read_truth(recording, '/truth')
    assert truth.stamps_ns.tolist() == [10, 30, 40]
    assert (truth.rotations.inv() * turns[[1, 2, 0]]).magnitude() == pytest.approx(
        np.zeros(3), abs=1e-9)
    for said in ('without an orientation', 'not of unit length', 'earlier', 'stamp of another'):
        assert said in caplog.text


def test_truth_without_orientations_is_refused():
    silent = message(1, (0., 0., 0., 1.), 'orientation', orientation_covariance=[-1.] + [0.] * 8)
    with pytest.raises(RecordingError, match='no orientations'):
        read_truth(FakeRecording(imu=('sensor_msgs/msg/Imu', [silent])), '/imu')
    with pytest.raises(RecordingError, match='no orientations'):
        read_truth(FakeRecording(truth=(STAMPED, [message(1, (np.nan,) * 4)])), '/truth')


def test_choice_of_the_truth_topic():
    imu, pose = ('sensor_msgs/msg/Imu', []), ('geometry_msgs/msg/PoseStamped', [])
    assert find_truth_topic(FakeRecording(imu=imu)) == '/imu'
    assert find_truth_topic(FakeRecording(imu=imu, pose=pose)) == '/pose'
    with pytest.raises(RecordingError, match='choose one with --truth: /a, /b'):
        find_truth_topic(FakeRecording(b=pose, a=pose))
    with pytest.raises(RecordingError, match='--inject'):
        find_truth_topic(FakeRecording())


def test_truth_comes_from_a_bag(bag):
    truth = read_truth(open_recording(bag), '/vrpn/pose')
    assert len(truth) == 1001
    assert truth.stamps_ns[0] == START_NS + 400_000_000 - 1_004_000_000
