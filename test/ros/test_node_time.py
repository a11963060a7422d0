# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The real node under simulated time, looping bags, and cameras that start again."""

import cv2
import numpy as np
import pytest
from synthetic import angle_deg
from tiny_recordings import stamps_of, turning_spheres

pytest.importorskip('rclpy', reason='rclpy is not installed')
from node_harness import rotation, stabilizer, stamp_ns  # noqa: E402, I100

NS_PER_S = 10**9


@pytest.fixture(scope='module')
def running(tmp_path_factory):
    """Return the Peer of a node under simulated time."""
    with stabilizer(tmp_path_factory.mktemp('time'), '-p', 'use_sim_time:=true',
                    topics=('orientation', '/diagnostics')) as peer:
        # A heartbeat without any time, too.
        peer.wait_until(lambda: peer.received['/diagnostics'])
        yield peer


@pytest.fixture
def peer(running):
    """Return the Peer, with nothing received yet."""
    running.reset()
    running.received['orientation'].clear()
    return running


def counted(peer, name):
    """Return how often something was noticed, up to a second ago."""
    return int(peer.diagnostics(lambda values: True).get(f'notice: {name}', 0))


def told(peer, time_ns):
    """Tell the node the time until it is its time."""
    def is_told():
        peer.tell_time(time_ns)
        return any(stamp_ns(msg) == time_ns for msg in peer.received['/diagnostics'])
    peer.received['/diagnostics'].clear()
    peer.wait_until(is_told)


def test_simulated_time_stamps_and_may_go_back(peer):
    images, _ = turning_spheres(8)
    for time_s, image in zip((100, 101), (images[0], images[5])):
        told(peer, time_s * NS_PER_S)
        # Without a stamp it is that of its receipt.
        R_world_camera = peer.stabilize(image, 0)
        assert stamp_ns(peer.received['orientation'][-1]) == time_s * NS_PER_S
    assert R_world_camera.magnitude() > np.deg2rad(3)

    # The third picture in a row shows that it is not a false stamp or two.
    for time_s in (7, 8, 9):
        assert peer.output().count('the stamps went back by') == 0
        told(peer, time_s * NS_PER_S)
        R_world_camera = peer.stabilize(images[5], 0)
        assert stamp_ns(peer.received['orientation'][-1]) == time_s * NS_PER_S
    assert R_world_camera.magnitude() < 1e-9
    assert peer.output().count('the stamps went back by 9') == 1
    assert counted(peer, 'time_went_back') == 1


def test_before_there_is_a_time_images_without_stamps_are_refused(tmp_path):
    image, = turning_spheres(1)[0]
    with stabilizer(tmp_path, '-p', 'use_sim_time:=true',
                    topics=('orientation', '/diagnostics')) as peer:
        peer.send(image, 0)
        peer.diagnostics(lambda values: values.get('refused: no time') == '1')
        assert not peer.received['orientation']
        told(peer, 5 * NS_PER_S)
        peer.stabilize(image, 0)
        assert stamp_ns(peer.received['orientation'][-1]) == 5 * NS_PER_S


@pytest.mark.parametrize('start_s, off_s', [(0, 5), (100, -5), (200, 10**8), (300, -10**8)])
def test_one_false_stamp_never_resets_the_world(peer, start_s, off_s):
    images, R_world_camera = turning_spheres(8)
    resets, outliers = (counted(peer, name) for name in ('time_went_back', 'stamp_outlier'))
    stamps_ns = (stamps_of(8) + start_s * NS_PER_S).tolist()
    stamps_ns[4] += off_s * NS_PER_S
    orientations = [peer.stabilize(image, ns) for image, ns in zip(images, stamps_ns)]
    assert [stamp_ns(msg) for msg in peer.received['orientation']] == stamps_ns
    for R, truth in zip(orientations, R_world_camera):
        assert angle_deg(R, R_world_camera[0].inv() * truth) < 0.5
    assert counted(peer, 'stamp_outlier') == outliers + 1
    assert counted(peer, 'time_went_back') == resets


def test_a_bag_that_loops_gives_the_same_again(peer):
    images, _ = turning_spheres(8)
    before = counted(peer, 'time_went_back')
    for _ in range(3):
        for image, ns in zip(images, stamps_of(8) + 400 * NS_PER_S):
            peer.stabilize(image, ns)
    loops = np.reshape(peer.received['orientation'], (3, 8))
    # The loop is noticed, and the world begun anew, with its third picture.
    R_first_begin = rotation(loops[0, 2])
    for first, second, third in loops.T[2:]:
        assert stamp_ns(first) == stamp_ns(second) == stamp_ns(third)
        assert angle_deg(R_first_begin.inv() * rotation(first), rotation(second)) < 0.3
        assert angle_deg(rotation(second), rotation(third)) < 1e-4
    assert rotation(loops[1, 2]).magnitude() < 1e-9
    assert rotation(loops[0, -1]).magnitude() > np.deg2rad(5)
    assert counted(peer, 'time_went_back') == before + 2
    assert 'Traceback' not in peer.output()


def test_a_camera_that_comes_back_with_another_size_goes_on_where_it_was(peer):
    images, R_world_camera = turning_spheres(12)
    R_world_camera = R_world_camera[0].inv() * R_world_camera
    stamps_ns = stamps_of(100)[30:] + 400 * NS_PER_S
    for image, ns in zip(images[:6], stamps_ns):
        before = peer.stabilize(image, ns)
    for i, ns in zip(range(5, 12), stamps_ns[10:]):
        large = cv2.resize(images[i], None, fx=2, fy=2)
        R = peer.stabilize(large, ns)
        if i == 5:
            assert angle_deg(R, before) < 0.1
        assert angle_deg(R, R_world_camera[i]) < 0.5
    assert counted(peer, 'resized') == 1
    assert 'the image size changed' in peer.output()
