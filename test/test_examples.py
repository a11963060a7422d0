# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The examples run as they are, and what they print is right."""

from pathlib import Path
import subprocess
import sys

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from sph_stab_ros.evaluation.ground_truth import find_truth_topic, read_truth
from sph_stab_ros.recording import open_recording
from sph_stab_ros.recording.bag_writer import BagWriter

ROOT = Path(__file__).resolve().parents[1]
EXAMPLES = sorted((ROOT / 'examples').glob('*.py'))
FRAMES = 11
MAX_LINES = 30


@pytest.fixture(scope='module')
def drone(tmp_path_factory):
    """Return a bag with the first frames of bags/drone."""
    path = tmp_path_factory.mktemp('examples') / 'drone'
    frames = open_recording(ROOT / 'bags/drone').frames()
    with BagWriter(path) as bag:
        for frame, _ in zip(frames, range(FRAMES)):
            bag.write_jpeg('image/compressed', frame.stamp_ns, frame.frame_id, frame.image)
    frames.close()
    return path


def output_of(example, *arguments):
    done = subprocess.run(
        [sys.executable, ROOT / 'examples' / example, *map(str, arguments)], cwd=ROOT,
        text=True, capture_output=True, timeout=120)
    assert done.returncode == 0, done.stderr
    return done.stdout


def true_turns_deg(stamps_ns):
    """Return by how many degrees the drone has turned since the first stamp."""
    recording = open_recording(ROOT / 'bags/drone')
    truth = read_truth(recording, find_truth_topic(recording)).at(stamps_ns)
    return np.rad2deg((truth[0].inv() * truth).magnitude())


def test_every_example_is_run_by_a_test():
    source = Path(__file__).read_text()
    assert EXAMPLES and all(f"'{path.name}'" in source for path in EXAMPLES)


@pytest.mark.parametrize('path', EXAMPLES, ids=lambda path: path.stem)
def test_an_example_is_short(path):
    assert len(path.read_text().splitlines()) <= MAX_LINES


def test_orientation(drone):
    lines = [line.split() for line in output_of('orientation.py', drone).splitlines()]
    assert len(lines) == FRAMES
    turned_deg = [float(line[6]) for line in lines]
    assert turned_deg == pytest.approx(
        true_turns_deg([int(line[0]) for line in lines]), abs=0.1)


def test_custom_estimator(drone):
    text = output_of('custom_estimator.py', drone).replace('[', '').replace(']', '')
    rows = [line.split() for line in text.splitlines()]
    turned_deg = np.rad2deg(Rotation.from_quat(
        np.array([row[1:] for row in rows], float)).magnitude())
    # Plain least squares takes the motion of near things for turning.
    assert turned_deg == pytest.approx(true_turns_deg([int(row[0]) for row in rows]), abs=1.5)
    assert turned_deg[-1] > 10


def test_several_views(drone, tmp_path):
    output_of('several_views.py', drone, tmp_path)
    pictures = {path.stem: cv2.imread(str(path)) for path in tmp_path.iterdir()}
    assert set(pictures) == {
        f'{name}_{number:04d}' for name in ('front', 'left', 'rear') for number in (0, 10)}
    assert {picture.shape for picture in pictures.values()} == {(480, 640, 3)}

    def difference(a, b):
        return np.abs(np.float32(pictures[a]) - pictures[b]).mean()

    # The same wall after the turn, and another one beside it.
    assert difference('front_0000', 'front_0010') < 0.5 * difference('front_0000', 'left_0000')
