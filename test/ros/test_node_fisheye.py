# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The node with a camera that shows two fisheye circles, over the real middleware."""

from pathlib import Path

from dual_fisheye_frames import fisheye_picture
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from sph_stab_ros.config import FisheyeConfig
from synthetic import angle_deg, textured_sphere
from tiny_recordings import stamps_of

pytest.importorskip('rclpy', reason='rclpy is not installed')
from node_harness import pixels, stabilizer  # noqa: E402, I100
from rclpy.time import Time  # noqa: E402
from sensor_msgs.msg import CompressedImage  # noqa: E402
from sph_stab_ros.images.codec import fill_compressed  # noqa: E402, I100

THETA_S = ('--params-file', str(Path(__file__).resolve().parents[2] / 'config' / 'theta_s.yaml'))
TOPICS = ('orientation', 'stabilized/image/compressed', 'view/image/compressed', '/diagnostics')


@pytest.fixture(scope='module')
def world():
    """Return a sphere in colour."""
    return np.repeat(textured_sphere(2048)[..., None], 3, axis=-1)


def test_a_theta_s_is_stabilised(tmp_path, world):
    turns = [Rotation.from_euler('YX', (3 * i, i), degrees=True) for i in range(4)]
    pictures = [fisheye_picture(world, FisheyeConfig(), R) for R in turns]
    with stabilizer(tmp_path, *THETA_S, topics=TOPICS, compressed=True) as peer:
        for image, R, stamp_ns in zip(pictures, turns, stamps_of(4)):
            assert angle_deg(peer.stabilize(image, stamp_ns), R) < 0.2
        first, *_, last = (pixels(msg).astype(float) for msg in peer.received[TOPICS[1]])
        assert first.shape == (570, 1140, 3)
        assert np.abs(last - first).mean() < 8 < first.std() / 4
        assert pixels(peer.received[TOPICS[2]][-1]).shape == (240, 320, 3)


def test_two_lenses_on_two_topics_are_stabilised(tmp_path, world):
    """Paired by their stamps; one whose partner is lost is not used."""
    turns = [Rotation.from_euler('YX', (3 * i, i), degrees=True) for i in range(4)]
    with stabilizer(tmp_path, *THETA_S, '-p', 'join:=left_right', compressed=True,
                    topics=('orientation', '/diagnostics')) as peer:
        rear = peer.advertise(CompressedImage, 'image_rear/compressed')
        peer.wait_until(rear.get_subscription_count)
        late_ns = 3_000_000
        for number, (R, stamp_ns) in enumerate(zip(turns, stamps_of(4))):
            first, second = np.split(fisheye_picture(world, FisheyeConfig(), R), 2, axis=1)
            if number != 2:
                msg = fill_compressed(CompressedImage(), second, 95)
                msg.header.stamp = Time(nanoseconds=int(stamp_ns) + late_ns).to_msg()
                rear.publish(msg)
            if number == 2:
                peer.send(first, stamp_ns)
            else:
                assert angle_deg(peer.stabilize(first, stamp_ns), R) < 0.2
        assert len(peer.received['orientation']) == 3
        peer.diagnostics(lambda values: values.get('one_lens_only') == '1')


def test_the_projection_is_a_parameter_like_others(tmp_path, world):
    """What does not fit is refused by name and counted; what does goes on."""
    circles = fisheye_picture(world, FisheyeConfig())
    first_ns, second_ns, third_ns, fourth_ns, fifth_ns = stamps_of(5)
    with stabilizer(tmp_path, topics=('orientation', '/diagnostics'), compressed=True) as peer:
        peer.send(circles, first_ns)
        peer.wait_until(lambda: 'image refused, not 2:1' in peer.output())
        assert peer.set_parameters(projection='dual_fisheye') == ['']
        peer.stabilize(circles, second_ns)
        peer.send(world[::2, ::2], third_ns)
        peer.wait_until(lambda: 'image refused, not as calibrated' in peer.output())
        assert peer.set_parameters(fisheye__rear__roll_deg=-90.5) == ['']
        peer.stabilize(circles, fourth_ns)
        refused, = peer.set_parameters(fisheye__fov_deg=100.)
        assert refused
        refused, = peer.set_parameters(projection='flat')
        assert 'equirect, dual_fisheye' in refused
        peer.stabilize(circles, fifth_ns)
        counted = peer.diagnostics(lambda values: values['refused'] == '2')
        assert counted['refused: not 2:1'] == counted['refused: not as calibrated'] == '1'
