# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""A bag of results holds what the node publishes of the same pictures, to the last byte."""

from collections import defaultdict
from unittest import mock

import numpy as np
import pytest
from sph_stab_ros.recording import open_recording
from sph_stab_ros.recording.bag_writer import BagWriter
from sph_stab_ros.replay import main as replay
from tiny_recordings import IMAGE_TOPIC, stamps_of, turning_spheres, write_bag

rclpy = pytest.importorskip('rclpy', reason='rclpy is not installed')
from node_harness import DOMAINS  # noqa: E402, I100
from rclpy.publisher import Publisher  # noqa: E402
from sensor_msgs.msg import CompressedImage  # noqa: E402
from sph_stab_ros.player import message_type  # noqa: E402
from sph_stab_ros.ros.messages import copy_fields  # noqa: E402
from sph_stab_ros.ros.node import StabilizerNode  # noqa: E402

ARGUMENTS = [
    'view.yaw_deg:=90.0', 'view.pitch_deg:=10.0', 'view.hfov_deg:=60.0', 'view.width:=200',
    'smoothing.mode:=follow', 'smoothing.time_constant_s:=0.3', 'views:=[view, rear]',
    'front_marker:=all', 'front_yaw_deg:=20.0', 'jpeg_quality:=40']
WORDS = [word for one in ARGUMENTS for word in ('-p', one)]
# Where tf2_msgs is installed only, which the node can do without, and bags have by themselves.
TF = '/tf'


@pytest.fixture(scope='module', params=['jpeg', 'h264', 'h265', 'av1'])
def camera_bag(tmp_path_factory, request):
    """Return a bag of a camera that turns, of one format or another."""
    images, _ = turning_spheres(6)
    path = tmp_path_factory.mktemp('camera') / 'bag'
    if request.param == 'jpeg':
        return write_bag(path, images)
    encoded_video = pytest.importorskip('encoded_video')
    with BagWriter(path) as bag:
        for (_, data), stamp_ns in zip(
                encoded_video.encode(images, request.param), stamps_of(6).tolist()):
            bag.write(IMAGE_TOPIC, bag.type('sensor_msgs/msg/CompressedImage')(
                header=bag.header(stamp_ns, 'theta_camera'), format=request.param,
                data=np.frombuffer(data, np.uint8)), stamp_ns)
    return path


@pytest.fixture(scope='module')
def result(camera_bag, tmp_path_factory):
    """Return the bag of results."""
    path = tmp_path_factory.mktemp('result') / 'bag'
    assert replay([str(camera_bag), str(path), *WORDS]) == 0
    return open_recording(path, 'stabilized/image/compressed')


@pytest.fixture(scope='module')
def published(camera_bag):
    """Return the messages that a node publishes for which everybody listens, by topic."""
    messages = defaultdict(list)

    def publish(publisher, msg):
        messages[publisher.topic_name.removeprefix('/')].append(msg)
    rclpy.init(args=['--ros-args', *WORDS],
               domain_id=next(DOMAINS),
               signal_handler_options=rclpy.signals.SignalHandlerOptions.NO)
    try:
        node = StabilizerNode()
        with mock.patch.object(Publisher, 'publish', publish), \
                mock.patch.object(Publisher, 'get_subscription_count', lambda _: 1):
            for _, recorded in open_recording(camera_bag).messages(IMAGE_TOPIC):
                node._images._on_image(copy_fields(recorded, CompressedImage()))
                if recorded.format in ('h264', 'h265', 'av1'):
                    node._images._decode(*node._images._decoding._mailbox.get())
                node._track(*node._tracking._mailbox.get())
                node._draw(*node._drawing._mailbox.get())
        node.destroy_node()
    finally:
        rclpy.try_shutdown()
    return messages


def test_the_bag_has_the_node_s_topics(result, published):
    raw = {topic for topic in published if topic.endswith('/image')}
    assert len(raw) == 3
    assert result.topics.keys() - {TF} == published.keys() - raw - {TF.removeprefix('/')}


def test_the_bag_s_messages_are_the_node_s(result, published):
    for topic in published.keys() & result.topics.keys():
        of_the_bag = [copy_fields(msg, message_type(result.topics[topic])())
                      for _, msg in result.messages(topic)]
        assert of_the_bag == published[topic], topic


def test_the_bag_s_transforms_lead_from_the_camera_to_all_else(result):
    heard = [msg.transforms for _, msg in result.messages(TF)]
    assert len(heard) == 6
    for transforms in heard:
        assert [(one.header.frame_id, one.child_frame_id) for one in transforms] == [
            ('theta_camera', 'stabilized_optical'), ('stabilized_optical', 'virtual_optical'),
            ('stabilized_optical', 'view_optical'), ('stabilized_optical', 'rear_optical')]
