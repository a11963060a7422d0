# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Truth of every type of message, through real bags; what is refused says what would do."""

import json

import numpy as np
import pytest
from rosbags.rosbag1 import Writer
from rosbags.typesys import Stores
from scipy.spatial.transform import Rotation

from sph_stab_ros.evaluate import main
from sph_stab_ros.evaluation.ground_truth import find_truth_topic, read_truth
from sph_stab_ros.recording import messages, open_recording, RecordingError
from sph_stab_ros.recording.bag_writer import BagWriter
from sph_stab_ros.recording.message_types import types_of
from tiny_recordings import IMAGE_TOPIC, stamps_of, turning_spheres

START_NS = 1_700_000_000_000_000_000
MOUNT = Rotation.from_euler('ZYX', (20., -35., 100.), degrees=True)
LEVER = Rotation.from_rotvec((0.3, 2., -0.5))


def body(t):
    """Return R_odom_base of a smooth motion at times in seconds."""
    return Rotation.from_euler('ZYX', np.transpose((
        0.9 * np.sin(t), 0.3 * np.sin(1.7 * t + 1), 0.2 * np.cos(1.3 * t))))


def drift(t):
    """Return R_map_odom at times in seconds."""
    return Rotation.from_rotvec(np.outer(t, (0., 0.01, 0.05)))


def ns(t):
    return START_NS + round(t * 1e9)


def pose_fields(bag, rotation, stamp_ns):
    """Return a PoseStamped."""
    x, y, z, w = rotation.as_quat()
    return bag.make(
        'geometry_msgs/msg/PoseStamped', header=bag.header(stamp_ns, 'map'), pose=bag.make(
            'geometry_msgs/msg/Pose',
            position=bag.make('geometry_msgs/msg/Point', x=1., y=2., z=3.),
            orientation=bag.make('geometry_msgs/msg/Quaternion', x=x, y=y, z=z, w=w)))


def path(bag, stamped, stamp_ns):
    """Return a Path of (time in ns, Rotation)."""
    return bag.make('nav_msgs/msg/Path', header=bag.header(stamp_ns, 'map'),
                    poses=[pose_fields(bag, rotation, at_ns) for at_ns, rotation in stamped])


def write_transforms(bag, topic, frames, times_s, rotations):
    """Write one transform again and again."""
    for t, rotation in zip(times_s, rotations):
        bag.write(topic, messages.transforms(bag.make, ns(t), {frames: rotation}), ns(t))


@pytest.fixture(scope='module')
def robot(tmp_path_factory):
    """Return a bag with a robot's tree of transforms: map, odom, base, and what is fixed to it."""
    folder = tmp_path_factory.mktemp('robot') / 'robot'
    with BagWriter(folder) as bag:
        bag.write_jpeg(IMAGE_TOPIC, ns(0), 'camera', np.zeros((64, 128, 3), np.uint8))
        fast, slow = np.arange(0, 4, 0.02), np.arange(-0.3, 4.2, 0.1)
        write_transforms(bag, '/tf', ('odom', 'base'), fast, body(fast))
        write_transforms(bag, '/tf', ('map', 'odom'), slow, drift(slow))
        # One that nobody asks for, and is nothing.
        write_transforms(bag, '/tf', ('base', 'wheel'), fast, body(3 * fast))
        write_transforms(bag, '/tf_static', ('base', '/rig'), [0], [MOUNT])
        write_transforms(bag, '/tf_static', ('lever', 'rig'), [0], [LEVER])
        write_transforms(bag, '/tf_static', ('moon', 'crater'), [0], [LEVER])
        bag.write('/path', path(bag, [(ns(0), MOUNT), (ns(1), MOUNT)], ns(1)), ns(1))
        bag.write('/path', path(bag, [(ns(1), LEVER), (ns(2), MOUNT)], ns(2)), ns(2))
        bag.write('/path', path(bag, [(0, LEVER)], ns(2)), ns(2))
        bag.write('/plan', path(bag, [(0, MOUNT), (0, LEVER)], ns(1)), ns(1))
        bag.write('/cmd_vel', bag.make('geometry_msgs/msg/Twist', **{
            name: bag.make('geometry_msgs/msg/Vector3', x=0., y=0., z=0.)
            for name in ('linear', 'angular')}), ns(0))
    return open_recording(folder)


def angles_rad(truth, expected):
    return (truth.rotations.inv() * expected).magnitude()


@pytest.mark.parametrize('frames, expected, most_rad', [
    (('odom', 'base'), body, 1e-9),
    (('base', 'odom'), lambda t: body(t).inv(), 1e-9),
    # Between samples 0.02 s and 0.1 s apart.
    (('map', 'base'), lambda t: drift(t) * body(t), 1e-4),
    (('map', 'rig'), lambda t: drift(t) * body(t) * MOUNT, 1e-4),
    (('map', 'lever'), lambda t: drift(t) * body(t) * MOUNT * LEVER.inv(), 1e-4),
    (('lever', 'odom'), lambda t: LEVER * MOUNT.inv() * body(t).inv(), 1e-9),
])
def test_transforms_are_composed_along_the_chain(robot, frames, expected, most_rad):
    truth = read_truth(robot, find_truth_topic(robot, frames), frames)
    times_s = (truth.stamps_ns - START_NS) / 1e9
    assert times_s[0] == 0 and times_s[-1] == pytest.approx(3.98, abs=1e-6)
    assert len(truth) >= 200
    assert angles_rad(truth, expected(times_s)).max() < most_rad


def test_a_link_that_is_missing_for_a_while_is_no_truth_meanwhile(tmp_path):
    with BagWriter(tmp_path / 'gap') as bag:
        bag.write_jpeg(IMAGE_TOPIC, ns(0), 'camera', np.zeros((64, 128, 3), np.uint8))
        times_s = np.arange(0, 20, 0.05)
        write_transforms(bag, '/tf', ('odom', 'base'), times_s, body(times_s))
        seen_s = times_s[(times_s < 5) | (times_s > 15)]
        write_transforms(bag, '/tf', ('map', 'odom'), seen_s, drift(seen_s))
    truth = read_truth(open_recording(tmp_path / 'gap'), '/tf', ('map', 'base'))
    times_s = (truth.stamps_ns - START_NS) / 1e9
    assert not ((5 < times_s) & (times_s < 15)).any()
    assert len(truth) == len(seen_s)


def test_of_a_path_that_is_corrected_the_last_word_counts(robot, caplog):
    truth = read_truth(robot, '/path')
    assert truth.stamps_ns.tolist() == [ns(0), ns(1), ns(2)]
    expected = Rotation.concatenate([MOUNT, LEVER, MOUNT])
    assert angles_rad(truth, expected).max() < 1e-9
    assert 'without a stamp' in caplog.text


@pytest.mark.parametrize('topic, frames, said', [
    ('/cmd_vel', None, r'of type geometry_msgs/msg/Twist; as truth would do: /path, /plan, '
     r'/tf \(with --truth-frames PARENT:CHILD\)$'),
    ('/nothing', None, 'no topic /nothing; as truth would do: /path'),
    ('/tf', None, 'choose two frames with --truth-frames PARENT:CHILD: base:rig, base:wheel, '
     'lever:rig, map:odom, moon:crater, odom:base$'),
    ('/tf', ('map', 'sun'), 'no frame sun; its transforms are base:rig, '),
    ('/tf', ('map', 'moon'), 'no chain of transforms from map to moon'),
    ('/tf', ('rig', 'lever'), 'rig:lever: all of it is static'),
    ('/path', ('map', 'base'), 'no transforms between frames, leave out --truth-frames'),
    ('/plan', None, 'the poses in /plan have no stamps; as truth would do: '),
])
def test_what_is_no_truth_says_what_would_do(robot, topic, frames, said):
    with pytest.raises(RecordingError, match=said):
        read_truth(robot, topic, frames)


def test_a_path_is_truth_where_nothing_is_better(robot):
    with pytest.raises(RecordingError, match='several .* choose one with --truth: /path, /plan'):
        find_truth_topic(robot)
    assert find_truth_topic(robot, ('map', 'base')) == '/tf'


def write_robot(folder, truth):
    """Write twelve pictures and their truth as PoseWithCovarianceStamped, Path or TFMessage."""
    images, R_world_camera = turning_spheres(12)
    with BagWriter(folder) as bag:
        for stamp_ns, image, R in zip(stamps_of(12).tolist(), images, R_world_camera):
            bag.write_jpeg(IMAGE_TOPIC, stamp_ns, 'camera', image)
            R = LEVER * R * MOUNT.inv()
            bag.write('/truth', {
                'pose': lambda: messages.pose(bag.make, stamp_ns, 'map', R, np.eye(3)),
                'path': lambda: path(bag, [(stamp_ns, R)], stamp_ns),
                'tf': lambda: messages.transforms(bag.make, stamp_ns, {('map', 'base'): R}),
            }[truth](), stamp_ns)
    return folder


@pytest.mark.parametrize('truth, argv', [
    ('pose', []), ('path', []), ('tf', ['--truth-frames', '/map:base']),
    ('tf', ['--truth', '/truth', '--truth-frames', 'map:base']),
])
def test_one_command_evaluates_against_it(tmp_path, truth, argv):
    folder = write_robot(tmp_path / 'bag', truth)
    x, y, z, w = MOUNT.as_quat()
    file = tmp_path / 'figures.json'
    assert main([str(folder), '--estimators', 'anchored', f'--mount={x},{y},{z},{w}',
                 '--json', str(file), *argv]) == 0
    said = json.loads(file.read_text())
    assert said['truth'] == '/truth'
    assert said.get('truth_frames') == ('map:base' if truth == 'tf' else None)
    assert said['estimators']['anchored']['frames'] == 12
    assert said['estimators']['anchored']['geodesic_deg']['max'] < 0.3


def test_transforms_of_before_tf2_are_the_same(tmp_path):
    types = types_of(Stores.ROS1_NOETIC)
    make = types.types

    def transforms(t):
        x, y, z, w = body(t).as_quat()
        header = make['std_msgs/msg/Header'](
            seq=0, stamp=make['builtin_interfaces/msg/Time'](*divmod(ns(t), 10**9)),
            frame_id='/odom')
        return make['tf2_msgs/msg/TFMessage'](transforms=[
            make['geometry_msgs/msg/TransformStamped'](
                header=header, child_frame_id='/base', transform=make[
                    'geometry_msgs/msg/Transform'](
                    translation=make['geometry_msgs/msg/Vector3'](0., 0., 0.),
                    rotation=make['geometry_msgs/msg/Quaternion'](x, y, z, w)))])

    with Writer(tmp_path / 'old.bag') as bag:
        # A recording has an image topic, of pictures or none.
        bag.add_connection('/image', 'sensor_msgs/msg/Image', typestore=types)
        tf = bag.add_connection(
            '/tf', 'tf/msg/tfMessage', md5sum='94810edda583a504dfda3829e70d7eec',
            msgdef='geometry_msgs/TransformStamped[] transforms\n')
        for t in (0, 0.5, 1):
            data = types.serialize_ros1(transforms(t), 'tf2_msgs/msg/TFMessage')
            bag.write(tf, ns(t), bytes(data))
    recording = open_recording(tmp_path / 'old.bag')
    truth = read_truth(recording, '/tf', ('odom', 'base'))
    assert truth.stamps_ns.tolist() == [ns(0), ns(0.5), ns(1)]
    assert angles_rad(truth, body(np.array((0, 0.5, 1)))).max() < 1e-9


@pytest.mark.parametrize('argv', [
    ['--truth-frames', 'map'], ['--truth-frames', 'map:'], ['--truth-frames', 'map:/map'],
    ['--truth-frames', 'map:base', '--inject', '1']])
def test_wrong_calls_exit_with_2(tmp_path, capsys, argv):
    with pytest.raises(SystemExit) as ended:
        main([str(tmp_path), *argv])
    assert ended.value.code == 2
    assert len(capsys.readouterr().err.splitlines()) == 1


def test_a_localization_recorded_in_the_field(shared_data, tmp_path):
    """The bag of a report: its truth is a PoseWithCovarianceStamped."""
    bag = shared_data / 'reports' / 'truth_types' / 'amcl'
    if not bag.is_dir():
        pytest.skip('no inputs of reports beside the checkout')
    file = tmp_path / 'figures.json'
    assert main([str(bag), '--estimators', 'anchored', '--mount=-7.182,-3.661,-2.975',
                 '--json', str(file)]) == 0
    figures = json.loads(file.read_text())['estimators']['anchored']
    assert figures['frames'] == 60
    assert figures['geodesic_deg']['mean'] < 0.1
