# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What integrators expect of the real node: covariances, transforms, QoS, names, diagnostics."""

from pathlib import Path

import numpy as np
import pytest
from ruamel.yaml import YAML
from sph_stab_ros.config import StabilizerConfig, TrackerConfig
from sph_stab_ros.geometry.masks import share_of_sphere
from sph_stab_ros.images.frame import Frame
from sph_stab_ros.stabilization.pipeline import Stabilizer
from synthetic import angle_deg
from tiny_recordings import stamps_of, turning_spheres

pytest.importorskip('rclpy', reason='rclpy is not installed')
from node_harness import DOMAINS, rotation, SETTLING_S, stabilizer, stamp_ns  # noqa: E402, I100
from rclpy.qos import DurabilityPolicy, ReliabilityPolicy  # noqa: E402
from sensor_msgs.msg import Image  # noqa: E402

RVIZ = Path(__file__).resolve().parents[2] / 'config' / 'stabilizer.rviz'
WIDTH = 256
STAGES = {'cpu_percent: decode', 'cpu_percent: track', 'cpu_percent: warp',
          'cpu_percent: publish', 'cpu_percent: total'}


def statuses(peer):
    """Return the name and values of all that the node of a Peer has said on /diagnostics."""
    return [(msg.status[0].name, {pair.key: pair.value for pair in msg.status[0].values})
            for msg in peer.received['/diagnostics']]


def test_covariances_and_diagnostics_are_those_of_the_estimator(tmp_path):
    images, _ = turning_spheres(8, WIDTH)
    stamps_ns = stamps_of(20)
    offline = Stabilizer(StabilizerConfig(tracker=TrackerConfig()))
    expected = [offline.process(Frame(image, int(ns))) for image, ns in zip(images, stamps_ns)]
    with stabilizer(tmp_path, topics=(
            'orientation', 'orientation_covariance', 'view/image', '/diagnostics')) as peer:
        poses = peer.received['orientation_covariance']
        for image, ns, stabilized in zip(images, stamps_ns, expected):
            R_world_camera = peer.stabilize(image, ns)
            pose = poses[-1]
            assert (pose.header.frame_id, stamp_ns(pose)) == ('stabilized_optical', ns)
            q = pose.pose.pose.orientation
            assert np.allclose((q.x, q.y, q.z, q.w), R_world_camera.as_quat())
            assert angle_deg(R_world_camera, stabilized.R_world_camera) < 1e-4
            covariance = np.reshape(pose.pose.covariance, (6, 6))
            assert np.allclose(covariance[3:, 3:], stabilized.covariance, rtol=1e-3, atol=1e-12)
        assert np.linalg.eigvalsh(covariance[3:, 3:]).min() > 0
        said = peer.diagnostics(lambda values: values['frames'] == '8')
        assert np.isclose(float(said['uncertainty_deg']),
                          np.rad2deg(expected[-1].uncertainty_rad), atol=1e-3)
        assert int(said['keyframes']) == offline.tracker.keyframes_kept >= 1
        assert np.isclose(float(said['still_percent']),
                          100 * share_of_sphere(offline.tracker.body_mask), atol=0.06)
        misalignment, covariance = offline.tracker.lens_misalignment
        assert np.allclose(np.float64(said['lens_misalignment_deg'].split()),
                           np.rad2deg(misalignment), atol=1e-3)
        assert np.allclose(np.float64(said['lens_misalignment_sigma_deg'].split()),
                           np.rad2deg(np.sqrt(np.diag(covariance))), atol=1e-3)
        assert max(float(said[stage]) for stage in STAGES) == float(
            said['cpu_percent: total']) > 0

        # The paper's estimators do not know theirs, and nothing is made up.
        assert peer.set_parameters(estimator='pts') == ['']
        count = len(poses)
        for image, ns in zip(images[6:], stamps_ns[10:]):
            peer.send(image, ns)
            peer.wait_until(lambda: stamp_ns(peer.received['orientation'][-1]) == ns)
        said = peer.diagnostics(lambda values: values['frames'] == '10')
        assert len(poses) == count
        assert not {'uncertainty_deg', 'keyframes', 'still_percent',
                    'lens_misalignment_deg'} & said.keys()


def test_pictures_cost_nothing_while_nobody_subscribes(tmp_path):
    images, _ = turning_spheres(2, WIDTH)
    stamps_ns = iter(stamps_of(1000))

    def warping_percent(peer):
        """Return the CPU for pictures over a second in which images came."""
        peer.diagnostics(lambda values: True)
        for _ in range(4):
            peer.stabilize(images[0], next(stamps_ns))
        said = peer.diagnostics(lambda values: float(values['rate_hz']) > 0)
        return float(said.get('cpu_percent: warp', 0))

    with stabilizer(tmp_path, topics=('orientation', '/diagnostics')) as peer:
        assert warping_percent(peer) == 0
        for topic in ('stabilized/image', 'view/image'):
            seen = []
            unsubscribe = peer.subscribe(Image, topic, seen.append)
            peer.spin_for(SETTLING_S)
            # Each gives way to a newer one where drawing takes longer than tracking.
            assert warping_percent(peer) > 0 and seen
            unsubscribe()
            peer.spin_for(SETTLING_S)
            assert warping_percent(peer) == 0


def test_images_that_come_too_fast_are_dropped_and_counted(tmp_path):
    images, _ = turning_spheres(2, 1024)
    slow = '-p', 'estimator:=pts_epipolar', '-p', 'working_width:=1024'
    with stabilizer(tmp_path, *slow, topics=('orientation', '/diagnostics')) as peer:
        for i, ns in enumerate(stamps_of(20)):
            peer.send(images[i % 2], ns)
            peer.spin_for(0.01)
        answers = peer.received['orientation']
        # The newest one is served.
        peer.wait_until(lambda: answers and stamp_ns(answers[-1]) == ns)
        said = peer.diagnostics(lambda values: int(values['frames']) == len(answers))
    # Some may never have come.
    assert 0 < int(said['dropped']) <= 20 - len(answers)


def test_nothing_is_said_on_tf_of_images_without_a_frame(tmp_path):
    tf2_msgs = pytest.importorskip(
        'tf2_msgs.msg', reason='tf2_msgs comes with a ROS installation only')
    images, _ = turning_spheres(3, WIDTH)
    stamps_ns = stamps_of(3)
    with stabilizer(tmp_path, topics=('orientation',)) as peer:
        heard = []
        peer.subscribe(tf2_msgs.TFMessage, '/tf', heard.append)
        for ns in stamps_ns[:2]:
            peer.send(images[0], ns, frame_id='')
            peer.wait_until(lambda: len(peer.received['orientation']) and stamp_ns(
                peer.received['orientation'][-1]) == ns)
        assert peer.output().count('no transforms on /tf') == 1 and not heard
        R_world_camera = peer.stabilize(images[2], stamps_ns[2])
        peer.wait_until(lambda: heard)
    to_world, *leaves = heard[0].transforms
    q = to_world.transform.rotation
    assert (to_world.header.frame_id, to_world.child_frame_id) == ('camera', 'stabilized_optical')
    assert np.allclose((q.x, q.y, q.z, q.w), R_world_camera.inv().as_quat())
    assert {leaf.child_frame_id for leaf in leaves} == {'virtual_optical', 'view_optical'}
    assert {leaf.header.frame_id for leaf in leaves} == {'stabilized_optical'}


def test_qos_is_that_of_sensor_data_unless_parameters_say_otherwise(tmp_path):
    outputs = ('/orientation', '/virtual_orientation', '/orientation_covariance',
               '/stabilized/image', '/view/image', '/view/image/compressed', '/view/camera_info',
               '/diagnostics')
    overridden = '/stabilized/image/compressed'
    with stabilizer(
            tmp_path, '-p', f'qos_overrides.{overridden}.publisher.reliability:=best_effort',
            '-p', 'qos_overrides./view/cmd_vel.subscription.reliability:=best_effort',
            '-p', 'qos_overrides./orientation.publisher.depth:=3', compressed=True,
            reliable=False) as peer:
        assert peer.qos('/image/compressed').reliability is ReliabilityPolicy.BEST_EFFORT
        for topic in (*outputs, '/view/direction'):
            assert peer.qos(topic).reliability is ReliabilityPolicy.RELIABLE, topic
            assert peer.qos(topic).durability is DurabilityPolicy.VOLATILE, topic
        for topic in (overridden, '/view/cmd_vel'):
            assert peer.qos(topic).reliability is ReliabilityPolicy.BEST_EFFORT
        assert peer.get_parameters('qos_overrides./orientation.publisher.depth') == [3]
        assert {f'qos_overrides.{topic}.publisher.reliability' for topic in outputs} <= (
            peer.list_parameters())


def test_rviz_shows_what_the_node_publishes(tmp_path):
    manager = YAML(typ='safe').load(RVIZ)['Visualization Manager']
    topics = [f"/{one['Topic']['Value']}" for one in manager['Displays'] if 'Topic' in one]
    assert topics
    with stabilizer(tmp_path) as peer:
        for topic in topics:
            # Such a publisher suits every subscriber.
            assert peer.qos(topic).reliability is ReliabilityPolicy.RELIABLE
        assert peer.get_parameters('stabilized_frame') == [
            manager['Global Options']['Fixed Frame']]


def test_two_nodes_work_side_by_side(tmp_path):
    images, _ = turning_spheres(6, WIDTH)
    domain, first_ns = next(DOMAINS), stamps_of(1)[0]
    topics = ('orientation', 'view/image', '/diagnostics')
    with stabilizer(tmp_path, namespace='left', domain=domain, topics=topics) as left:
        with stabilizer(tmp_path, '-p', 'stabilized_frame:=right_world', namespace='right',
                        domain=domain, topics=topics) as right:
            for i, ns in enumerate(stamps_of(6)):
                left.stabilize(images[i], ns)
                if i % 2:
                    right.stabilize(images[-1 - i], ns)
            last_left, last_right = (
                peer.received['orientation'][-1] for peer in (left, right))
            assert len(left.received['orientation']) == 6
            assert len(right.received['orientation']) == 3
            assert last_left.header.frame_id == 'stabilized_optical'
            assert last_right.header.frame_id == 'right_world'
            # One sees the other's pictures backwards.
            assert angle_deg(rotation(last_left), rotation(last_right)) > 5
            assert right.set_parameters(view__yaw_deg=50.) == ['']
            assert left.get_parameters('view.yaw_deg') == [0.]
            names = {'/left/stabilizer: stabilization', '/right/stabilizer: stabilization'}
            left.wait_until(lambda: names == {name for name, _ in statuses(left)})
            assert stamp_ns(right.received['orientation'][0]) > first_ns
