# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The option --split of batch: segments in parallel, joined to what one run would have found."""

from argparse import Namespace
from pathlib import Path
import signal
import time

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from sph_stab_ros.batch.__main__ import arguments
from sph_stab_ros.batch.results import LOCK, manifest_of, PARTIAL, SEGMENTS
from sph_stab_ros.batch.segments import join_tracked, ORIENTATIONS, save, stretches_of
from sph_stab_ros.batch.tasks import Task
from sph_stab_ros.evaluation.alignment import align_trajectories
from sph_stab_ros.evaluation.ground_truth import find_truth_topic, read_truth
from sph_stab_ros.evaluation.runs import compare
from sph_stab_ros.geometry.trajectory import read_tum, Trajectory
from sph_stab_ros.recording import open_recording, RecordingError
from sph_stab_ros.recording.base import Stretch
from sph_stab_ros.stabilization.pipeline import Stabilizer
from sph_stab_ros.stabilization.recording_loop import stabilize_recording
from sph_stab_ros.tracking.base import TrackedOrientation, TrackingStatus
from sph_stab_ros.tracking.offline.joining import join_segments, Segment
from test_batch import call, start
from tiny_recordings import START_NS, turning_spheres, write_bag

BAGS = Path(__file__).resolve().parents[2] / 'bags'
# So that there are two segments of each.
SPLIT_S = {'drone': 10, 'handheld': 6}
PERIOD_S = 0.1
FRAMES = 160


@pytest.fixture(scope='module')
def turning():
    """Return spheres of a camera that turns for sixteen seconds, and its R_world_camera."""
    return turning_spheres(FRAMES)


@pytest.fixture
def images(turning):
    """Return the spheres."""
    return turning[0]


def write(path, images):
    """Write a bag of ten pictures a second."""
    return write_bag(path, images, START_NS + np.int64(PERIOD_S * 1e9) * np.arange(len(images)))


def tracked(bag, stretch=Stretch()):
    """Return what the live tracker finds of a stretch of a bag, as a Segment."""
    stamps_ns, orientations = [], []

    def keep(stabilized):
        stamps_ns.append(stabilized.stamp_ns)
        orientations.append(TrackedOrientation(
            stabilized.R_world_camera, stabilized.status, stabilized.covariance))
    stabilize_recording(open_recording(bag, None, *stretch), Stabilizer(), [keep])
    return Segment(np.array(stamps_ns), orientations)


def errors(bag, segment):
    """Return the figures of a Segment's errors to the truth."""
    recording = open_recording(bag)
    truth = read_truth(recording, find_truth_topic(recording))
    estimate = Trajectory(segment.stamps_ns, Rotation.concatenate(
        [one.R_world_camera for one in segment.orientations]))
    return compare(truth, estimate, align_trajectories(truth, estimate, None, 0)).summary()


@pytest.mark.slow
def test_segments_are_together_as_good_as_one_run():
    """No step at the joint, and about the same errors to the truth, over two flights."""
    means = []
    for name in ('drone', 'handheld'):
        bag = BAGS / name
        found = tracked(bag), join_segments(
            [tracked(bag, stretch) for stretch in stretches_of(bag, None, SPLIT_S[name])])
        np.testing.assert_array_equal(*(segment.stamps_ns for segment in found))
        whole, joined = (errors(bag, segment) for segment in found)
        assert joined['per_frame_deg']['max'] <= whole['per_frame_deg']['max'] + 0.02
        means.append([one['geodesic_deg']['mean'] for one in (whole, joined)])
    whole_deg, joined_deg = np.mean(means, axis=0)
    assert joined_deg <= 1.2 * whole_deg


@pytest.mark.parametrize('write_as', ['trajectory', 'bag'])
def test_all_pictures_are_in_the_result_once(turning, tmp_path, write_as):
    """Whether or not the recording is read again for its pictures."""
    images, R_world_camera = turning
    bag, out = write(tmp_path / 'bag', images), tmp_path / 'out'
    call(bag, '--out', out, '--write', write_as, '--split', '10', '--smoothing', 'follow',
         '--report')
    assert (out / 'bag' / 'report.html').read_text().startswith('<!DOCTYPE html>')
    assert manifest_of(out / 'bag')['frames'] == FRAMES
    trajectory = read_tum(out / 'bag' / 'trajectory.tum')
    np.testing.assert_array_equal(
        trajectory.stamps_ns, [frame.stamp_ns for frame in open_recording(bag).frames()])
    assert np.rad2deg((trajectory.rotations.inv() * R_world_camera).magnitude()).max() < 0.3
    assert not (out / SEGMENTS).exists() and not (out / PARTIAL).exists()
    if write_as == 'bag':
        pictures = open_recording(out / 'bag' / 'stabilized', 'stabilized/image/compressed')
        assert sum(1 for _ in pictures.frames()) == FRAMES


def test_segments_overlap_and_have_no_gaps(images, tmp_path):
    """Whatever the recording's length; a short one is not split."""
    bag = write(tmp_path / 'bag', images)
    assert len(stretches_of(bag, None, 16)) == 1
    first, second = stretches_of(bag, None, 10)
    assert first.start_s == 0 and second.end_s == float('inf')
    assert first.end_s - second.start_s == pytest.approx(5)
    assert first.end_s + second.start_s == pytest.approx(16)


@pytest.mark.slow
def test_after_a_power_cut_the_same_call_goes_on_with_the_segments_that_are_missing(
        images, tmp_path, capsys):
    """What is whole is not done again."""
    bag, out = write(tmp_path / 'bag', images), tmp_path / 'out'
    args = (bag, '--out', out, '--write', 'trajectory', '--split', '10', '--jobs', '1')
    process = start(*args)
    done = out / SEGMENTS / 'bag [1 of 2]'
    while process.poll() is None and not done.is_dir():
        time.sleep(0.01)
    process.send_signal(signal.SIGKILL)
    process.communicate(timeout=60)
    assert manifest_of(done) is not None and not (out / 'bag').exists()
    call(*args)
    said = capsys.readouterr().out
    assert 'bag [2 of 2]: ' in said and 'bag [1 of 2]: ' not in said
    assert manifest_of(out / 'bag')['frames'] == FRAMES
    call(*args)
    assert '1 recordings into' in capsys.readouterr().out
    assert {path.name for path in out.iterdir()} == {'bag', 'failures.json', LOCK}


@pytest.mark.slow
def test_a_segment_that_fails_is_the_reason(images, tmp_path, capsys):
    """The recording has no result, and others have theirs."""
    folder, out = tmp_path / 'in', tmp_path / 'out'
    folder.mkdir()
    write(folder / 'changing', images[:-20] + [image[::2, ::2] for image in images[-20:]])
    write(folder / 'good', images)
    args = (folder, '--out', out, '--write', 'trajectory', '--split', '10')
    call(*args, expect=1)
    said = capsys.readouterr()
    assert said.err == 'batch: 1 of 2 recordings have no result\n'
    table = said.out.splitlines()[-1]
    assert table.startswith('changing  changing [2 of 2]: its pictures change their size')
    assert manifest_of(out / 'good') is not None and not (out / 'changing').exists()
    call(*args, expect=1)
    again = capsys.readouterr().out
    assert again.splitlines()[-1] == table and '1 done, 1 failed' in again


@pytest.mark.parametrize('count', [FRAMES - 10, FRAMES + 10])
def test_a_recording_that_changes_meanwhile_is_told(images, tmp_path, count):
    """Fewer pictures or more than were tracked."""
    bag = write(tmp_path / 'bag', images)
    args, settings = arguments([str(bag), '--out', str(tmp_path / 'out'), '--write', 'bag'])
    task = Task('bag', bag, tmp_path / 'out', {}, args, settings, False, evaluate=False,
                track=True, memory_mb=2000, segments=(tmp_path,))
    rotations = Rotation.identity(count)
    save(tmp_path / ORIENTATIONS, Segment(
        np.arange(count), [TrackedOrientation(R, TrackingStatus.OK) for R in rotations]))
    args = Namespace(**{**vars(args), 'recording': bag, 'out': tmp_path / 'made', 'report': None,
                        'trajectory': None, 'force': False})
    with pytest.raises(RecordingError, match='the recording has changed'):
        join_tracked(task, args, lambda frames, total: frames)
