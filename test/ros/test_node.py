# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The node as its users meet it: in its own process, over the middleware."""

from itertools import islice
import os
from pathlib import Path
import re
import signal
import subprocess
import sys
import time

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from sph_stab_ros.geometry.trajectory import Trajectory
from sph_stab_ros.geometry.warp import perspective_view, rotate_equirect, view_rotation
from sph_stab_ros.images.codec import image_from_message
from sph_stab_ros.recording import open_recording
from sph_stab_ros.simulation.recordings import R_CAMERA_MARKERS, TRUTH_TOPIC
from synthetic import angle_deg
from tiny_recordings import stamps_of, textured_sphere

pytest.importorskip('rclpy', reason='rclpy is not installed')
from node_harness import (  # noqa: E402, I100
    compass_sphere, DOMAINS, pixels, rotation, shown_direction, stabilizer, stamp_ns)
from sensor_msgs.msg import CompressedImage, Image  # noqa: E402

PIONEER = Path(__file__).resolve().parents[2] / 'bags' / 'pioneer'
# Where accuracy does not matter.
QUICK = ('-p', 'working_width:=192')
PICTURES = ('stabilized/image', 'stabilized/image/compressed',
            'view/image', 'view/image/compressed', 'view/camera_info')


def pioneer_frames(count):
    """Return the first Frames of the recording."""
    return list(islice(open_recording(PIONEER).frames(), count))


def pioneer_truth():
    """Return the Trajectory of R_mocap_camera."""
    stamps_ns, quaternions = [], []
    for _, msg in open_recording(PIONEER).messages(TRUTH_TOPIC):
        stamps_ns.append(msg.header.stamp.sec * 10**9 + msg.header.stamp.nanosec)
        q = msg.pose.orientation
        quaternions.append((q.x, q.y, q.z, q.w))
    return Trajectory(stamps_ns, Rotation.from_quat(quaternions) * R_CAMERA_MARKERS.inv())


def mean_difference(image, expected):
    """Return the mean absolute difference of two images in grey levels."""
    return np.mean(cv2.absdiff(image, expected))


def test_orientations_of_the_pioneer(tmp_path):
    recording = open_recording(PIONEER)
    with stabilizer(tmp_path, compressed=True) as peer:
        sent_ns = []
        for _, recorded in recording.messages(recording.image_topic):
            msg = CompressedImage(format=recorded.format)
            msg.data.frombytes(recorded.data.tobytes())
            sent_ns.append(recorded.header.stamp.sec * 10**9 + recorded.header.stamp.nanosec)
            peer.stabilize(msg, sent_ns[-1])
        answers = peer.received['orientation']

    assert [stamp_ns(msg) for msg in answers] == sent_ns
    assert {msg.header.frame_id for msg in answers} == {'stabilized_optical'}
    R_mocap_camera = pioneer_truth().at(sent_ns)
    R_world_camera = Rotation.concatenate([rotation(msg) for msg in answers])
    errors_deg = angle_deg(R_world_camera, R_mocap_camera[0].inv() * R_mocap_camera)
    assert angle_deg(R_mocap_camera[0], R_mocap_camera).max() > 80
    # Measured: 0.25 and 0.42.
    assert errors_deg.mean() < 0.6
    assert errors_deg.max() < 1.2
    assert process_ended_well(peer)


def test_pictures_show_what_the_orientation_says(tmp_path):
    frames = pioneer_frames(4)
    with stabilizer(tmp_path, *QUICK, '-p', 'view.yaw_deg:=30.0', '-p', 'view.width:=320',
                    '-p', 'view.height:=200', topics=('orientation', *PICTURES)) as peer:
        for frame in frames:
            R_world_camera = peer.stabilize(frame.image, frame.stamp_ns)
            sphere, sphere_jpeg, view, view_jpeg, info = (
                peer.received[topic][-1] for topic in PICTURES)

            expected = rotate_equirect(frame.image, R_world_camera.inv())
            assert sphere.encoding == 'bgr8'
            assert mean_difference(pixels(sphere), expected) < 0.1
            assert mean_difference(image_from_message(sphere_jpeg), expected) < 5

            R_camera_view = R_world_camera.inv() * view_rotation(np.deg2rad(30))
            expected = perspective_view(frame.image, R_camera_view, np.deg2rad(90), (320, 200))
            assert expected.std() > 10
            assert mean_difference(pixels(view), expected) < 0.1
            assert mean_difference(pixels(view_jpeg), expected) < 5
            assert (info.width, info.height) == (320, 200)

            assert {stamp_ns(peer.received[topic][-1]) for topic in PICTURES} == {frame.stamp_ns}
            assert sphere.header.frame_id == sphere_jpeg.header.frame_id == 'stabilized_optical'
            assert {msg.header.frame_id for msg in (view, view_jpeg, info)} == {'view_optical'}


def test_every_encoding_shows_the_same(tmp_path):
    sphere = textured_sphere(256)
    encodings = {'bgr8': None, 'rgb8': cv2.COLOR_BGR2RGB, 'bgra8': cv2.COLOR_BGR2BGRA,
                 'rgba8': cv2.COLOR_BGR2RGBA, 'mono8': cv2.COLOR_BGR2GRAY}
    with stabilizer(tmp_path, *QUICK, topics=('orientation', 'stabilized/image')) as peer:
        for (encoding, conversion), ns in zip(encodings.items(), stamps_of(5)):
            image = sphere if conversion is None else cv2.cvtColor(sphere, conversion)
            msg = Image(height=128, width=256, encoding=encoding, step=image[0].size)
            msg.data.frombytes(image.tobytes())
            assert peer.stabilize(msg, ns).magnitude() < np.deg2rad(0.1)
            shown = peer.received['stabilized/image'][-1]
            grey = encoding == 'mono8'
            assert shown.encoding == ('mono8' if grey else 'bgr8')
            assert mean_difference(image_from_message(shown), image if grey else sphere) < 2


def test_png_is_read_and_grey_jpeg_written_as_image_transport_does(tmp_path):
    sphere = textured_sphere(256)
    with stabilizer(tmp_path, *QUICK, compressed=True, topics=(
            'orientation', 'stabilized/image/compressed')) as peer:
        for image, jpeg_format, ns in zip(
                (sphere, cv2.cvtColor(sphere, cv2.COLOR_BGR2GRAY)),
                ('bgr8; jpeg compressed bgr8', 'mono8; jpeg compressed '), stamps_of(2)):
            msg = CompressedImage(format='png')
            msg.data.frombytes(cv2.imencode('.png', image)[1].tobytes())
            peer.stabilize(msg, ns)
            shown = peer.received['stabilized/image/compressed'][-1]
            assert shown.format == jpeg_format
            assert mean_difference(image_from_message(shown), image) < 5


def test_view_follows_whoever_spoke_last(tmp_path):
    sphere = compass_sphere()
    stamps_ns = iter(stamps_of(1000))
    forward, left, up, down = (0, 0, 1), (-1, 0, 0), (0, -1, 0), (0, 1, 0)
    with stabilizer(tmp_path, *QUICK, topics=('orientation', 'view/image')) as peer:
        def shows(direction):
            peer.stabilize(sphere, next(stamps_ns))
            shown = shown_direction(peer.received['view/image'][-1])
            return np.allclose(shown, direction, atol=0.05)

        assert shows(forward)
        assert peer.set_parameters(view__yaw_deg=90.) == ['']
        assert shows(left)
        peer.look(view_rotation(pitch_rad=np.pi / 2).as_quat(), 'stabilized_optical')
        peer.wait_until(lambda: shows(up))
        # What does not concern the direction leaves it.
        assert peer.set_parameters(view__hfov_deg=60.) == ['']
        assert shows(up)
        peer.look((0, 0, 0, 0))
        peer.wait_until(lambda: '(0, 0, 0, 0) is not a unit quaternion' in peer.output())
        assert shows(up)
        assert peer.set_parameters(view__yaw_deg=0.) == ['']
        assert shows(forward)
        peer.look(view_rotation(pitch_rad=-np.pi / 2).as_quat())
        peer.wait_until(lambda: shows(down))


def test_resets_do_not_flood_the_log(tmp_path):
    with stabilizer(tmp_path, *QUICK) as peer:
        for _ in range(50):
            assert peer.reset().success
        assert peer.output().count('reset: ') < 10


def test_reset_makes_the_next_image_the_world(tmp_path):
    frames = pioneer_frames(40)
    with stabilizer(tmp_path, *QUICK, topics=('orientation', 'stabilized/image')) as peer:
        for frame in frames[:-1:4]:
            R_world_camera = peer.stabilize(frame.image, frame.stamp_ns)
        assert R_world_camera.magnitude() > np.deg2rad(1)
        response = peer.reset()
        assert response.success and response.message
        R_world_camera = peer.stabilize(frames[-1].image, frames[-1].stamp_ns)
        assert R_world_camera.magnitude() < 1e-9
        shown = pixels(peer.received['stabilized/image'][-1])
        assert mean_difference(shown, frames[-1].image) < 1


@pytest.mark.parametrize('signal_number', (signal.SIGINT, signal.SIGTERM))
def test_signals_end_it_with_frames_in_flight(tmp_path, signal_number):
    image = pioneer_frames(1)[0].image
    with stabilizer(tmp_path, topics=('orientation', 'stabilized/image')) as peer:
        for sent_ns in stamps_of(10):
            peer.send(image, sent_ns)
        peer.wait_until(lambda: peer.received['orientation'])
        for sent_ns in stamps_of(20)[10:]:
            peer.send(image, sent_ns)
        peer.process.send_signal(signal_number)
        peer.process.wait(30)
    assert process_ended_well(peer)


def test_ctrl_c_while_it_is_imported_ends_it_without_a_word():
    process = subprocess.Popen(
        [sys.executable, '-X', 'importtime', '-m', 'sph_stab_ros.stabilizer'], text=True,
        env={**os.environ, 'ROS_DOMAIN_ID': str(next(DOMAINS))}, stderr=subprocess.PIPE)
    # It says what it has imported.
    while 'numpy' not in process.stderr.readline():
        pass
    process.send_signal(signal.SIGINT)
    said = process.communicate(timeout=60)[1]
    assert process.returncode == 0
    # The interpreter's own lines; one that is interrupted goes on in the next.
    assert not [line for line in said.splitlines()
                if not re.fullmatch(r'import time:.*|\s*[\w.]+', line)]


def test_pressing_ctrl_c_again_and_again_ends_it_as_well(tmp_path):
    """As ros2 launch does after the terminal did, while the worker has a frame to finish."""
    image = textured_sphere(1024)
    slow = '-p', 'estimator:=pts_epipolar', '-p', 'working_width:=1024'
    with stabilizer(tmp_path, *slow) as peer:
        for sent_ns in stamps_of(3):
            peer.send(image, sent_ns)
            peer.spin_for(0.05)
        presses = 0
        while peer.process.poll() is None:
            peer.process.send_signal(signal.SIGINT)
            presses += 1
            time.sleep(0.005)
    assert presses > 2
    assert process_ended_well(peer)


def process_ended_well(peer):
    """Tell whether the node is gone with status 0 and without complaints."""
    return peer.process.returncode == 0 and 'Traceback' not in peer.output()


def bad_raw_images(image):
    """Return reason -> Image message that is not a whole sphere."""
    height, width = image.shape[:2]

    def message(data=None, **fields):
        msg = Image(height=height, width=width, encoding='bgr8', step=3 * width)
        for name, value in fields.items():
            setattr(msg, name, value)
        msg.data.frombytes(image.tobytes() if data is None else data)
        return msg

    return {
        'not 2:1': message(height=height - 1, data=image[1:].tobytes()),
        'wrong step': message(step=2 * width),
        'truncated data': message(data=image[1:].tobytes()),
        'unknown encoding': message(encoding='smell8'),
        'zero size': message(height=0, width=0, step=0, data=b''),
        'unusable size': message(height=32, width=64, step=192, data=image[:32, :64].tobytes()),
    }


def test_bad_raw_images_are_counted_and_the_next_good_one_is_used(tmp_path):
    frames = pioneer_frames(7)
    bad = bad_raw_images(frames[0].image)
    with stabilizer(tmp_path, *QUICK, topics=('orientation', '/diagnostics')) as peer:
        for frame, (reason, msg) in zip(frames, bad.items()):
            peer.stabilize(frame.image, frame.stamp_ns)
            peer.send(msg, frame.stamp_ns + 1)
            # A good image could take its place before it is looked at.
            peer.wait_until(lambda: f'image refused, {reason}' in peer.output()
                            or 'image refused, the image is 64 px wide' in peer.output())
        peer.stabilize(frames[-1].image, frames[-1].stamp_ns)
        counted = peer.diagnostics(lambda values: values['refused'] == str(len(bad)))
        assert {f'refused: {reason}': '1' for reason in bad}.items() <= counted.items()
        assert counted['frames'] == counted['frames: ok'] == str(len(frames))


def test_bad_compressed_images_are_counted_and_the_next_good_one_is_used(tmp_path):
    frames = pioneer_frames(5)
    jpeg = cv2.imencode('.jpg', frames[0].image)[1].tobytes()
    png = cv2.imencode('.png', frames[0].image)[1].tobytes()
    bad = {'truncated JPEG': jpeg[:len(jpeg) // 2],
           'corrupt PNG': png[:60] + bytes(100) + png[160:],
           'not JPEG or PNG': b'GIF89a', 'not 2:1': cv2.imencode(
               '.png', frames[0].image[1:])[1].tobytes()}
    with stabilizer(tmp_path, *QUICK, compressed=True,
                    topics=('orientation', '/diagnostics')) as peer:
        for frame, (reason, data) in zip(frames, bad.items()):
            peer.stabilize(frame.image, frame.stamp_ns)
            msg = CompressedImage(format='jpeg')
            msg.data.frombytes(data)
            peer.send(msg, frame.stamp_ns + 1)
            peer.wait_until(lambda: f'image refused, {reason}' in peer.output())
        peer.stabilize(frames[-1].image, frames[-1].stamp_ns)
        counted = peer.diagnostics(lambda values: values['refused'] == str(len(bad)))
        assert {f'refused: {reason}': '1' for reason in bad}.items() <= counted.items()


def test_unexpected_errors_cost_one_image(tmp_path):
    mask = tmp_path / 'mask.png'
    cv2.imwrite(str(mask), np.full((64, 128), 255, np.uint8))
    large = textured_sphere(512)
    small = cv2.resize(large, (256, 128), interpolation=cv2.INTER_AREA)
    first_ns, second_ns, third_ns = stamps_of(3)
    with stabilizer(tmp_path, *QUICK, '-p', f'mask:={mask}',
                    topics=('orientation', '/diagnostics')) as peer:
        peer.stabilize(small, first_ns)
        mask.unlink()
        # Another size needs the mask anew.
        peer.send(large, second_ns)
        peer.diagnostics(lambda values: values.get('refused: MaskError') == '1')
        assert peer.set_parameters(mask='') == ['']
        peer.stabilize(large, third_ns)
        counted = peer.diagnostics(lambda values: values['frames'] == '2')
        assert counted['tracking'] == 'ok'


def test_strange_streams_are_noticed(tmp_path):
    first_ns, second_ns, third_ns = stamps_of(3)
    large = textured_sphere(512)
    small = cv2.resize(large, (256, 128), interpolation=cv2.INTER_AREA)
    with stabilizer(tmp_path, *QUICK, topics=('orientation', '/diagnostics')) as peer:
        peer.stabilize(small, second_ns)
        peer.stabilize(small, first_ns)
        peer.stabilize(large, third_ns)
        # A pause is one to the stamps and to who receives them.
        time.sleep(0.8)
        peer.stabilize(large, third_ns + 3 * 10**9 // 2)
        black = np.zeros_like(large)
        peer.stabilize(black, third_ns + 3 * 10**9 // 2 + 10**7)
        counted = peer.diagnostics(lambda values: values['frames'] == '5')
    assert counted['frames: ok'] == '4'
    assert [counted.get(f'notice: {name}') for name in (
        'stamp_not_increasing', 'resized', 'gap')] == ['1', '1', '1']
    assert 'image size changed' in peer.output()
    assert 'no rotation found' in peer.output()


def test_zero_stamps_become_times_of_receipt(tmp_path):
    frames = pioneer_frames(3)
    with stabilizer(tmp_path, *QUICK, topics=('orientation', 'view/camera_info')) as peer:
        for frame in frames:
            peer.stabilize(frame.image, 0)
        stamps_ns = [stamp_ns(msg) for msg in peer.received['orientation']]
        assert 0 < stamps_ns[0] < stamps_ns[1] < stamps_ns[2]
        assert stamps_ns == [stamp_ns(msg) for msg in peer.received['view/camera_info']]
        assert peer.output().count('image stamps are zero') == 1


def test_diagnostics_go_on_without_images(tmp_path):
    with stabilizer(tmp_path, *QUICK, topics=('/diagnostics',)) as peer:
        for _ in range(2):
            values = peer.diagnostics(lambda values: True)
            assert values['message'].startswith('no images')
            assert values['tracking'] == 'waiting'
