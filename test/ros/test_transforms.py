# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Transforms: published where tf2_msgs is installed and the images name their frame."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from sph_stab_ros.config import NodeConfig
from sph_stab_ros.images.frame import Frame
from sph_stab_ros.stabilization.stabilized_frame import StabilizedFrame
from sph_stab_ros.tracking import TrackingStatus

pytest.importorskip('rclpy', reason='rclpy is not installed')
from rclpy.qos import QoSProfile  # noqa: E402, I100
from sph_stab_ros.ros import publishers  # noqa: E402
from sph_stab_ros.ros.cpu_meter import CpuMeter  # noqa: E402
from sph_stab_ros.ros.parameters import Settings  # noqa: E402

CONFIG = NodeConfig()


@pytest.fixture
def node(monkeypatch):
    """Return what Outputs need of a node, with what is ``published`` and ``said``, but no tf2."""
    node = SimpleNamespace(published=[], said=[])

    def message_type(name):
        if name.startswith('tf2'):
            raise ImportError(name)
        return SimpleNamespace

    def advertise(_, msg_type, topic, depth):
        return SimpleNamespace(publish=lambda msg: node.published.append((topic, msg)),
                               get_subscription_count=lambda: topic == '/tf',
                               qos_profile=QoSProfile(depth=1))
    monkeypatch.setattr(publishers, 'message_type', message_type)
    monkeypatch.setattr(publishers, 'advertise', advertise)
    monkeypatch.setattr(publishers, 'View', lambda *_: SimpleNamespace(camera=lambda: None))
    monkeypatch.setattr(publishers, 'compressed_topic', lambda _, topic: f'{topic}/compressed')
    monkeypatch.setattr(publishers, 'make', lambda name, **fields: SimpleNamespace(**fields))
    node.get_logger = lambda: SimpleNamespace(
        info=node.said.append, warning=lambda text, once: node.said.append(text))
    return node


def publish(node, frame_id):
    """Let Outputs without views publish a frame."""
    settings = Settings(CONFIG, {})
    stabilized = StabilizedFrame(Frame(np.zeros((64, 128), np.uint8), 5, frame_id),
                                 Rotation.identity(), TrackingStatus.OK)
    publishers.Outputs(node, settings, None, CpuMeter()).publish_orientation(stabilized)


def test_they_are_published_where_tf2_msgs_is(node, monkeypatch):
    monkeypatch.setattr(publishers, 'message_type', lambda name: SimpleNamespace)
    publish(node, 'theta')
    (topic, msg), = node.published
    assert topic == '/tf' and len(msg.transforms) == 2
    assert not node.said


def test_images_without_a_frame_are_named(node, monkeypatch):
    monkeypatch.setattr(publishers, 'message_type', lambda name: SimpleNamespace)
    publish(node, '')
    assert not node.published
    assert node.said == ["no transforms on /tf: the images have the frame_id ''"]


def test_without_tf2_msgs_nobody_can_want_them(node):
    publish(node, 'theta')
    assert not node.published
    assert node.said == ['no transforms on /tf: tf2_msgs is not installed']
