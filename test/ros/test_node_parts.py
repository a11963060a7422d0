# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What the node is made of, each by itself."""

import threading
from time import monotonic, process_time, sleep
from unittest import mock

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from sph_stab_ros.geometry.equirect import bearing_grid
from sph_stab_ros.geometry.warp import perspective_view
from sph_stab_ros.images.codec import fill_image
from sph_stab_ros.recording.messages import camera_info, orientation, pose
from sph_stab_ros.ros.mailbox import Mailbox
from sph_stab_ros.ros.worker import Worker
from sph_stab_ros.stabilization.stabilized_frame import StabilizedFrame
from sph_stab_ros.stabilization.steering import Rates
from tiny_recordings import START_NS, textured_sphere

rclpy = pytest.importorskip('rclpy', reason='rclpy is not installed')
from geometry_msgs.msg import (  # noqa: E402, I100
    Quaternion, QuaternionStamped, Twist, Vector3)
from node_harness import DOMAINS  # noqa: E402
from rclpy.serialization import serialize_message  # noqa: E402
from sensor_msgs.msg import Image, Imu  # noqa: E402
from sph_stab_ros.ros import diagnostics, imu_input  # noqa: E402
from sph_stab_ros.ros.cpu_meter import CpuMeter  # noqa: E402
from sph_stab_ros.ros.image_input import ReceivedImage  # noqa: E402
from sph_stab_ros.ros.messages import (  # noqa: E402
    make, rates_from_twist, rotation_from_message)
from sph_stab_ros.ros.node import StabilizerNode  # noqa: E402


@pytest.mark.parametrize('frame_id', ('', 'i', 'imu_link', 'imu/täter', 'a' * 1001))
def test_a_serialized_imu_is_read_as_rclpy_reads_it(frame_id):
    rates, forces = np.random.default_rng(0).normal(size=(2, 3)).tolist()
    msg = Imu(angular_velocity=Vector3(**dict(zip('xyz', rates))),
              linear_acceleration=Vector3(**dict(zip('xyz', forces))))
    msg.header.frame_id = frame_id
    msg.header.stamp.sec, msg.header.stamp.nanosec = -7, 123
    msg.orientation_covariance[8] = 1
    msg.angular_velocity_covariance[0], msg.linear_acceleration_covariance[0] = 2, 3
    stamp_ns, numbers = imu_input.deserialized(serialize_message(msg))
    assert stamp_ns == -7 * 10**9 + 123
    assert numbers[imu_input.RATE].tolist() == rates
    assert numbers[imu_input.FORCE].tolist() == forces
    assert numbers[[imu_input.RATE_COVARIANCE, imu_input.FORCE_COVARIANCE]].tolist() == [2, 3]


def test_mailbox_keeps_the_newest_and_counts_the_others():
    mailbox = Mailbox()
    for item in range(1, 5):
        mailbox.put(item)
    assert (mailbox.get(), mailbox.dropped) == (4, 3)
    mailbox.put(5)
    assert (mailbox.get(), mailbox.dropped) == (5, 3)


def test_a_larger_mailbox_keeps_the_order_and_gives_up_all_when_it_is_full():
    """Of video nothing can be decoded behind a gap."""
    mailbox = Mailbox(3)
    for item in range(3):
        mailbox.put(item)
    assert [mailbox.get(), mailbox.get()] == [0, 1]
    for item in range(3, 6):
        mailbox.put(item)
    assert (mailbox.get(), mailbox.dropped) == (5, 3)


def test_mailbox_lets_go_who_waits_when_it_is_closed():
    mailbox = Mailbox()
    got = []
    waiting = threading.Thread(target=lambda: got.append(mailbox.get()))
    waiting.start()
    mailbox.close()
    waiting.join(10)
    mailbox.put('too late')
    assert got == [None] and mailbox.get() is None


def test_worker_works_on_the_newest_and_finishes_what_it_has_begun():
    begun, go_on, done = threading.Event(), threading.Event(), []

    def work(number, text):
        begun.set()
        go_on.wait(10)
        done.append((number, text))
    worker = Worker('test', work)
    worker.start()
    worker.put(1, 'first')
    assert begun.wait(10)
    for number in (2, 3, 4):
        worker.put(number, 'later')
    go_on.set()
    end_s = monotonic() + 10
    while len(done) < 2 and monotonic() < end_s:
        sleep(0.01)
    assert (done, worker.dropped) == ([(1, 'first'), (4, 'later')], 2)
    begun.clear()
    go_on.clear()
    worker.put(5, 'last')
    assert begun.wait(10)
    threading.Timer(0.1, go_on.set).start()
    worker.close()
    assert done[-1] == (5, 'last')


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
        msg = orientation(make, 5, 'world', R)
        assert (rotation_from_message(msg).inv() * R).magnitude() < 1e-9


def test_camera_info_projects_what_the_view_shows():
    info = camera_info(make, 5, 'view', np.deg2rad(70), (300, 200))
    # A view of the sphere of all bearings shows those of its own pixels.
    bearings = perspective_view(
        bearing_grid(2048), Rotation.identity(), np.deg2rad(70), (300, 200)).reshape(-1, 3)
    projected = bearings @ info.k.reshape(3, 3).T
    pixels = np.stack(np.meshgrid(np.arange(300), np.arange(200)), axis=-1).reshape(-1, 2)
    assert np.allclose(projected[:, :2] / projected[:, 2:], pixels, atol=0.05)
    assert np.array_equal(info.p.reshape(3, 4)[:, :3], info.k.reshape(3, 3))
    assert (info.width, info.height, info.header.frame_id) == (300, 200, 'view')


def test_covariances_are_about_the_axes_of_the_world():
    covariance = np.diag((1., 2., 3.)) + 0.1
    msg = pose(make, 5, 'world', Rotation.identity(), covariance)
    whole = np.reshape(msg.pose.covariance, (6, 6))
    assert np.array_equal(whole[3:, 3:], covariance)
    assert (np.diag(whole)[:3] >= 1e6).all() and not whole[:3, 3:].any()


def test_twists_turn_left_down_up_and_closer():
    def rates(linear=(0., 0., 0.), angular=(0., 0., 0.)):
        return rates_from_twist(Twist(linear=Vector3(**dict(zip('xyz', linear))),
                                      angular=Vector3(**dict(zip('xyz', angular)))))

    assert rates(angular=(5., 0., 1.)) == Rates(yaw_rad_s=1.)
    # REP 103: about the axis to the left the nose goes down.
    assert rates(angular=(0., 1., 0.)) == Rates(pitch_rad_s=-1.)
    assert rates(linear=(0., 5., 1.)) == Rates(pitch_rad_s=1.)
    assert rates(linear=(1., 0., 0.)) == Rates(zoom_per_s=1.)
    for value in (np.nan, np.inf):
        with pytest.raises(ValueError, match='angular.z'):
            rates(angular=(0., 0., value))


def test_stages_share_the_cpu():
    meter = CpuMeter()
    with meter.stage('work'):
        while process_time() < meter._start_cpu_s + 0.05:
            pass
    percentages = meter.percentages()
    assert 0 < percentages['work'] <= percentages['total']
    assert meter.percentages()['work'] == 0


@pytest.fixture
def node():
    """Return a StabilizerNode whose workers rest."""
    rclpy.init(args=[], domain_id=next(DOMAINS),
               signal_handler_options=rclpy.signals.SignalHandlerOptions.NO)
    try:
        node = StabilizerNode()
        yield node
        node.destroy_node()
    finally:
        rclpy.try_shutdown()


def test_a_keyframe_that_fails_is_no_refusal_of_its_picture(node):
    image = fill_image(Image(), textured_sphere(256))
    with mock.patch.object(node._stabilizer, 'settle', side_effect=MemoryError('no room')):
        node._safely(node._track, ReceivedImage(image, START_NS, 'camera', monotonic()))
    status = node._diagnostics.status(dropped=0, not_drawn=0)
    values = {pair.key: pair.value for pair in status.values}
    assert (values['frames'], values['refused'], status.message) == ('1', '0', 'ok')
    assert values['notice: keyframe_failed'] == '1'


def test_pictures_and_messages_are_made_for_subscribers_only(node):
    stabilized = mock.Mock(spec=StabilizedFrame, frame=mock.Mock(frame_id='camera'), stamp_ns=5,
                           covariance=np.eye(3), **dict.fromkeys(
        ('R_world_camera', 'R_world_virtual', 'R_camera_virtual'), Rotation.identity()))
    with mock.patch('rclpy.publisher.Publisher.publish') as publish:
        node._outputs.publish(node._outputs.publish_orientation(stabilized))
    publish.assert_not_called()
    stabilized.sphere.assert_not_called()
    stabilized.view.assert_not_called()
