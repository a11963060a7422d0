# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Views of the real node: named, steered, marked, and steady while the robot turns."""

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from sph_stab_ros.geometry.equirect import pixels_from_bearings
from sph_stab_ros.geometry.warp import perspective_view, rotate_equirect, view_rotation
from sph_stab_ros.images.front_marker import mark_sphere, mark_view
from tiny_recordings import stamps_of

pytest.importorskip('rclpy', reason='rclpy is not installed')
from node_harness import (  # noqa: E402, I100
    compass_sphere, pixels, shown_direction, stabilizer, stamp_ns)

VIEWS = ('front', 'rear')
TIMEOUT_S = 0.4
FORWARD, LEFT, BACK, UP, DOWN = (0, 0, 1), (-1, 0, 0), (0, 0, -1), (0, -1, 0), (0, 1, 0)
SPHERE = compass_sphere()


class Observer:
    """Sends the same sphere again and again and tells what the views show."""

    def __init__(self, peer):
        self.peer = peer
        self._stamps_ns = iter(stamps_of(100000))

    def send(self, sphere=SPHERE):
        """Send a sphere and wait for the answers; return their stamp."""
        sent_ns = next(self._stamps_ns)
        self.peer.stabilize(sphere, sent_ns)
        return sent_ns

    def last(self, topic):
        """Return the last message of a topic."""
        return self.peer.received[topic][-1]

    def shows(self, view, direction, sphere=SPHERE):
        """Tell whether the centre of a view shows a direction of the compass sphere."""
        self.send(sphere)
        return np.allclose(shown_direction(self.last(f'{view}/image')), direction, atol=0.06)

    def hfov_deg(self, view):
        """Return the field of view that the camera model of a view has."""
        self.send()
        info = self.last(f'{view}/camera_info')
        return np.rad2deg(2 * np.arctan(info.width / 2 / info.k[0]))

    def turned_once(self, view, **twist):
        """Send one Twist and wait until it has no effect any more."""
        self.peer.turn(view, **twist)
        self.peer.spin_for(2 * TIMEOUT_S)


@pytest.fixture(scope='module')
def running(tmp_path_factory):
    """Return an Observer of a node with two views, small enough for shared memory."""
    with stabilizer(
            tmp_path_factory.mktemp('views'), '-p', 'views:=[front, rear]', '-p',
            'rear.yaw_deg:=180.0', '-p', 'rear.hfov_deg:=60.0', '-p', 'front.width:=160', '-p',
            'front.height:=120', '-p', 'rear.width:=320', '-p', 'rear.height:=240', '-p',
            f'cmd_vel_timeout_s:={TIMEOUT_S}', '-p', 'rear.frame_id:=looking_back',
            '-p', 'working_width:=192', views=VIEWS, topics=(
                'orientation', 'stabilized/image', 'front/image', 'rear/image',
                'rear/image/compressed', 'front/camera_info', 'rear/camera_info')) as peer:
        yield Observer(peer)


@pytest.fixture
def observer(running):
    """Return the Observer with views that look as they did at the start."""
    assert not any(running.peer.set_parameters(
        front__yaw_deg=0., front__hfov_deg=90., rear__yaw_deg=180., rear__hfov_deg=60.,
        front_marker='none', front_yaw_deg=0.))
    return running


def test_each_view_has_its_own_picture_model_and_frame(observer):
    assert observer.shows('front', FORWARD) and observer.shows('rear', BACK)
    assert np.isclose(observer.hfov_deg('front'), 90)
    assert np.isclose(observer.hfov_deg('rear'), 60)
    sent_ns = observer.send()
    for view, frame, size_wh in (('front', 'front_optical', (160, 120)),
                                 ('rear', 'looking_back', (320, 240))):
        image, info = (observer.last(f'{view}/{end}') for end in ('image', 'camera_info'))
        for msg in (image, info):
            assert (msg.header.frame_id, stamp_ns(msg)) == (frame, sent_ns)
            assert (msg.width, msg.height) == size_wh
    jpeg, raw = observer.last('rear/image/compressed'), observer.last('rear/image')
    assert jpeg.header.frame_id == 'looking_back'
    assert np.abs(pixels(jpeg).astype(int) - pixels(raw)).mean() < 5


def test_the_camera_model_is_exact(observer):
    """Each pixel shows what the sphere has along the bearing that the model gives it."""
    observer.peer.reset()
    observer.send()
    info, image = observer.last('front/camera_info'), pixels(observer.last('front/image'))
    v, u = np.mgrid[:info.height, :info.width]
    bearings = np.stack((u, v, np.ones_like(u)), axis=-1) @ np.linalg.inv(
        np.reshape(info.k, (3, 3))).T
    read_at = np.float32(pixels_from_bearings(bearings, SPHERE.shape[1]))
    expected = cv2.remap(SPHERE, read_at, None, cv2.INTER_LINEAR)
    assert np.abs(image.astype(int) - expected).max() <= 3


def test_parameters_and_directions_turn_the_view_of_their_name(observer):
    assert observer.peer.set_parameters(front__pitch_deg=90.) == ['']
    assert observer.shows('front', UP) and observer.shows('rear', BACK)
    assert observer.peer.set_parameters(front__pitch_deg=0.) == ['']
    observer.peer.look(view_rotation(np.pi / 2).as_quat(), 'stabilized_optical', view='rear')
    observer.peer.wait_until(lambda: observer.shows('rear', LEFT))
    assert observer.shows('front', FORWARD)
    names = observer.peer.list_parameters()
    assert {'front.width', 'rear.hfov_deg'} <= names
    assert not any(name.startswith('view.') for name in names)


@pytest.mark.parametrize('twist, turned', (
    ({'angular': (0, 0, np.pi / 2 / TIMEOUT_S)}, LEFT),
    ({'linear': (0, 0, 99)}, UP),
    ({'angular': (0, 99, 0)}, DOWN),
    ({'linear': (0, 99, 0), 'angular': (99, 0, 0)}, FORWARD),
))
def test_velocities_turn_a_view_until_they_are_overdue(observer, twist, turned):
    """One message turns by its rate times the timeout, no further than straight up or down."""
    observer.turned_once('front', **twist)
    for _ in range(2):
        assert observer.shows('front', turned) and observer.shows('rear', BACK)


def test_velocities_go_on_while_messages_come_and_stop_with_a_zero(observer):
    def stands():
        observer.send()
        shown = shown_direction(observer.last('front/image'))
        observer.peer.spin_for(0.2)
        return observer.shows('front', shown)

    assert observer.peer.set_parameters(cmd_vel_timeout_s=60.) == ['']
    observer.peer.turn('front', angular=(0, 0, 1))
    observer.peer.wait_until(lambda: not stands())
    observer.peer.turn('front')
    observer.peer.wait_until(stands)
    assert observer.peer.set_parameters(cmd_vel_timeout_s=TIMEOUT_S) == ['']


def test_velocities_zoom_to_the_limits(observer):
    observer.turned_once('front', linear=(99, 0, 0))
    assert np.isclose(observer.hfov_deg('front'), 10)
    observer.turned_once('front', linear=(-99, 0, 0))
    assert np.isclose(observer.hfov_deg('front'), 150)
    assert np.isclose(observer.hfov_deg('rear'), 60)
    assert observer.shows('front', FORWARD)
    observer.turned_once('rear', linear=(1, 0, 0))
    assert np.isclose(np.tan(np.deg2rad(observer.hfov_deg('rear')) / 2),
                      np.tan(np.deg2rad(30)) * np.exp(-TIMEOUT_S))
    assert observer.peer.set_parameters(front__hfov_deg=90.) == ['']
    assert np.isclose(observer.hfov_deg('front'), 90)


def test_velocities_that_are_none_are_refused_with_a_reason(observer):
    observer.turned_once('front', angular=(0, 0, np.nan))
    assert 'front/cmd_vel ignored: angular.z' in observer.peer.output()
    assert observer.shows('front', FORWARD)


def test_look_at_home_turns_all_views_to_the_front(observer):
    observer.turned_once('front', linear=(0, 0, 99))
    response = observer.peer.look_at_home()
    assert response.success and response.message
    assert observer.shows('front', FORWARD) and observer.shows('rear', FORWARD)


def test_the_view_stays_when_the_robot_turns(observer):
    assert observer.peer.set_parameters(front__yaw_deg=90.) == ['']
    observer.peer.reset()
    for angle_deg in (*range(0, 31, 2), *range(28, -1, -4)):
        R_world_camera = Rotation.from_euler('YX', (angle_deg, angle_deg / 4), degrees=True)
        turned = rotate_equirect(SPHERE, R_world_camera)
        assert observer.shows('front', LEFT, turned) and observer.shows('rear', BACK, turned)
    observer.peer.reset()


def test_the_front_is_marked_where_it_is(observer):
    observer.peer.reset()
    assert not any(observer.peer.set_parameters(front_marker='views', front_yaw_deg=20.))
    observer.send()
    plain = perspective_view(SPHERE, Rotation.identity(), np.deg2rad(90), (160, 120))
    marked = plain.copy()
    mark_view(marked, Rotation.identity(), np.deg2rad(20), np.deg2rad(90))
    shown = pixels(observer.last('front/image')).astype(int)
    assert np.abs(shown - marked).max() <= 2 < np.abs(shown - plain).max()
    assert np.abs(pixels(observer.last('stabilized/image')).astype(int) - SPHERE).max() <= 2

    assert observer.peer.set_parameters(front_marker='all') == ['']
    observer.send()
    marked = SPHERE.copy()
    mark_sphere(marked, Rotation.identity(), np.deg2rad(20))
    assert np.abs(pixels(observer.last('stabilized/image')).astype(int) - marked).max() <= 2


@pytest.mark.parametrize('mode, R_world_view', (
    ('lock', Rotation.identity()), ('follow', view_rotation(0.7, 0.3)),
    ('yaw_follow', view_rotation(0.7))))
def test_the_view_keeps_of_a_turn_what_the_mode_says(observer, mode, R_world_view):
    """Once the camera has stood long enough after it, 0.7 rad to the left and 0.3 up."""
    observer.peer.reset()
    assert not any(observer.peer.set_parameters(
        smoothing__mode=mode, smoothing__time_constant_s=0.1))
    for share in (*np.linspace(0, 1, 21), *np.ones(20)):
        observer.send(rotate_equirect(SPHERE, view_rotation(0.7 * share, 0.3 * share)))
    expected = perspective_view(SPHERE, R_world_view, np.deg2rad(90), (160, 120))
    assert np.abs(pixels(observer.last('front/image')).astype(int) - expected).mean() < 3
    assert not any(observer.peer.set_parameters(
        smoothing__mode='lock', smoothing__time_constant_s=2.))
    observer.peer.reset()


def test_spheres_that_follow_the_camera_are_in_a_frame_of_their_own(observer):
    observer.peer.reset()
    assert observer.peer.set_parameters(smoothing__mode='follow') == ['']
    for angle_deg in range(0, 13, 2):
        observer.send(rotate_equirect(SPHERE, view_rotation(np.deg2rad(angle_deg))))
    assert observer.last('stabilized/image').header.frame_id == 'virtual_optical'
    assert observer.last('orientation').header.frame_id == 'stabilized_optical'
    assert observer.peer.set_parameters(smoothing__mode='lock') == ['']
    observer.peer.reset()
    observer.send()
    assert observer.last('stabilized/image').header.frame_id == 'stabilized_optical'
