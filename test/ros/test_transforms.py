# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Transforms: what tf2 makes of them is what the core says."""

from types import SimpleNamespace

import pytest
from scipy.spatial.transform import Rotation

pytest.importorskip('rclpy', reason='rclpy is not installed')
from builtin_interfaces.msg import Time  # noqa: E402, I100
from sph_stab_ros.ros import transforms  # noqa: E402
from sph_stab_ros.ros.transforms import camera_transforms, TransformPublisher  # noqa: E402
from std_msgs.msg import Header  # noqa: E402

R_WORLD_CAMERA, R_WORLD_VIEW, R_WORLD_VIRTUAL = Rotation.random(3, random_state=5)
HEADER = Header(stamp=Time(sec=5, nanosec=6), frame_id='theta')
LEAVES = {'view': R_WORLD_VIEW, 'virtual': R_WORLD_VIRTUAL}


def rotation(transform):
    """Return the Rotation of a TransformStamped, which has no translation."""
    t, q = transform.transform.translation, transform.transform.rotation
    assert (t.x, t.y, t.z) == (0, 0, 0)
    return Rotation.from_quat((q.x, q.y, q.z, q.w))


def looked_up(messages, target, source):
    """Return R_target_source as tf2 chains it: up from the source, then down to the target."""
    parents = {msg.child_frame_id: (msg.header.frame_id, rotation(msg)) for msg in messages}

    def from_root(frame):
        R_root_frame = Rotation.identity()
        while frame in parents:
            frame, R_parent_frame = parents[frame]
            R_root_frame = R_parent_frame * R_root_frame
        return R_root_frame
    return from_root(target).inv() * from_root(source)


def test_looking_up_gives_the_rotations_of_the_core():
    messages = camera_transforms(HEADER, R_WORLD_CAMERA, 'world', LEAVES)
    for target, source, expected in (
            ('world', 'theta', R_WORLD_CAMERA),
            ('theta', 'world', R_WORLD_CAMERA.inv()),
            ('world', 'view', R_WORLD_VIEW),
            ('theta', 'view', R_WORLD_CAMERA.inv() * R_WORLD_VIEW),
            ('view', 'virtual', R_WORLD_VIEW.inv() * R_WORLD_VIRTUAL)):
        found = looked_up(messages, target, source)
        assert (found.inv() * expected).magnitude() < 1e-9


def test_the_robot_s_tree_keeps_its_parents():
    messages = camera_transforms(HEADER, R_WORLD_CAMERA, 'world', LEAVES)
    children = [msg.child_frame_id for msg in messages]
    assert sorted(children) == ['view', 'virtual', 'world']
    assert [msg.header.frame_id for msg in messages] == ['theta', 'world', 'world']
    assert all(msg.header.stamp == HEADER.stamp for msg in messages)


@pytest.fixture
def publisher(monkeypatch):
    """Return a TransformPublisher, what it publishes, and what it logs, without tf2_msgs."""
    published, said = [], []
    monkeypatch.setattr(transforms, 'TFMessage', SimpleNamespace)
    monkeypatch.setattr(transforms, 'advertise', lambda *args, **kwargs: SimpleNamespace(
        publish=published.append, get_subscription_count=lambda: 1))
    log = SimpleNamespace(warning=lambda text, once: said.append(text), info=said.append)
    return TransformPublisher(SimpleNamespace(get_logger=lambda: log), 'world'), published, said


def test_they_are_published_where_tf2_msgs_is(publisher):
    publisher, published, said = publisher
    assert publisher.wanted
    publisher.publish(HEADER, R_WORLD_CAMERA, LEAVES)
    assert [msg.child_frame_id for msg in published[0].transforms] == ['world', *LEAVES]
    assert not said


@pytest.mark.parametrize('frame_id', ('', 'world', 'view'))
def test_no_frame_becomes_its_own_parent_or_hangs_in_the_air(publisher, frame_id):
    publisher, published, said = publisher
    publisher.publish(Header(frame_id=frame_id), R_WORLD_CAMERA, LEAVES)
    assert not published
    assert said == [f"no transforms on /tf: the images have the frame_id '{frame_id}'"]


def test_without_tf2_msgs_nobody_can_want_them(monkeypatch):
    monkeypatch.setattr(transforms, 'TFMessage', None)
    said = []
    log = SimpleNamespace(info=said.append)
    publisher = TransformPublisher(SimpleNamespace(get_logger=lambda: log), 'world')
    assert not publisher.wanted
    assert said == ['no transforms on /tf: tf2_msgs is not installed']
