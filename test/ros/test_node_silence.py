# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The real node without images: it says what the middleware knows of who publishes what."""

import pytest
from tiny_recordings import stamps_of, textured_sphere

pytest.importorskip('rclpy', reason='rclpy is not installed')
from node_harness import stabilizer  # noqa: E402, I100
from rclpy.qos import qos_profile_sensor_data  # noqa: E402
from sensor_msgs.msg import CompressedImage, Image, Imu  # noqa: E402

QUICK = ('-p', 'working_width:=192')
RAW_ON_COMPRESSED = (
    'image_transport is compressed, which is sensor_msgs/msg/CompressedImage')


@pytest.mark.parametrize('compressed, topic, msg_type, reason', (
    (False, '/image/compressed', CompressedImage,
     '/image/compressed has a publisher; image_transport is raw'),
    (True, '/image', Image, '/image has a publisher; image_transport is compressed'),
    (True, '/image/compressed', Image,
     f'/image/compressed has a publisher of sensor_msgs/msg/Image; {RAW_ON_COMPRESSED}'),
    (False, '/theta/image_raw', Image, 'nobody publishes /image; images are on /theta/image_raw'),
    (False, '/imu', Imu, 'nobody publishes /image'),
))
def test_who_connected_what_is_not_read_is_told_so(
        tmp_path, compressed, topic, msg_type, reason):
    with stabilizer(tmp_path, *QUICK, topics=('/diagnostics',), compressed=compressed,
                    camera=False) as peer:
        publisher = peer.advertise(msg_type, topic)
        for _ in range(5):
            publisher.publish(msg_type())
        peer.diagnostics(lambda values: values['message'] == f'no images: {reason}')
        peer.diagnostics(lambda values: True)
        assert peer.output().count(f': no images: {reason}\n') == 1


def test_a_camera_that_offers_less_than_is_asked_for_is_told_of(tmp_path):
    """The tests' node asks for reliable images."""
    with stabilizer(tmp_path, *QUICK, topics=('/diagnostics',), camera=False) as peer:
        peer.advertise(Image, '/image', qos_profile_sensor_data)
        peer.diagnostics(
            lambda values: 'best effort publisher and reliable sub' in values['message'])


def test_a_camera_that_stops_is_told_of_once(tmp_path):
    with stabilizer(tmp_path, *QUICK, topics=('orientation', '/diagnostics')) as peer:
        silent = 'no images: /image has a publisher, but nothing comes'
        for ns in stamps_of(2):
            peer.diagnostics(lambda values: values['message'] == silent)
            peer.stabilize(textured_sphere(256), ns)
            peer.diagnostics(lambda values: values['message'] == 'ok')
        assert peer.output().count(silent) == 2
