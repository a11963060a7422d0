# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The node's parameters, at the start and live, and the names that are remapped."""

from importlib.util import find_spec
import os
from pathlib import Path
import subprocess
import sys

import numpy as np
import pytest
from sph_stab_ros.config import NODE_PARAMETERS
from sph_stab_ros.replay import arguments as replay_arguments
from synthetic import angle_deg
from tiny_recordings import stamps_of, turning_spheres

rclpy = pytest.importorskip('rclpy', reason='rclpy is not installed')
from node_harness import DOMAINS, rotation, stabilizer  # noqa: E402, I100
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue  # noqa: E402
from rcl_interfaces.srv import SetParameters  # noqa: E402
from rclpy.context import Context  # noqa: E402
from rclpy.qos import DurabilityPolicy, QoSProfile  # noqa: E402
from rclpy.time import Time  # noqa: E402
from sensor_msgs.msg import CameraInfo  # noqa: E402
from sph_stab_ros.ros.parameters import declare_parameters  # noqa: E402
from sph_stab_ros.ros.topics import compressed_topic  # noqa: E402

REPOSITORY = Path(__file__).resolve().parents[2]
DEFAULTS = REPOSITORY / 'config' / 'stabilizer.yaml'
HELD_STABILIZER = str(REPOSITORY / 'test' / 'support' / 'held_stabilizer.py')
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


def test_every_option_is_a_parameter_with_its_default_and_limits(tmp_path):
    with stabilizer(tmp_path, '--params-file', str(DEFAULTS)) as peer:
        assert NODE_PARAMETERS.keys() <= peer.list_parameters()
        values = peer.get_parameters(*NODE_PARAMETERS)
        descriptors = peer.describe_parameters(*NODE_PARAMETERS)
    for option, value, descriptor in zip(NODE_PARAMETERS.values(), values, descriptors):
        assert value == (
            list(option.default) if isinstance(option.default, tuple) else option.default)
        assert descriptor.description == option.description
        assert descriptor.read_only is not option.live
        assert all(choice in descriptor.additional_constraints for choice in option.choices or ())
        limits = [*descriptor.integer_range, *descriptor.floating_point_range]
        assert [(one.from_value, one.to_value) for one in limits] == (
            [] if option.minimum is None else [(option.minimum, option.maximum)])


def test_changes_take_effect_at_the_next_image(tmp_path):
    images, R_world_camera = turning_spheres(8)
    R_world_camera = R_world_camera[0].inv() * R_world_camera
    with stabilizer(tmp_path, topics=(
            'orientation', 'view/image', 'view/camera_info', 'view/image/compressed')) as peer:
        for image, time_ns in zip(images, stamps_of(4)):
            peer.stabilize(image, time_ns)
        large = len(peer.received['view/image/compressed'][-1].data)

        assert not any(peer.set_parameters(
            view__width=200, view__height=100, view__hfov_deg=60., jpeg_quality=5))
        peer.stabilize(images[3], stamps_of(5)[-1])
        view, info = peer.received['view/image'][-1], peer.received['view/camera_info'][-1]
        assert (view.width, view.height, info.width, info.height) == (200, 100, 200, 100)
        assert np.isclose(info.k[0], 100 / np.tan(np.deg2rad(30)))
        assert np.allclose((info.k[2], info.k[5]), (99.5, 49.5))
        assert len(peer.received['view/image/compressed'][-1].data) < large / 4

        # Another estimator takes over in the orientation reached.
        assert peer.set_parameters(estimator='pts', working_width=256) == ['', '']
        for i, time_ns in zip(range(3, 8), stamps_of(10)[5:]):
            R = peer.stabilize(images[i], time_ns)
            assert angle_deg(R, R_world_camera[i]) < 0.5
        assert peer.get_parameters('estimator', 'view.width') == ['pts', 200]


def test_nobody_waits_until_the_estimator_is_done(tmp_path):
    """Answers come while an image is being worked on; of what is asked the next image is told."""
    images, _ = turning_spheres(4)
    first_ns, second_ns, third_ns = stamps_of(3)
    program = HELD_STABILIZER, str(tmp_path)
    with stabilizer(tmp_path, '-p', 'estimator:=moment', program=program) as peer:
        answers = peer.received['orientation']
        peer.stabilize(images[0], first_ns)
        (tmp_path / 'hold').touch()
        peer.send(images[1], second_ns)
        peer.wait_until((tmp_path / 'held').exists)
        assert peer.set_parameters(estimator='pts', working_width=256) == ['', '']
        assert peer.reset().success
        assert len(answers) == 1

        (tmp_path / 'hold').unlink()
        peer.wait_until(lambda: len(answers) == 2)
        assert rotation(answers[1]).magnitude() > 0
        assert peer.stabilize(images[3], third_ns).magnitude() == 0


def test_refusals_name_the_reason_and_change_nothing(tmp_path):
    wrong = {
        'estimator': ('best', 'estimator is one of anchored, pts, moment, pts_epipolar'),
        'view.hfov_deg': (500., 'out of range'),
        'view.yaw_deg': (float('nan'), 'out of range'),
        'view.width': ('wide', 'Wrong parameter type'),
        'mask': ('/there/is/no.png', "'/there/is/no.png' cannot be read"),
        'image_transport': ('compressed', 'read-only'),
        'views': (['front'], 'read-only'),
        'publish_tf': ('yes', 'Wrong parameter type'),
        'front_marker': ('everywhere', 'front_marker is one of none, views, all'),
        'cmd_vel_timeout_s': (0., 'out of range'),
    }
    with stabilizer(tmp_path) as peer:
        before = peer.get_parameters(*NODE_PARAMETERS)
        for name, (value, reason) in wrong.items():
            answer, = peer.set_parameters(**{name: value})
            assert reason in answer
        assert peer.get_parameters(*NODE_PARAMETERS) == before


def test_no_value_and_no_call_ends_the_node(tmp_path):
    closed = tmp_path / 'closed'
    closed.mkdir(mode=0o000)
    # A picture of a billion pixels, by its header.
    huge = tmp_path / 'huge.pgm'
    huge.write_bytes(b'P5 60000 30000 255 ')
    masks = 'x' * 5000, f'{closed}/mask.png', str(tmp_path), str(huge)
    nothing = ParameterValue(type=ParameterType.PARAMETER_NOT_SET)
    with stabilizer(tmp_path) as peer:
        for mask in masks:
            answer, = peer.set_parameters(mask=mask)
            assert 'cannot be read as an image' in answer
        for value in (nothing, ParameterValue(type=77)):
            # That rclpy itself answers is not ours to promise.
            peer.call_in_vain(SetParameters, 'stabilizer/set_parameters', SetParameters.Request(
                parameters=[Parameter(name='level', value=value)]))
        assert peer.set_parameters(level='imu') == ['']
        peer.wait_until(lambda: peer.subscribers('/imu') == ['stabilizer'])
        peer.stabilize(turning_spheres(1)[0][0], 1)


@pytest.mark.parametrize('arguments, reason', (
    (['-p', 'estimator:=best'], 'estimator is one of'),
    (['-p', 'views:=front'], "'views'"),
    (['-p', 'views:=[front-left]'], "'front-left' cannot be a view: letters, digits"),
    (['-p', 'nonsense'], 'nonsense'),
    (['-p', 'image_transport:=ffmpeg'],
     'image_transport ffmpeg needs ffmpeg_image_transport_msgs, which is not installed'),
    # What is listened to later, if at all, is checked now.
    (['-p', 'qos_overrides./imu.subscription.reliability:=reliabel'], 'reliabel'),
    (['-p', 'qos_overrides./imu.subscription.depth:=-1'], 'a depth is at least 1'),
    *(pytest.param(*one, marks=pytest.mark.slow) for one in (
        (['-p', 'image_transport:=foxglove'], 'needs foxglove_msgs, which is not installed'),
        (['-p', 'qos_overrides./image.subscription.reliability:=reliabel'], 'reliabel'),
        (['-p', 'qos_overrides./orientation.publisher.depth:=99999999999999'], 'is at least 1'),
        (['-p', 'qos_overrides./orientation.publisher.reliability:=unknown'], "be 'unknown'"),
        (['-p', 'view.hfov_deg:=500.0'], 'out of range'),
        (['-p', 'mask:=lat:5'], "mask 'lat:5' is not of the form"),
        (['-p', 'view.width:=wide'], "'view.width'"),
        (['-p', 'views:=[]'], 'views is a list of names'),
        (['-p', 'views:=[front, front]'], 'different names'),
        (['-p', 'views:=[stabilized]'], "'stabilized' cannot be a view: something else"),
        (['-p', 'view.frame_id:=stabilized_optical'], 'must be different names'))),
))
def test_it_does_not_start_with_wrong_values(arguments, reason):
    if 'not installed' in reason and find_spec(reason.split()[-5].rstrip(',')):
        pytest.skip('it is installed')
    done = start('--ros-args', *arguments)
    assert done.returncode == 2
    said = [line for line in done.stderr.splitlines() if line.startswith('stabilizer: ')]
    assert len(said) == 1 and reason in said[0]
    assert 'Traceback' not in done.stderr


def test_wrong_command_lines_are_refused():
    done = start('--estimator', 'pts')
    assert done.returncode == 2
    assert done.stderr == 'stabilizer: unrecognized arguments: --estimator pts\n'


def start(*arguments):
    return subprocess.run(
        [sys.executable, '-m', 'sph_stab_ros.stabilizer', *arguments], text=True, timeout=60,
        env={**os.environ, 'ROS_DOMAIN_ID': str(next(DOMAINS))}, capture_output=True)


FILE = """\
/**:
  ros__parameters: {use_sim_time: false, jpeg_quality: 50, front: {width: 100}}
stabilizer:
  ros__parameters:
    views: [front, rear]
    estimator: moment
    publish_tf: no
    fisheye: {front.k1: 0.01, rear: {yaw_deg: 170.0}}
    smoothing.mode: follow
    rear: {yaw_deg: 180.0, frame_id: behind}
    view: {width: 99}
"""


@pytest.mark.parametrize('words', ((), ('-p', 'level:=imu', '-p', 'rear.height:=77')))
def test_a_file_gives_the_node_what_it_gives_to_replay(tmp_path, words):
    file = tmp_path / 'robot.yaml'
    file.write_text(FILE)
    words = ['--params-file', str(file), *words]
    context = Context()
    rclpy.init(context=context, domain_id=next(DOMAINS), args=['node', '--ros-args', *words])
    node = rclpy.create_node('stabilizer', context=context)
    settings = declare_parameters(node)
    node.destroy_node()
    context.try_shutdown()
    assert settings == replay_arguments(['rec', *words])[1]
    assert settings.views['rear'].frame_id == 'behind'
    assert settings.config.fisheye.rear.yaw_deg == 170
    assert not settings.config.publish_tf


def test_whoever_comes_late_is_told_where_durability_says_so(tmp_path):
    durable = '-p', 'qos_overrides./view/camera_info.publisher.durability:=transient_local'
    first_ns, = stamps_of(1)
    with stabilizer(tmp_path, *durable) as peer:
        peer.stabilize(turning_spheres(1)[0][0], first_ns)
        infos = []
        peer.subscribe(CameraInfo, 'view/camera_info', infos.append, LATCHED)
        peer.wait_until(lambda: infos)
        assert Time.from_msg(infos[0].header.stamp).nanoseconds == first_ns


def test_misspelt_parameters_are_named(tmp_path):
    with stabilizer(tmp_path, '-p', 'estimatr:=pts') as peer:
        assert "there is no parameter 'estimatr'" in peer.output()


@pytest.mark.parametrize('remappings, topic', (
    ([], '/image/compressed'),
    (['image:=/theta/image_raw'], '/theta/image_raw/compressed'),
    (['image/compressed:=/jpeg'], '/jpeg'),
    (['image:=/theta/image_raw', 'image/compressed:=/jpeg'], '/jpeg'),
))
def test_compressed_images_go_where_the_raw_ones_go(remappings, topic):
    context = Context()
    rclpy.init(context=context, domain_id=next(DOMAINS))
    arguments = [word for rule in remappings for word in ('-r', rule)]
    node = rclpy.create_node('node', context=context, cli_args=['--ros-args', *arguments])
    resolved = node.resolve_topic_name(compressed_topic(node, 'image'))
    node.destroy_node()
    context.try_shutdown()
    assert resolved == topic
