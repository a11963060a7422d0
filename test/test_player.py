# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The player in a process of its own, heard through the middleware."""

from contextlib import contextmanager
from importlib.util import find_spec
import os
import signal
import subprocess
import sys
import time

import numpy as np
from projection_pictures import picture_of, projection_named
import pytest
from rosbags.typesys import get_typestore, Stores
from scipy.spatial.transform import Rotation
from sph_stab_ros.images.codec import image_from_message
from sph_stab_ros.recording import open_recording, RecordingError
from sph_stab_ros.recording.bag_writer import BagWriter
from tiny_recordings import (
    IMAGE_TOPIC, PERIOD_NS, stamps_of, START_NS, textured_sphere, write_bag)
from video_bags import COMPRESSED_IMAGE, FFMPEG_PACKET, write_video_bag

pytest.importorskip('rclpy', reason='rclpy is not installed')
from geometry_msgs.msg import QuaternionStamped  # noqa: E402, I100
from node_harness import DOMAINS, leave, stamp_ns, TIMEOUT_S  # noqa: E402
import rclpy  # noqa: E402, I100
from rclpy.context import Context  # noqa: E402, I100
from rclpy.executors import SingleThreadedExecutor  # noqa: E402, I100
from rclpy.serialization import serialize_message  # noqa: E402, I100
from sensor_msgs.msg import CompressedImage, Image  # noqa: E402, I100
from sph_stab_ros.player import message_type  # noqa: E402
from sph_stab_ros.ros.messages import copy_fields  # noqa: E402

pytestmark = pytest.mark.ros
IMAGE = textured_sphere()


class Listener:
    """Plays a recording to subscribers; ``received`` holds the messages by topic."""

    def __init__(self, process, domain, topics):
        self.process = process
        self.received = {topic: [] for topic in topics}
        self._context = Context()
        rclpy.init(context=self._context, domain_id=domain)
        self._node = rclpy.create_node('listener', context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        # The images last: the player waits for their subscriber only.
        for topic, kind in reversed(topics.items()):
            self._node.create_subscription(kind, topic, self.received[topic].append, 100)

    def close(self):
        """Leave the middleware."""
        leave(self._node, self._executor)

    def wait_until(self, condition):
        """Listen until a condition holds."""
        end_s = time.monotonic() + TIMEOUT_S
        while not condition():
            assert time.monotonic() < end_s, 'waited in vain'
            self._executor.spin_once(timeout_sec=0.02)

    def listen_to_the_end(self):
        """Listen until the player has ended; check that it ended well."""
        self.wait_until(lambda: self.process.poll() is not None)
        assert self.ending() == (0, '')

    def ending(self):
        """Return the player's exit status and what it said on stderr."""
        _, error = self.process.communicate(timeout=TIMEOUT_S)
        return self.process.returncode, error


def start(*args, domain=None):
    """Start the player as a process."""
    return subprocess.Popen(
        [sys.executable, '-m', 'sph_stab_ros.player', *map(str, args)], text=True,
        env={**os.environ, 'ROS_DOMAIN_ID': str(domain or next(DOMAINS))},
        stdout=subprocess.PIPE, stderr=subprocess.PIPE)


@contextmanager
def playing(*args, topics):
    """Play a recording and give the Listener; leave nothing running."""
    domain = next(DOMAINS)
    process = start('--wait', *args, domain=domain)
    listener = Listener(process, domain, topics)
    try:
        yield listener
    finally:
        listener.close()
        if process.poll() is None:
            process.kill()
            process.communicate()


def stamps(messages):
    """Return the header stamps in ns."""
    return [stamp_ns(msg) for msg in messages]


def test_compressed_images_go_out_as_they_were_recorded(turning_bag):
    """Every one, untouched, not faster than asked for."""
    start_s = time.monotonic()
    with playing(turning_bag, '--rate', 0.5,
                 topics={'image/compressed': CompressedImage}) as heard:
        heard.listen_to_the_end()
        messages = heard.received['image/compressed']
    assert time.monotonic() - start_s > 11 * PERIOD_NS / 1e9 / 0.5
    assert stamps(messages) == stamps_of(12).tolist()
    recorded = [msg for _, msg in open_recording(turning_bag).messages(IMAGE_TOPIC)]
    assert [bytes(msg.data) for msg in messages] == [bytes(msg.data) for msg in recorded]
    assert {(msg.format, msg.header.frame_id) for msg in messages} == {
        ('bgr8; jpeg compressed bgr8', 'theta_camera')}


@pytest.mark.slow
def test_a_cube_by_its_metadata_goes_out_as_spheres(tmp_path):
    """The same as replay reads, as no message can say what they are."""
    videos = pytest.importorskip('tiny_videos')
    picture = videos.bgr_frame(picture_of(projection_named('cube 3x2'), textured_sphere(1024)))
    path = videos.encode(tmp_path / 'cube.mp4', [picture] * 3, options={'crf': '10'})
    videos.tagged(path, videos.cube_box())
    with playing(path, topics={'image': Image}) as heard:
        heard.listen_to_the_end()
        images = [image_from_message(msg) for msg in heard.received['image']]
    assert len(images) == 3
    for image in images:
        assert np.abs(image.astype(int) - textured_sphere(1024)).mean() < 12
    with playing(path, '-p', 'projection:=cubemap', topics={'image': Image}) as heard:
        heard.listen_to_the_end()
        assert {(msg.width, msg.height) for msg in heard.received['image']} == {(768, 512)}
    videos.encode(path, [picture])
    videos.tagged(path, videos.sphere_box(projection=b'mshp'))
    assert 'a mesh, which is not read' in start(path).communicate(timeout=TIMEOUT_S)[1]


@pytest.fixture(scope='module')
def bag_with_truth(tmp_path_factory):
    """Return a bag of raw images, and orientations between them."""
    path = tmp_path_factory.mktemp('truth') / 'bag'
    with BagWriter(path) as bag:
        for index in range(5):
            stamp = START_NS + index * PERIOD_NS
            bag.write('/camera', bag.type('sensor_msgs/msg/Image')(
                header=bag.header(stamp, 'lens'), height=IMAGE.shape[0], width=IMAGE.shape[1],
                encoding='bgr8', is_bigendian=0, step=3 * IMAGE.shape[1], data=IMAGE.ravel()),
                stamp)
            bag.write_orientation('/truth', stamp + PERIOD_NS // 2, 'mocap',
                                  Rotation.from_rotvec((0, 0, 0.1 * index)))
    return path


def test_images_and_truth_go_out(bag_with_truth):
    """Raw images without loss, and the other topic under its own name, each in its order."""
    with playing(bag_with_truth, '--topics', '/truth',
                 topics={'image': Image, '/truth': QuaternionStamped}) as heard:
        heard.listen_to_the_end()
    assert stamps(heard.received['image']) == stamps_of(5).tolist()
    assert all(np.array_equal(image_from_message(m), IMAGE) for m in heard.received['image'])
    truth = heard.received['/truth']
    assert stamps(truth) == (stamps_of(5) + PERIOD_NS // 2).tolist()
    assert {msg.header.frame_id for msg in truth} == {'mocap'}
    assert np.allclose([msg.quaternion.z for msg in truth], np.sin(0.05 * np.arange(5)))


@pytest.mark.slow
def test_raw_images_are_compressed_on_demand_and_remapped(bag_with_truth):
    """--compressed, and ROS's own way to name topics."""
    with playing(bag_with_truth, '--compressed', '--ros-args', '-r', 'image/compressed:=/theta',
                 topics={'/theta': CompressedImage}) as heard:
        heard.listen_to_the_end()
    images = [image_from_message(msg) for msg in heard.received['/theta']]
    assert stamps(heard.received['/theta']) == stamps_of(5).tolist()
    assert max(np.abs(image.astype(int) - IMAGE).mean() for image in images) < 8


@pytest.mark.parametrize('ending', [
    signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.slow)])
def test_a_loop_goes_on_in_time_until_it_is_ended(turning_bag, ending):
    """Stamps increase from loop to loop; both signals are a good end."""
    with playing(turning_bag, '--loop', '--rate', 4,
                 topics={'image/compressed': CompressedImage}) as heard:
        messages = heard.received['image/compressed']
        heard.wait_until(lambda: len(messages) >= 30)
        os.kill(heard.process.pid, ending)
        # A terminal and ros2 launch both send it; whoever is impatient goes on.
        while ending is signal.SIGINT and heard.process.poll() is None:
            os.kill(heard.process.pid, ending)
            time.sleep(0.005)
        assert heard.ending() == (0, '')
    assert np.all(np.diff(stamps(messages)) > 0)
    assert stamps(messages)[:12] == stamps_of(12).tolist()
    assert bytes(messages[12].data) == bytes(messages[0].data)


@pytest.mark.slow
def test_images_are_compressed_as_the_parameters_of_the_node_say(bag_with_truth, tmp_path):
    """Or by the shorthand, of the quality that they say."""
    (tmp_path / 'robot.yaml').write_text(
        'stabilizer: {ros__parameters: {image_transport: compressed, jpeg_quality: 5}}')
    sizes = []
    for words in (['--compressed'], ['--params-file', tmp_path / 'robot.yaml']):
        with playing(bag_with_truth, '--rate', 5, *words,
                     topics={'image/compressed': CompressedImage}) as heard:
            heard.listen_to_the_end()
        messages = heard.received['image/compressed']
        assert len(messages) == 5
        sizes.append(len(messages[0].data))
    assert sizes[1] < sizes[0] / 3


@pytest.mark.slow
def test_now_keeps_the_intervals_and_moves_them_to_the_present(turning_bag):
    """At another rate the intervals are scaled as the playing is."""
    before_ns = time.time_ns()
    with playing(turning_bag, '--now', '--rate', 2,
                 topics={'image/compressed': CompressedImage}) as heard:
        heard.listen_to_the_end()
    new_ns = np.array(stamps(heard.received['image/compressed']))
    assert before_ns < new_ns[0] < time.time_ns()
    assert np.abs(np.diff(new_ns) - PERIOD_NS / 2).max() <= 1


def test_a_video_is_played_with_the_present_time(turning_video, turning):
    """A video has no clock of its own."""
    before_ns = time.time_ns()
    with playing(turning_video, topics={'image': Image}) as heard:
        heard.listen_to_the_end()
    messages = heard.received['image']
    assert len(messages) == len(turning[0])
    assert {msg.header.frame_id for msg in messages} == {'camera'}
    new_ns = np.array(stamps(messages))
    assert before_ns < new_ns[0] and np.abs(np.diff(new_ns) - PERIOD_NS).max() < 2e4


@pytest.mark.slow
def test_two_tracks_are_played_as_one_picture(tmp_path):
    videos = pytest.importorskip('tiny_videos')
    images = [np.repeat(np.random.default_rng(track).integers(0, 256, (48, 64, 1), np.uint8), 3, 2)
              for track in range(2)]
    tracks = [[videos.bgr_frame(image) for _ in range(4)] for image in images]
    path = videos.encode_tracks(tmp_path / 'a.mp4', tracks)
    with playing(path, '--join', 'top_bottom', topics={'image': Image}) as heard:
        heard.listen_to_the_end()
    assert len(heard.received['image']) == 4
    for msg in heard.received['image']:
        off = np.abs(image_from_message(msg).astype(int) - np.vstack(images))
        assert off.max() <= 3


@pytest.mark.parametrize('args, status, message', [
    ((), 2, 'REC'),
    (('{bag}', '-p', 'jpeg_quality:=0'), 2, 'jpeg_quality must lie within 1 and 100'),
    (('{bag}.missing',), 1, 'does not exist'),
    (('{bag}', '--topics', '/nowhere'), 1, 'no topic /nowhere'),
    *(pytest.param(*one, marks=pytest.mark.slow) for one in (
        (('{bag}', '--rate', '0'), 2, '--rate'),
        (('{bag}', '--ros-args', '-r', 'nonsense'), 2, 'nonsense'),
        (('{bag}', '--image-topic', '/nowhere'), 1, IMAGE_TOPIC))),
])
def test_wrong_calls_and_failures_end_with_one_line(turning_bag, args, status, message):
    """Exit status 2 or 1."""
    process = start(*(arg.format(bag=turning_bag) for arg in args))
    _, error = process.communicate(timeout=TIMEOUT_S)
    assert (process.returncode, len(error.splitlines())) == (status, 1), error
    assert message in error


@pytest.mark.parametrize('name', [
    'geometry_msgs/msg/PoseStamped', 'geometry_msgs/msg/TransformStamped',
    'nav_msgs/msg/Odometry', 'sensor_msgs/msg/Imu', 'sensor_msgs/msg/CameraInfo'])
def test_messages_are_copied_field_by_field(name):
    """What the middleware would send is what a bag would hold."""
    types = get_typestore(Stores.ROS2_JAZZY)
    empty = message_type(name)()
    recorded = types.deserialize_cdr(bytes(serialize_message(empty)), name)
    recorded.header.frame_id, recorded.header.stamp.nanosec = 'mocap', 7
    for field in ('orientation_covariance', 'k'):
        if hasattr(recorded, field):
            setattr(recorded, field, np.arange(9.))
    copied = types.deserialize_cdr(bytes(serialize_message(copy_fields(recorded, empty))), name)
    assert types.serialize_cdr(copied, name) == types.serialize_cdr(recorded, name)


def test_a_message_type_that_is_not_installed_is_named(tmp_path):
    """Some robots have fewer packages than the recorder."""
    with pytest.raises(RecordingError, match='nowhere_msgs/msg/Image is not installed'):
        message_type('nowhere_msgs/msg/Image')


@pytest.mark.slow
def test_a_recording_whose_clock_was_set_plays_on(tmp_path):
    """After a second, with a line; stamps stay, or are the present ones at their pace."""
    decades_ns = 53 * 365 * 86400 * 10**9
    stamps_ns = stamps_of(6) - START_NS + 10**9
    stamps_ns[3:] += decades_ns
    write_bag(tmp_path / 'bag', 6 * [IMAGE], stamps_ns)
    for words in [], ['--now']:
        with playing(tmp_path / 'bag', *words,
                     topics={'image/compressed': CompressedImage}) as heard:
            heard.wait_until(lambda: heard.process.poll() is not None)
            status, error = heard.ending()
        heard_ns = stamps(heard.received['image/compressed'])
        assert status == 0 and len(error.splitlines()) == 1
        assert 'step by' in error and '(53.0 years)' in error
        if words:
            assert np.diff(heard_ns).min() > 0 and heard_ns[-1] - heard_ns[0] < 2 * 10**9
        else:
            assert heard_ns == stamps_ns.tolist()


@pytest.mark.slow
def test_video_of_a_package_that_is_not_installed_goes_out_decoded(tmp_path):
    """As raw images, or as JPEG if that is asked for; CompressedImages as they were recorded."""
    video = pytest.importorskip('encoded_video')
    if find_spec('ffmpeg_image_transport_msgs'):
        pytest.skip('it is installed')
    packets = video.stream('h264')
    for number, (msgtype, words, topic, expected) in enumerate((
            (FFMPEG_PACKET, [], 'image', Image),
            (FFMPEG_PACKET, ['--compressed'], 'image/compressed', CompressedImage),
            (COMPRESSED_IMAGE, ['--compressed'], 'image/compressed', CompressedImage))):
        path = write_video_bag(tmp_path / str(number), packets, msgtype, 'h264')
        with playing(path, '--rate', 2, *words, topics={topic: expected}) as heard:
            heard.listen_to_the_end()
        messages = heard.received[topic]
        assert stamps(messages) == stamps_of(len(packets)).tolist()
        if msgtype == COMPRESSED_IMAGE:
            assert [bytes(msg.data) for msg in messages] == [data for _, data in packets]
        else:
            shown = [image_from_message(msg) for msg in messages]
            assert max(np.abs(one.astype(int) - video.pictures('h264')[index]).mean()
                       for index, one in enumerate(shown)) < (1e-9 if expected is Image else 8)
