# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Bags: every kind is read, whole or broken; results are written whole or not at all."""

import errno
import shutil
import tracemalloc

import numpy as np
import pytest
from rosbags.rosbag1 import Writer as Rosbag1Writer
from rosbags.rosbag2 import StoragePlugin, Writer as Rosbag2Writer
from rosbags.rosbag2.enums import CompressionFormat, CompressionMode
from rosbags.typesys import get_typestore, Stores
from scipy.spatial.transform import Rotation
from sph_stab_ros.images.codec import encode_jpeg
from sph_stab_ros.recording import decoded_frames, open_recording, RecordingError
from sph_stab_ros.recording.bag_writer import BagWriter
from sph_stab_ros.recording.messages import camera_info, compressed_image
from sph_stab_ros.stabilization.pipeline import Stabilizer
from sph_stab_ros.stabilization.recording_loop import stabilize_recording
from tiny_recordings import IMAGE_TOPIC, stamps_of, START_NS, textured_sphere, write_bag

IMAGE = textured_sphere()
COUNT = 40
# What a truncated block of a compressed chunk may cost: 128 KiB.
FRAMES_PER_BLOCK = 15


def write_kind(kind, path, images):
    """Write a recording of some kind, with times of receipt a second after the stamps."""
    if kind == 'ros1':
        types, storage = get_typestore(Stores.ROS1_NOETIC), None
        path = path.with_suffix('.bag')
        writer = Rosbag1Writer(path)
    else:
        types = get_typestore(Stores.ROS2_JAZZY)
        storage = StoragePlugin.SQLITE3 if 'sqlite' in kind else StoragePlugin.MCAP
        writer = Rosbag2Writer(path, version=9, storage_plugin=storage)
        if 'zstd' in kind:
            writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
    sequence = {'seq': 0} if kind == 'ros1' else {}
    name = 'sensor_msgs/msg/CompressedImage'
    with writer:
        connection = writer.add_connection(IMAGE_TOPIC, name, typestore=types)
        for stamp_ns, image in zip(stamps_of(len(images)).tolist(), images):
            stamp = types.types['builtin_interfaces/msg/Time'](*divmod(stamp_ns, 10**9))
            msg = types.types[name](
                header=types.types['std_msgs/msg/Header'](
                    **sequence, stamp=stamp, frame_id='theta_camera'),
                format='jpeg', data=encode_jpeg(image))
            serialize = types.serialize_ros1 if kind == 'ros1' else types.serialize_cdr
            writer.write(connection, stamp_ns + 10**9, serialize(msg, name))
    return path


def storage_file(path):
    """Return the file in a rosbag2 folder that holds the messages."""
    if path.is_file():
        return path
    file, = (file for file in path.iterdir() if file.suffix in ('.mcap', '.db3'))
    return file


def cut(path, fraction):
    """Leave only the first part of a file."""
    data = path.read_bytes()
    path.write_bytes(data[:int(len(data) * fraction)])


KINDS = ['mcap', 'mcap_zstd', 'sqlite', 'ros1']


@pytest.fixture(scope='module', params=KINDS)
def kind_of_bag(request, tmp_path_factory):
    """Return one recording of each kind, not to be changed."""
    return write_kind(
        request.param, tmp_path_factory.mktemp(request.param) / 'bag',
        [textured_sphere(seed=seed) for seed in range(COUNT)])


@pytest.mark.parametrize('bare', [False, True], ids=['folder', 'file'])
def test_every_kind_of_bag_is_read(kind_of_bag, bare):
    """Folder or bare file, either generation: all frames, header stamps to the nanosecond."""
    recording = open_recording(storage_file(kind_of_bag) if bare else kind_of_bag)
    frames = list(recording.frames())
    assert [frame.stamp_ns for frame in frames] == stamps_of(COUNT).tolist()
    assert {frame.frame_id for frame in frames} == {'theta_camera'}
    assert all(frame.image.shape == IMAGE.shape for frame in frames)
    assert recording.frame_count == COUNT
    assert recording.topics == {IMAGE_TOPIC: 'sensor_msgs/msg/CompressedImage'}
    assert not recording.skipped


def test_messages_come_with_the_time_of_receipt(kind_of_bag):
    """Truth is read like this."""
    received_ns = [ns for ns, _ in open_recording(kind_of_bag).messages(IMAGE_TOPIC)]
    assert received_ns == (stamps_of(COUNT) + 10**9).tolist()


def test_two_readings_do_not_disturb_each_other(kind_of_bag):
    """Images and truth are read side by side."""
    recording = open_recording(kind_of_bag)
    stamps = [(frame.stamp_ns, ns) for frame, (ns, _) in
              zip(recording.frames(), recording.messages(IMAGE_TOPIC))]
    assert stamps == [(ns, ns + 10**9) for ns in stamps_of(COUNT).tolist()]


@pytest.mark.parametrize('fraction', [0.5, 0.8, 0.999])
def test_of_a_truncated_bag_the_readable_part_is_read(
        kind_of_bag, fraction, tmp_path, caplog):
    """Frames up to the cut, in order, then one warning; nothing of a frame that is cut."""
    copy = tmp_path / kind_of_bag.name
    (shutil.copytree if kind_of_bag.is_dir() else shutil.copy)(kind_of_bag, copy)
    cut(storage_file(copy), fraction)
    stamps_ns = [frame.stamp_ns for frame in open_recording(copy).frames()]
    assert stamps_ns == stamps_of(COUNT)[:len(stamps_ns)].tolist()
    assert len(stamps_ns) >= COUNT * fraction - FRAMES_PER_BLOCK
    warnings = [record.getMessage() for record in caplog.records]
    if len(stamps_ns) < COUNT:
        assert len(warnings) == 1 and 'truncated' in warnings[0]
        assert f'{len(stamps_ns)} messages' in warnings[0]
    else:
        assert fraction == 0.999


def test_a_folder_without_metadata_is_read(tmp_path):
    """A recorder that dies leaves no metadata.yaml."""
    path = write_bag(tmp_path / 'bag', 3 * [IMAGE])
    (path / 'metadata.yaml').unlink()
    assert len(list(open_recording(path).frames())) == 3


def raw_image(bag, stamp_ns, **changes):
    """Return an Image message of IMAGE, with some fields changed."""
    fields = {'height': IMAGE.shape[0], 'width': IMAGE.shape[1], 'encoding': 'bgr8',
              'is_bigendian': 0, 'step': IMAGE.shape[1] * 3, 'data': IMAGE.ravel()}
    return bag.type('sensor_msgs/msg/Image')(
        header=bag.header(stamp_ns, 'camera'), **{**fields, **changes})


def test_raw_images_are_read_exactly(tmp_path):
    """sensor_msgs/Image, also with padded rows."""
    padded = np.pad(IMAGE.reshape(len(IMAGE), -1), ((0, 0), (0, 7)))
    with BagWriter(tmp_path / 'bag') as bag:
        bag.write('/image', raw_image(bag, 1), 1)
        bag.write('/image', raw_image(bag, 2, step=padded.shape[1], data=padded.ravel()), 2)
    frames = list(open_recording(tmp_path / 'bag').frames())
    assert len(frames) == 2
    assert all(np.array_equal(frame.image, IMAGE) for frame in frames)


def test_faulty_pictures_are_left_out_counted_and_named_once(tmp_path, caplog):
    """Good frames before and after a fault are still given."""
    faults = [{'encoding': 'bayer'}, {'step': 1}, {'data': IMAGE.ravel()[:100]}, {'width': 0}]
    with BagWriter(tmp_path / 'bag') as bag:
        for stamp_ns, changes in enumerate([{}, *faults, {}, *faults, {}], 1):
            bag.write('/image', raw_image(bag, stamp_ns, **changes), stamp_ns)
    recording = open_recording(tmp_path / 'bag')
    assert [frame.stamp_ns for frame in recording.frames()] == [1, 6, 11]
    assert recording.skipped == {'unknown encoding': 2, 'wrong step': 2, 'truncated data': 2,
                                 'zero size': 2}
    assert len(caplog.records) == 4


def test_a_truncated_jpeg_in_the_middle_is_left_out(tmp_path):
    """No half-grey picture comes through."""
    with BagWriter(tmp_path / 'bag') as bag:
        for stamp_ns in range(1, 6):
            data = encode_jpeg(IMAGE)
            bag.write('/image', bag.type('sensor_msgs/msg/CompressedImage')(
                header=bag.header(stamp_ns, ''), format='jpeg',
                data=data[:len(data) // 2] if stamp_ns == 3 else data), stamp_ns)
    recording = open_recording(tmp_path / 'bag')
    assert [frame.stamp_ns for frame in recording.frames()] == [1, 2, 4, 5]
    assert recording.skipped == {'truncated JPEG': 1}


def test_a_damaged_message_is_left_out(tmp_path, caplog):
    """Its fields cannot even be told apart."""
    types = get_typestore(Stores.ROS2_JAZZY)
    with BagWriter(tmp_path / 'intact') as bag:
        message, next_message = (types.serialize_cdr(
            raw_image(bag, stamp_ns), 'sensor_msgs/msg/Image') for stamp_ns in (1, 2))
    with Rosbag2Writer(tmp_path / 'bag', version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connection = writer.add_connection('/image', 'sensor_msgs/msg/Image', typestore=types)
        for received_ns, data in enumerate((message, message[:40], b'', next_message)):
            writer.write(connection, received_ns, data)
    recording = open_recording(tmp_path / 'bag')
    assert len(list(recording.frames())) == 2
    assert recording.skipped == {'unreadable message': 2}
    assert len(caplog.records) == 1


def test_zero_stamps_fall_back_to_the_time_of_receipt(tmp_path, caplog):
    """One warning tells."""
    with BagWriter(tmp_path / 'bag') as bag:
        for received_ns in (START_NS, START_NS + 5):
            bag.write('/image', raw_image(bag, 0), received_ns)
    stamps_ns = [frame.stamp_ns for frame in open_recording(tmp_path / 'bag').frames()]
    assert stamps_ns == [START_NS, START_NS + 5]
    assert len(caplog.records) == 1 and 'zero' in caplog.text


def test_stamps_out_of_order_are_passed_on_as_they_are(tmp_path):
    """It is the stabiliser's business to judge them."""
    with BagWriter(tmp_path / 'bag') as bag:
        for received_ns, stamp_ns in enumerate((30, 10, 10, 20), 100):
            bag.write('/image', raw_image(bag, stamp_ns), received_ns)
    frames = open_recording(tmp_path / 'bag').frames()
    assert [frame.stamp_ns for frame in frames] == [30, 10, 10, 20]


@pytest.fixture
def bag_of_several_topics(tmp_path):
    """Return a bag with two image topics, an orientation, and an empty image topic."""
    with BagWriter(tmp_path / 'bag') as bag:
        bag.write_jpeg('/left', 1, '', IMAGE)
        bag.write_jpeg('/right', 2, '', IMAGE)
        bag.write_orientation('/pose', 3, 'world', Rotation.identity())
    return tmp_path / 'bag'


def test_several_image_topics_must_be_chosen_from(bag_of_several_topics):
    """The error names them and the option."""
    with pytest.raises(RecordingError, match='--image-topic.*/left, /right'):
        open_recording(bag_of_several_topics)
    frame, = open_recording(bag_of_several_topics, '/right').frames()
    assert frame.stamp_ns == 2


@pytest.mark.parametrize('images_first', [False, True])
def test_of_a_topic_of_two_types_the_images_are_read(tmp_path, turning, images_first):
    """As where two nodes published under one name: the other's messages are left out."""
    path = tmp_path / 'bag'
    with BagWriter(path) as bag:
        def others():
            bag.write(IMAGE_TOPIC, bag.make('std_msgs/msg/String', data='hello'), START_NS)
            bag._connections.clear()
        if not images_first:
            others()
        for stamp_ns, image in zip(stamps_of(4).tolist(), turning[0]):
            bag.write_jpeg(IMAGE_TOPIC, stamp_ns, 'camera', image)
        if images_first:
            bag._connections.clear()
            others()
    recording = open_recording(path)
    assert recording.topics == {IMAGE_TOPIC: 'sensor_msgs/msg/CompressedImage'}
    assert len(list(recording.frames())) == 4
    assert recording.skipped == {'unreadable message': 1}


@pytest.mark.parametrize('topic', ['/pose', '/nowhere'])
def test_what_is_not_an_image_topic_is_refused(bag_of_several_topics, topic):
    """The error names the topics that there are."""
    with pytest.raises(RecordingError, match=f'no image topic {topic}.*/left.*/pose.*/right'):
        open_recording(bag_of_several_topics, topic)


def test_messages_of_a_missing_topic_are_refused(bag_of_several_topics):
    """The error names the topics that there are."""
    with pytest.raises(RecordingError, match='/nowhere.*/pose'):
        next(open_recording(bag_of_several_topics, '/left').messages('/nowhere'))


def test_a_bag_without_images_is_refused(tmp_path):
    """The error names the topics that there are."""
    with BagWriter(tmp_path / 'bag') as bag:
        bag.write_orientation('/pose', 3, 'world', Rotation.identity())
    with pytest.raises(RecordingError, match='no images; it has /pose'):
        open_recording(tmp_path / 'bag')


@pytest.mark.parametrize('name', ['a.mcap', 'a.db3', 'a.bag', 'folder', 'a.mp4', 'a.avi'])
@pytest.mark.parametrize('content', [b'', 1000 * b'what is this'])
def test_what_is_no_recording_is_refused_in_one_line(tmp_path, name, content):
    """Empty files, other files, empty folders."""
    path = tmp_path / name
    if name == 'folder':
        path.mkdir()
        (path / 'notes.txt').write_bytes(content)
    else:
        path.write_bytes(content)
        if path.suffix in ('.mp4', '.avi'):
            pytest.importorskip('av')
    with pytest.raises(RecordingError, match='not a readable') as error:
        open_recording(path)
    assert '\n' not in str(error.value)


def test_a_recording_that_may_not_be_read_is_refused(tmp_path, monkeypatch):
    """The error says why; being root, tests cannot take the right away."""
    path = write_bag(tmp_path / 'bag', [IMAGE]) / 'bag.mcap'

    def denied(*_, **__):
        raise PermissionError(errno.EACCES, 'Permission denied', str(path))
    monkeypatch.setattr(type(path), 'open', denied)
    with pytest.raises(RecordingError, match='cannot be read: Permission denied'):
        open_recording(path)


@pytest.mark.parametrize('metadata', ['', 'a: [', 'rosbag2_bagfile_information: {}', '- 1'])
def test_damaged_metadata_are_done_without(tmp_path, metadata):
    """The messages tell all that is needed."""
    path = write_bag(tmp_path / 'bag', 3 * [IMAGE])
    (path / 'metadata.yaml').write_text(metadata)
    assert len(list(open_recording(path).frames())) == 3


def test_a_picture_damaged_within_is_left_out_when_it_is_decoded(tmp_path, caplog):
    """Also by those who stabilise; whole ones after it are there."""
    with BagWriter(tmp_path / 'bag') as bag:
        for stamp_ns in range(1, 6):
            msg = compressed_image(bag.make, stamp_ns, 'camera', IMAGE)
            if stamp_ns in (2, 4):
                # Its tables become comments.
                data = msg.data.tobytes().replace(b'\xff\xdb', b'\xff\xfe')
                msg.data = np.frombuffer(data, np.uint8)
            bag.write('/image', msg, stamp_ns)
    recording = open_recording(tmp_path / 'bag')
    assert [frame.stamp_ns for frame in decoded_frames(recording)] == [1, 3, 5]
    assert len(caplog.records) == 1 and 'corrupt JPEG' in caplog.text
    for pictures in (False, True):
        summary = stabilize_recording(
            recording, Stabilizer(), [lambda s: s.sphere()] if pictures else (),
            pictures=pictures)
        assert (summary.frames, summary.left_out) == (3, {'corrupt JPEG': 2})


def test_a_missing_recording_is_refused(tmp_path):
    """The error names the path."""
    with pytest.raises(RecordingError, match='nothing.bag does not exist'):
        open_recording(tmp_path / 'nothing.bag')


def test_memory_does_not_grow_with_the_recording(tmp_path):
    """Frames are read one by one."""
    recording = open_recording(write_bag(tmp_path / 'bag', 400 * [IMAGE]))
    tracemalloc.start()
    try:
        count = sum(1 for _ in recording.frames())
        peak_bytes = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert count == 400
    assert peak_bytes < 100 * IMAGE.nbytes


def test_results_are_read_back_from_a_bag(tmp_path):
    """Orientation, images and camera info, with their stamps and frames."""
    R = Rotation.from_rotvec((0.1, 0.2, 0.3))
    with BagWriter(tmp_path / 'bag') as bag:
        bag.write_orientation('orientation', START_NS, 'stabilized', R)
        bag.write_jpeg('stabilized/image/compressed', START_NS, 'stabilized', IMAGE)
        bag.write('view/camera_info',
                  camera_info(bag.make, START_NS, 'view', np.pi / 2, (640, 480)), START_NS)
    recording = open_recording(tmp_path / 'bag')
    (received_ns, msg), = recording.messages('orientation')
    q = msg.quaternion
    assert (Rotation.from_quat((q.x, q.y, q.z, q.w)).inv() * R).magnitude() < 1e-9
    assert received_ns == START_NS == msg.header.stamp.sec * 10**9 + msg.header.stamp.nanosec
    assert msg.header.frame_id == 'stabilized'
    (_, info), = recording.messages('view/camera_info')
    # A point 45 degrees to the right is half a pixel beyond the last column's centre.
    u = info.k.reshape(3, 3) @ (1, 0, 1)
    assert (u[0], info.width, info.height) == (639.5, 640, 480)
