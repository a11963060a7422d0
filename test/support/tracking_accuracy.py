# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""
Accuracy that has been measured: ``test/ledger.json``, by recording and estimator.

Run as a program it measures anew and writes the ledger; ``make ledger`` does it. Arguments are
words that the names of what is measured must hold, so that ``make ledger ONLY='drone anchored'``
leaves all others as they are.
"""

from dataclasses import dataclass
from itertools import islice
import json
from pathlib import Path
import sys

from scipy.spatial.transform import Rotation
from sph_stab_ros.config import ANCHORED, METHODS, StabilizerConfig, TrackerConfig
from sph_stab_ros.evaluation.alignment import Alignment
from sph_stab_ros.evaluation.ground_truth import find_truth_topic, read_truth
from sph_stab_ros.evaluation.orientation_errors import compare
from sph_stab_ros.evaluation.runs import evaluate_injected, Run
from sph_stab_ros.geometry.conventions import R_BODY_CAMERA
from sph_stab_ros.recording import open_recording
from sph_stab_ros.simulation.recordings import R_CAMERA_MARKERS

ROOT = Path(__file__).resolve().parents[2]
LEDGER = ROOT / 'test' / 'ledger.json'
# How much worse than the ledger says is still taken for the same.
WORSE = 1.2
SMALL_DEG = 0.02
DIGITS = 5


@dataclass(frozen=True)
class Case:
    """
    An estimator on a recording, or on so many frames of it, each ``every``-th one.

    With a ``seed`` the recording has no truth and is turned by known rotations instead. ``slow``
    is left to ``make test-slow``.
    """

    recording: str
    estimator: str
    flow: str = TrackerConfig.flow
    frames: int | None = None
    every: int = 1
    seed: int | None = None
    R_body_camera: Rotation = R_CAMERA_MARKERS.inv()
    slow: bool = False

    @property
    def path(self):
        """Return where the recording is; it need not be there."""
        return ROOT / self.recording

    @property
    def variant(self):
        """Return the name under the recording's in the ledger."""
        said = [self.estimator]
        if self.flow != TrackerConfig.flow:
            said.append(self.flow)
        if self.frames:
            said.append(f'{self.frames} frames')
        if self.every > 1:
            said.append(f'1 of {self.every}')
        return ', '.join(said)

    @property
    def name(self):
        """Return the name of the whole."""
        return f'{self.recording}: {self.variant}'

    def measure(self):
        """Return the figures, in degrees."""
        recording = open_recording(self.path)
        config = StabilizerConfig(tracker=TrackerConfig(
            estimator=self.estimator, flow=self.flow))
        if self.seed is not None:
            _, figures = evaluate_injected(recording, {'': config}, self.seed, self.frames)
            return _of_accuracy(figures[''])
        run = Run(config)
        for frame in islice(recording.frames(), 0, self.frames, self.every):
            run.process(frame)
        truth = read_truth(recording, find_truth_topic(recording))
        errors = compare(truth, run.trajectory(), Alignment(self.R_body_camera))
        return _of_accuracy(run.summary(errors))


def _of_accuracy(figures):
    """Return those figures that the ledger is about, with as many digits as mean anything."""
    def rounded(degrees):
        return {name: float(f'{value:.{DIGITS}g}') for name, value in degrees.items()}
    return {'frames': figures['frames'], 'lost_frames': figures['lost_frames'],
            'per_frame_deg': rounded(figures['per_frame_deg']),
            'geodesic_deg': rounded(figures['geodesic_deg'])}


def _cases():
    for name in ('drone', 'pioneer', 'handheld'):
        bag = f'bags/{name}'
        yield Case(bag, ANCHORED)
        for method in METHODS:
            yield Case(bag, method, frames=20)
            yield Case(bag, method, slow=True)
        yield Case(bag, 'moment', 'dis', slow=True)
    yield Case('bags/drone', ANCHORED, frames=300, every=2)
    data = '../shared/data'
    for name in ('pioneer_a', 'pioneer_b', 'handheld_a'):
        yield Case(f'{data}/company/{name}', ANCHORED, R_body_camera=R_BODY_CAMERA, slow=True)
    for estimator in (ANCHORED, *METHODS):
        yield Case(f'{data}/handheld_theta/handheld_theta.mp4', estimator, frames=60, seed=1,
                   slow=True)


CASES = tuple(_cases())


def violations(measured, held):
    """Return a line for each figure that is worse than the ledger holds."""
    lines = []
    if measured['frames'] != held['frames']:
        lines.append(f"{measured['frames']} frames evaluated, the ledger has {held['frames']}")
    if measured['lost_frames'] > held['lost_frames']:
        lines.append(f"{measured['lost_frames']} frames lost, the ledger has "
                     f"{held['lost_frames']}")
    return lines + [f'{figure} {value:g}, the ledger has {limit:g}, worse than {bound:g}'
                    for figure, value, limit, bound in _bounds(measured, held)
                    # Written so that NaN fails.
                    if not value <= bound]


def improvements(measured, held):
    """Return a line for each figure by which the ledger can be tightened."""
    return [f'{figure} {value:g}, the ledger has {limit:g}'
            for figure, limit, value, bound in _bounds(held, measured) if not limit <= bound]


def _bounds(measured, held):
    """Give for each figure that is held its name, its value, the ledger's, and the bound."""
    limit = held['per_frame_deg']['median']
    yield 'per-frame median', measured['per_frame_deg']['median'], limit, WORSE * limit
    limit = held['geodesic_deg']['mean']
    yield ('geodesic mean', measured['geodesic_deg']['mean'], limit,
           max(WORSE * limit, limit + SMALL_DEG))


def read_ledger():
    """Return the figures by recording and variant."""
    return json.loads(LEDGER.read_text()) if LEDGER.exists() else {}


def updated(ledger, measured):
    """Return a ledger in the order of CASES with figures by Case in it, and no others."""
    written = {}
    for case in CASES:
        figures = measured.get(case, ledger.get(case.recording, {}).get(case.variant))
        if figures:
            written.setdefault(case.recording, {})[case.variant] = figures
    return written


def _short(figures):
    return (f"{figures['per_frame_deg']['median']:g} per frame, "
            f"{figures['geodesic_deg']['mean']:g} in the mean" if figures else 'nothing')


def main(words):
    """Measure the cases whose names hold all words; write the ledger; return the exit status."""
    cases = [case for case in CASES if all(word in case.name for word in words)]
    if not cases:
        print(f"ledger: nothing is named '{' '.join(words)}'", file=sys.stderr)
        return 2
    for case in cases:
        if not case.path.exists():
            print(f'{case.name}: the recording is not there', file=sys.stderr)
            continue
        figures, ledger = case.measure(), read_ledger()
        before = ledger.get(case.recording, {}).get(case.variant)
        print(f'{case.name}: {_short(before)} -> {_short(figures)}', flush=True)
        # At once: measuring all takes minutes, and may be interrupted.
        LEDGER.write_text(json.dumps(updated(ledger, {case: figures}), indent=2) + '\n')
    return 0


if __name__ == '__main__':
    sys.exit(main(sys.argv[1:]))
