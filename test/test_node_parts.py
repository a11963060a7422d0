# Copyright 2026 The sph_stab_ros developers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""What the node is made of, each by itself."""

import threading
from unittest import mock

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from sph_stab_ros.config import ViewConfig
from sph_stab_ros.ros.one_slot_mailbox import OneSlotMailbox
from sph_stab_ros.stabilization import StabilizedFrame
from sph_stab_ros.warp import perspective_warp

rclpy = pytest.importorskip('rclpy', reason='rclpy is not installed')
from builtin_interfaces.msg import Time  # noqa: E402, I100
from geometry_msgs.msg import Quaternion, QuaternionStamped  # noqa: E402
from node_harness import DOMAINS  # noqa: E402
from sph_stab_ros.ros import diagnostics  # noqa: E402
from sph_stab_ros.ros.messages import (  # noqa: E402
    orientation_message, rotation_from_message, view_camera_info)
from sph_stab_ros.stabilizer import StabilizerNode  # noqa: E402
from std_msgs.msg import Header  # noqa: E402


def test_mailbox_keeps_the_newest_and_counts_the_others():
    mailbox = OneSlotMailbox()
    for item in range(1, 5):
        mailbox.put(item)
    assert (mailbox.get(), mailbox.dropped) == (4, 3)
    mailbox.put(5)
    assert (mailbox.get(), mailbox.dropped) == (5, 3)


def test_mailbox_lets_go_who_waits_when_it_is_closed():
    mailbox = OneSlotMailbox()
    got = []
    waiting = threading.Thread(target=lambda: got.append(mailbox.get()))
    waiting.start()
    mailbox.close()
    waiting.join(10)
    mailbox.put('too late')
    assert got == [None] and mailbox.get() is None


def test_log_says_each_kind_once_in_a_while(monkeypatch):
    said = []
    now_s = 100.
    monkeypatch.setattr(diagnostics, 'monotonic', lambda: now_s)
    log = diagnostics.ThrottledLog(said.append)
    for kind in 'aabaa':
        log.warn(kind, f'{kind} is wrong')
    assert said == ['a is wrong', 'b is wrong']
    now_s += diagnostics.LOG_PERIOD_S
    log.warn('a', 'a is wrong')
    assert said[2:] == ['a is wrong (3 more of these before)']


@pytest.mark.parametrize('quaternion', (
    (0, 0, 0, 0), (0, 0, 0, np.nan), (np.inf, 0, 0, 0), (1, 0, 0, 1), (0, 0, 0, 0.9)))
def test_directions_need_a_unit_quaternion(quaternion):
    x, y, z, w = map(float, quaternion)
    with pytest.raises(ValueError, match='not a unit quaternion'):
        rotation_from_message(QuaternionStamped(quaternion=Quaternion(x=x, y=y, z=z, w=w)))


def test_rotations_survive_the_message():
    for R in Rotation.random(10, random_state=0):
        msg = orientation_message(Header(), R)
        assert (rotation_from_message(msg).inv() * R).magnitude() < 1e-9


def test_camera_info_projects_what_the_view_shows():
    view = ViewConfig(hfov_deg=70., width=300, height=200)
    info = view_camera_info(Header(frame_id='view'), view)
    pixels = np.random.default_rng(0).uniform((0, 0), (299, 199), size=(20, 2))
    bearings = perspective_warp(np.deg2rad(70), 300, 200).target_bearings(pixels)
    projected = bearings @ info.k.reshape(3, 3).T
    assert np.allclose(projected[:, :2] / projected[:, 2:], pixels, atol=1e-3)
    assert np.array_equal(info.p.reshape(3, 4)[:, :3], info.k.reshape(3, 3))
    assert (info.width, info.height, info.header.frame_id) == (300, 200, 'view')


def test_pictures_are_made_for_subscribers_only():
    stabilized = mock.Mock(spec=StabilizedFrame, R_world_camera=Rotation.identity())
    rclpy.init(args=[], domain_id=next(DOMAINS),
               signal_handler_options=rclpy.signals.SignalHandlerOptions.NO)
    try:
        node = StabilizerNode()
        node._publish(stabilized, Time())
        node.destroy_node()
    finally:
        rclpy.try_shutdown()
    stabilized.sphere.assert_not_called()
    stabilized.view.assert_not_called()
