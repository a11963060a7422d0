# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The command replay: what it writes, what it says, and how it ends."""

from pathlib import Path
import signal
import subprocess
import sys
import time
from unittest import mock

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from sph_stab_ros.config import StabilizerConfig
from sph_stab_ros.evaluation.ground_truth import read_truth
from sph_stab_ros.geometry.trajectory import read_tum
from sph_stab_ros.images.codec import image_from_compressed
from sph_stab_ros.images.frame import Frame
from sph_stab_ros.recording import open_recording, RecordingError
from sph_stab_ros.recording.bag_writer import BagWriter
from sph_stab_ros.replay import main
from sph_stab_ros.simulation.recordings import R_CAMERA_MARKERS, TRUTH_TOPIC
from sph_stab_ros.stabilization.pipeline import Stabilizer
from sph_stab_ros.stabilization.recording_loop import stabilize_recording
from sph_stab_ros.tracking.offline.grey_spool import GreySpool, SpoolError
from tiny_recordings import (
    IMAGE_TOPIC, PERIOD_NS, stamps_of, textured_sphere, turning_spheres, write_bag)

BAGS = Path(__file__).resolve().parents[1] / 'bags'
IMAGE = textured_sphere()


def angles_deg(R_a, R_b):
    """Return the angles between rotations in degrees."""
    return np.rad2deg((R_a.inv() * R_b).magnitude())


def call(*args, expect=0):
    """Run the command in this process and check its exit status."""
    try:
        status = main([str(arg) for arg in args])
    except SystemExit as end:
        status = end.code
    assert status == expect


@pytest.mark.parametrize('estimator, told', [
    ('anchored', 'anchored to keyframes'), ('moment', 'chained over 11 steps by moment')])
def test_the_trajectory_is_that_of_the_camera(
        turning, turning_bag, tmp_path, capsys, estimator, told):
    """One line for each picture: header stamps to the nanosecond, and R_world_camera."""
    call(turning_bag, '--trajectory', tmp_path / 'out.tum', '--estimator', estimator)
    trajectory = read_tum(tmp_path / 'out.tum')
    assert np.array_equal(trajectory.stamps_ns, stamps_of(len(turning[0])))
    assert angles_deg(trajectory.rotations, turning[1]).max() < 0.3
    output = capsys.readouterr().out
    assert '12 frames' in output and told in output
    assert ('drift' in output) is (estimator == 'moment')


def test_offline_orientations_are_those_of_the_camera_too(turning, turning_bag, tmp_path, capsys):
    """By what comes later too, and told as ever."""
    call(turning_bag, '--offline', '--trajectory', tmp_path / 'out.tum')
    trajectory = read_tum(tmp_path / 'out.tum')
    assert np.array_equal(trajectory.stamps_ns, stamps_of(len(turning[0])))
    assert angles_deg(trajectory.rotations, turning[1]).max() < 0.1
    assert '12 ok' in capsys.readouterr().out


def test_offline_the_virtual_camera_turns_with_the_camera_not_behind(
        turning, turning_bag, tmp_path):
    """A steady turn passes unchanged, where the node stays behind by the time constant."""
    for flags in ((), ('--offline',)):
        call(turning_bag, tmp_path / 'out', '--smoothing', 'follow:0.3', '--force', *flags)
        out = open_recording(tmp_path / 'out', 'stabilized/image/compressed')
        quaternions = [m.quaternion for _, m in out.messages('virtual_orientation')]
        shown = Rotation.from_quat([(q.x, q.y, q.z, q.w) for q in quaternions])
        assert (angles_deg(shown, turning[1]).max() < 0.3) == bool(flags)


def test_offline_sizes_may_change_and_pictures_be_damaged(turning, tmp_path):
    """All readings use the same pictures, and go on at the last one of another size."""
    bag = tmp_path / 'bag'
    images, R = turning_spheres(24)
    with BagWriter(bag) as writer:
        for i, (image, stamp_ns) in enumerate(zip(images, stamps_of(24).tolist())):
            if i >= 12:
                image = cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
            data = cv2.imencode('.jpg', image)[1]
            if i in (4, 17):
                data[600:-2] = 0
            writer.write(IMAGE_TOPIC, writer.make(
                'sensor_msgs/msg/CompressedImage', format='jpeg', data=data,
                header=writer.header(stamp_ns, 'theta_camera')), stamp_ns)
    for out in ((), (tmp_path / 'out.mp4',)):
        call(bag, *out, '--offline', '--trajectory', tmp_path / 'out.tum', '--force')
        trajectory = read_tum(tmp_path / 'out.tum')
        used = np.isin(stamps_of(24), trajectory.stamps_ns)
        assert used.sum() >= 22
        assert angles_deg(trajectory.rotations, R[used]).max() < 0.5


def test_offline_what_is_left_out_is_told_once(turning, tmp_path, capsys, caplog):
    """However often the recording is read."""
    images = [IMAGE[:50], *turning[0]]
    bag = write_bag(tmp_path / 'bag', images)
    call(bag, '--offline', '--smoothing', 'follow', '--trajectory', tmp_path / 'out.tum')
    assert [record.getMessage() for record in caplog.records] == [
        'bag: picture left out, not 2:1: an equirectangular image is twice as wide as high, '
        'this is 256x50; -p projection:=... says what else it shows (more of these are only '
        'counted)']
    assert '12 ok' in capsys.readouterr().out


def test_offline_needs_the_anchored_tracker(turning_bag, capsys):
    """The others have nothing to look back at."""
    call(turning_bag, '--offline', '--estimator', 'pts', expect=2)
    assert capsys.readouterr().err == "replay: --offline needs the estimator 'anchored'\n"
    call('-', '--offline', expect=2)
    assert capsys.readouterr().err == 'replay: --offline reads twice, which a pipe cannot be\n'


def test_a_bag_holds_what_the_node_publishes(turning, turning_bag, tmp_path):
    """Orientation, stabilised sphere, view and camera info of each picture, with its stamp."""
    call(turning_bag, tmp_path / 'out', '--trajectory', tmp_path / 'out.tum',
         '--view=90,10,0,60')
    out = open_recording(tmp_path / 'out', 'stabilized/image/compressed')
    types = {'orientation': 'geometry_msgs/msg/QuaternionStamped',
             'virtual_orientation': 'geometry_msgs/msg/QuaternionStamped',
             'orientation_covariance': 'geometry_msgs/msg/PoseWithCovarianceStamped',
             'stabilized/image/compressed': 'sensor_msgs/msg/CompressedImage',
             'view/image/compressed': 'sensor_msgs/msg/CompressedImage',
             'view/camera_info': 'sensor_msgs/msg/CameraInfo'}
    assert out.topics == {**types, '/tf': 'tf2_msgs/msg/TFMessage'}
    for topic in types:
        stamps_ns = [m.header.stamp.sec * 10**9 + m.header.stamp.nanosec
                     for _, m in out.messages(topic)]
        assert stamps_ns == stamps_of(12).tolist()
    quaternions = [m.quaternion for _, m in out.messages('orientation')]
    assert np.allclose([(q.x, q.y, q.z, q.w) for q in quaternions],
                       read_tum(tmp_path / 'out.tum').rotations.as_quat(), atol=1e-8)
    assert {m.header.frame_id for _, m in out.messages('orientation')} == {'stabilized_optical'}
    assert {m.header.frame_id for _, m in out.messages('view/camera_info')} == {'view_optical'}

    shaken, still = ([np.abs(image.astype(int) - images[0]).mean() for image in images[1:]]
                     for images in (turning[0], [frame.image for frame in out.frames()]))
    assert max(still) < min(10, max(shaken) / 3)


def test_a_bag_of_pictures_without_a_frame_has_no_transforms_and_that_is_said(
        turning_video, tmp_path, caplog):
    """They would hang in the air."""
    call(turning_video, tmp_path / 'out', '--max-frames', 3)
    assert '/tf' not in open_recording(tmp_path / 'out', 'view/image/compressed').topics
    record, = caplog.records
    assert record.getMessage().startswith('no /tf in ')


def frames_of(path):
    """Return all pictures of a video."""
    av = pytest.importorskip('av')
    with av.open(str(path)) as container:
        return [picture.to_ndarray(format='bgr24') for picture in container.decode(video=0)]


def test_a_video_shows_the_stabilised_sphere(turning_bag, tmp_path):
    """It stands still while the camera turns."""
    call(turning_bag, tmp_path / 'out.mp4')
    pictures = frames_of(tmp_path / 'out.mp4')
    assert len(pictures) == 12 and pictures[0].shape == IMAGE.shape
    assert np.abs(pictures[-1].astype(int) - pictures[0]).mean() < 10


def test_a_video_of_a_video(turning_video, tmp_path):
    """Without ROS and bags: times are the container's."""
    call(turning_video, tmp_path / 'out.mp4', '--trajectory', tmp_path / 'out.tum',
         '--max-frames', 5)
    assert len(frames_of(tmp_path / 'out.mp4')) == 5
    stamps_ns = read_tum(tmp_path / 'out.tum').stamps_ns
    assert stamps_ns[0] == 0 and np.abs(np.diff(stamps_ns) - PERIOD_NS).max() < 2e4


def test_a_video_may_follow_slow_turns(turning_bag, tmp_path):
    """It begins as the locked one does and ends nearer to what was recorded."""
    locked, following = tmp_path / 'locked.mp4', tmp_path / 'following.mp4'
    call(turning_bag, locked)
    call(turning_bag, following, '--smoothing', 'follow:0.3')
    locked, following = frames_of(locked), frames_of(following)
    first, last = (np.abs(following[i].astype(int) - locked[i]).mean() for i in (0, -1))
    assert first < last / 3
    recorded = [frame.image.astype(int) for frame in open_recording(turning_bag).frames()]
    assert np.abs(following[-1] - recorded[-1]).mean() < np.abs(locked[-1] - recorded[-1]).mean()
    assert np.abs(following[-1] - recorded[0]).mean() > np.abs(locked[-1] - recorded[0]).mean()


def test_a_video_of_the_view(turning_bag, tmp_path):
    """It has the size of the view's picture and stands still too."""
    call(turning_bag, tmp_path / 'out.mp4', '--view', '90,0,0,90', '--max-frames', 4)
    pictures = frames_of(tmp_path / 'out.mp4')
    assert pictures[0].shape == (480, 640, 3)
    assert np.abs(pictures[-1].astype(int) - pictures[0]).mean() < 10


def test_side_by_side_shows_recorded_above_stabilised(turning_bag, tmp_path):
    """The first picture is the same in both rows; later only the lower row stands still."""
    call(turning_bag, tmp_path / 'out.mp4', '--side-by-side')
    pictures = [picture.astype(int) for picture in frames_of(tmp_path / 'out.mp4')]
    height = IMAGE.shape[0]
    assert pictures[0].shape == (2 * height, 4 * height, 3)
    # Below the labels.
    recorded, stabilised = ([picture[rows][height // 4:] for picture in pictures]
                            for rows in (slice(0, height), slice(height, None)))
    assert np.abs(recorded[0] - stabilised[0]).mean() < 4
    for part in (slice(0, 2 * height), slice(2 * height, 3 * height), slice(3 * height, None)):
        shaken, still = (np.abs(row[-1][:, part] - row[0][:, part]).mean()
                         for row in (recorded, stabilised))
        assert still < shaken / 3


def test_a_grey_recording_is_stabilised_too(turning, tmp_path):
    """One channel in, all outputs."""
    bag = write_bag(tmp_path / 'bag', [cv2.cvtColor(i, cv2.COLOR_BGR2GRAY) for i in turning[0]])
    call(bag, tmp_path / 'out', '--trajectory', tmp_path / 'out.tum')
    call(bag, tmp_path / 'out.mp4', '--side-by-side', '--max-frames', 2)
    assert angles_deg(read_tum(tmp_path / 'out.tum').rotations, turning[1]).max() < 0.3


class Frames:
    """A recording of given pictures and stamps."""

    name, skipped = 'frames', {}

    def __init__(self, images, stamps_ns):
        self._frames = [Frame(i, int(ns)) for i, ns in zip(images, stamps_ns, strict=True)]

    def frames(self):
        """Yield the frames."""
        yield from self._frames


def replayed(images, stamps_ns):
    """Return the StabilizedFrames of a replay and its summary."""
    stabilized = []
    summary = stabilize_recording(Frames(images, stamps_ns), Stabilizer(StabilizerConfig()),
                                  [stabilized.append])
    return stabilized, summary


def test_stamps_that_do_not_increase_are_counted(turning, caplog):
    """Repeated or backward, each picture still has its pose."""
    images, R_world_camera = turning
    stamps_ns = stamps_of(12)
    stamps_ns[5] = stamps_ns[4]
    stamps_ns[8] = stamps_ns[2]
    stabilized, summary = replayed(images, stamps_ns)
    assert [s.stamp_ns for s in stabilized] == stamps_ns.tolist()
    assert angles_deg(stabilized[-1].R_world_camera, R_world_camera[-1]) < 0.5
    assert list(summary.events.values()) == [2]
    assert len(caplog.records) == 1 and 'not later' in caplog.text


def test_a_gap_of_seconds_is_named(turning, caplog):
    """The pictures before and after it have their poses."""
    stamps_ns = stamps_of(12)
    stamps_ns[6:] += 5 * 10**9
    stabilized, _ = replayed(turning[0], stamps_ns)
    assert len(stabilized) == 12
    assert len(caplog.records) == 1 and 'no frame for more than' in caplog.text


def test_black_pictures_are_bridged(turning):
    """They have a pose, which is not called measured, and the camera is found again."""
    images = list(turning[0])
    images[5] = images[6] = np.zeros_like(IMAGE)
    stabilized, summary = replayed(images, stamps_of(12))
    assert [s.status.value for s in stabilized] == 5 * ['ok'] + 2 * ['predicted'] + 5 * ['ok']
    assert angles_deg(stabilized[-1].R_world_camera, turning[1][-1]) < 0.5
    assert summary.statuses == {'ok': 10, 'predicted': 2}


def test_a_new_resolution_is_named_and_goes_on(turning, caplog):
    """The orientation reached so far is kept."""
    larger, R_larger = turning_spheres(12, width=512)
    images = turning[0][:6] + larger[6:]
    stabilized, _ = replayed(images, stamps_of(12))
    assert len(stabilized) == 12
    assert [s.sphere().shape[1] for s in stabilized] == 6 * [256] + 6 * [512]
    turned_after = stabilized[6].R_world_camera.inv() * stabilized[-1].R_world_camera
    assert angles_deg(turned_after, R_larger[6].inv() * R_larger[11]) < 0.3
    assert len(caplog.records) == 1 and 'size changed' in caplog.text


def test_a_video_of_pictures_that_change_size_is_written(turning, tmp_path):
    """The first one's size holds."""
    bag = write_bag(tmp_path / 'bag', turning[0][:3] + turning_spheres(6, width=512)[0][3:])
    call(bag, tmp_path / 'out.mp4', '--trajectory', tmp_path / 'out.tum')
    assert {picture.shape for picture in frames_of(tmp_path / 'out.mp4')} == {IMAGE.shape}
    assert len(read_tum(tmp_path / 'out.tum')) == 6


def test_pictures_that_are_too_small_are_no_recording():
    """The error says why there is nothing."""
    with pytest.raises(RecordingError, match='no usable picture'):
        replayed(3 * [IMAGE[:16, :32]], stamps_of(3))


@pytest.mark.parametrize('args', [
    (), ('{bag}', '{new}.avi'), ('{bag}', '--side-by-side'), ('{bag}', '--view', '0,0,0,90'),
    ('{bag}', '{new}', '--side-by-side'), ('{bag}', '{new}', '--view', '0,0,0'),
    ('{bag}', '{new}', '--view', '0,0,0,400'), ('{bag}', '{new}', '--view', 'a,b,c,d'),
    ('{bag}', '--max-frames', '0'), ('{bag}', '--max-frames', 'x'), ('{bag}', '--start', '1e300'),
    ('{bag}', '--max-frames', 30 * '9'), ('{bag}', '{bag}', '--force'),
    ('{bag}', '{bag}/..', '--force'), ('{bag}', '--trajectory', '{bag}/..', '--force'),
    ('{bag}', '--smoothing', 'magic'), ('{bag}', '--smoothing', 'follow:fast'),
    ('{bag}', '--smoothing', 'follow:0'),
    ('{bag}', '--estimator', 'magic'), ('{bag}', '--flow', 'magic'), ('{bag}', '--no-such-option'),
    ('{bag}', '--mask', 'missing.png'), ('{bag}', '--mask', 'lat:10,-10'),
    ('{bag}', '--working-width', '5'),
])
def test_a_wrong_call_ends_with_2_and_one_line(turning_bag, tmp_path, capsys, args):
    """Nothing is begun."""
    call(*(arg.format(bag=turning_bag, new=tmp_path / 'new') for arg in args), expect=2)
    assert len(capsys.readouterr().err.splitlines()) == 1
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize('args, message', [
    (('{missing}',), 'does not exist'),
    (('{bag}', '{existing}'), 'exists already'),
    (('{bag}', '--trajectory', '{existing}'), 'exists already'),
    (('{bag}', '{missing}/out'), 'cannot be written'),
    (('{bag}', '{missing}/out.mp4'), 'cannot be written'),
    (('{bag}', '--trajectory', '{missing}/out.tum'), 'cannot be written'),
    (('{bag}', '--image-topic', '/nowhere'), '/theta/image_raw/compressed'),
    (('{existing}',), 'not a readable'),
])
def test_a_failure_ends_with_1_and_one_line(turning_bag, tmp_path, capsys, args, message):
    """Nothing is left behind, and what was there is untouched."""
    existing = tmp_path / 'existing'
    existing.write_text('precious')
    call(*(arg.format(bag=turning_bag, existing=existing, missing=tmp_path / 'missing')
           for arg in args), expect=1)
    error, = capsys.readouterr().err.splitlines()
    assert message in error
    assert existing.read_text() == 'precious'
    assert [path.name for path in tmp_path.iterdir()] == ['existing']


def test_force_replaces(turning_bag, tmp_path):
    """Old results give way to new ones."""
    for frames in (3, 4):
        call(turning_bag, tmp_path / 'out', '--trajectory', tmp_path / 'out.tum', '--force',
             '--max-frames', frames)
        assert open_recording(tmp_path / 'out', 'view/image/compressed').frame_count == frames
        assert len(read_tum(tmp_path / 'out.tum')) == frames
    assert sorted(path.name for path in tmp_path.iterdir()) == ['out', 'out.tum']


def test_no_more_is_decoded_than_is_shown_or_tracked(tmp_path):
    """
    A trajectory takes a grey picture of what tracking takes; colour is for what is shown.

    A small one tells whether they are spheres.
    """
    bag = write_bag(tmp_path / 'bag', turning_spheres(3, width=1280)[0])
    for out, flags in (([], cv2.IMREAD_REDUCED_GRAYSCALE_2),
                       ([tmp_path / 'out'], cv2.IMREAD_ANYCOLOR)):
        with mock.patch('cv2.imdecode', wraps=cv2.imdecode) as decode:
            call(bag, *out, '--trajectory', tmp_path / 'out.tum', '--force')
        asked = [call.args[1] & ~cv2.IMREAD_IGNORE_ORIENTATION for call in decode.mock_calls]
        looked_at = [] if out else [cv2.IMREAD_REDUCED_GRAYSCALE_4]
        assert asked == 3 * [*looked_at, flags]


def start(*args):
    """Start the command as a process of its own."""
    return subprocess.Popen(
        [sys.executable, '-m', 'sph_stab_ros.replay', *map(str, args)], text=True,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE)


def test_as_a_process_it_says_nothing_but_its_result(turning_bag, tmp_path):
    """No progress bar where nobody looks, no traceback, status 0 or 1."""
    process = start(turning_bag, tmp_path / 'out', '--max-frames', '2')
    out, error = process.communicate(timeout=60)
    assert (process.returncode, error) == (0, '')
    assert out.startswith('2 frames in ')
    process = start(turning_bag, tmp_path / 'out')
    out, error = process.communicate(timeout=60)
    assert (process.returncode, out, len(error.splitlines())) == (1, '', 1)


@pytest.mark.parametrize('name, frames', [
    pytest.param('drone', None, marks=pytest.mark.slow),
    pytest.param('pioneer', None, marks=pytest.mark.slow),
    pytest.param('pioneer', 60, marks=pytest.mark.thorough)])
def test_the_simulated_recordings_come_out_as_the_truth_says(name, frames, tmp_path):
    """Trajectory and bag of a recording, or of its first frames, against its truth."""
    recording = open_recording(BAGS / name)
    process = start(BAGS / name, tmp_path / 'out', '--trajectory', tmp_path / 'out.tum',
                    *(('--max-frames', str(frames)) if frames else ()))
    out, error = process.communicate(timeout=600)
    assert (process.returncode, error) == (0, ''), error

    trajectory = read_tum(tmp_path / 'out.tum')
    assert len(trajectory) == (frames or recording.frame_count)
    R_mocap_camera = (read_truth(recording, TRUTH_TOPIC).at(trajectory.stamps_ns)
                      * R_CAMERA_MARKERS.inv())
    R_true = R_mocap_camera[0].inv() * R_mocap_camera
    assert angles_deg(R_true, trajectory.rotations).max() < 1.5
    turns, true_turns = (R[:-1].inv() * R[1:] for R in (trajectory.rotations, R_true))
    assert np.median(angles_deg(turns, true_turns)) < 0.06

    results = open_recording(tmp_path / 'out', 'stabilized/image/compressed')
    R_bag = read_truth(results, 'orientation')
    assert np.array_equal(R_bag.stamps_ns, trajectory.stamps_ns)
    assert angles_deg(R_bag.rotations, trajectory.rotations).max() < 1e-5
    width = next(recording.frames()).image.shape[1]
    for topic, shape in (('stabilized/image/compressed', (width // 2, width, 3)),
                         ('view/image/compressed', (480, 640, 3))):
        messages = [msg for _, msg in results.messages(topic)]
        stamps_ns = [msg.header.stamp.sec * 10**9 + msg.header.stamp.nanosec for msg in messages]
        assert stamps_ns == trajectory.stamps_ns.tolist()
        assert {image_from_compressed(msg.data).shape for msg in messages} == {shape}


@pytest.mark.parametrize('ending', [signal.SIGINT, signal.SIGTERM])
def test_an_interrupted_output_is_marked(turning, tmp_path, ending):
    """Its own name is not taken; what was written can be read."""
    bag = write_bag(tmp_path / 'bag', 150 * turning[0])
    out, partial = tmp_path / 'out', tmp_path / 'out.partial' / 'out'
    process = start(bag, out)
    while process.poll() is None and not (
            partial.is_dir() and any(f.stat().st_size > 2**20 for f in partial.iterdir())):
        time.sleep(0.02)
    assert process.poll() is None, process.communicate()
    process.send_signal(ending)
    _, error = process.communicate(timeout=60)
    assert process.returncode == 1
    assert 'Traceback' not in error and str(partial.parent) in error
    assert not out.exists()
    assert 0 < open_recording(partial, 'view/image/compressed').frame_count < 1800


def test_offline_says_in_one_line_that_its_pictures_have_no_room(
        turning_bag, tmp_path, capsys, monkeypatch):
    def full(self, grey):
        raise SpoolError('no room') from OSError()
    monkeypatch.setattr(GreySpool, 'add', full)
    call(turning_bag, '--offline', '--trajectory', tmp_path / 'out.tum', expect=1)
    assert capsys.readouterr().err.splitlines()[-1] == 'replay: no room'
    assert not [*tmp_path.iterdir()]
