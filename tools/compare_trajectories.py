#!/usr/bin/env python3
# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""
Whether another build gives the same orientations, to the last byte or by how much not.

    git worktree add ../before COMMIT && (cd ../before && python setup.py build_ext --inplace)
    tools/compare_trajectories.py write results/before --code ../before
    tools/compare_trajectories.py write results/now
    tools/compare_trajectories.py compare results/before results/now

Both are made on one machine, with BLAS and OpenCV held to one thread each; write the first one
twice to see that it repeats. Where sums are taken in another order, a choice somewhere turns out
otherwise sooner or later, and the rest differs by up to 0.1° in anchored: so does one build with
OPENBLAS_CORETYPE=Haswell and =Nehalem. Such builds are equal as far as that frame.
"""

import argparse
import os
from pathlib import Path
import subprocess
import sys

import numpy as np
from scipy.spatial.transform import Rotation

ROOT = Path(__file__).resolve().parents[1]
RECORDINGS = (*(ROOT / 'bags' / name for name in ('drone', 'pioneer', 'handheld')),
              ROOT.parent / 'shared/data/handheld_theta/handheld_theta.mp4')
ESTIMATORS = ('anchored', 'pts', 'moment', 'pts_epipolar')
ONE_THREAD = {'OMP_NUM_THREADS': '1', 'OPENBLAS_NUM_THREADS': '1', 'OPENCV_FOR_THREADS_NUM': '1'}


def write(folder, code, frames):
    """Write a TUM file for each recording that is there and each estimator."""
    folder.mkdir(parents=True, exist_ok=True)
    for recording in filter(Path.exists, RECORDINGS):
        for estimator in ESTIMATORS:
            subprocess.run(
                [sys.executable, '-m', 'sph_stab_ros.replay', recording, '--estimator', estimator,
                 '--trajectory', folder.resolve() / f'{recording.stem}.{estimator}.tum', '--force',
                 *(('--max-frames', str(frames)) if frames else ())],
                check=True, cwd=code, stdout=subprocess.DEVNULL,
                env={**os.environ, **ONE_THREAD, 'PYTHONPATH': str(code.resolve())})


def difference_deg(a, b):
    """Return the largest angle between the orientations of two TUM files of the same stamps."""
    (stamps_a, q_a), (stamps_b, q_b) = (np.split(np.loadtxt(path), [4], axis=1)
                                        for path in (a, b))
    frames = min(len(stamps_a), len(stamps_b))
    if not np.array_equal(stamps_a[:frames], stamps_b[:frames]):
        return np.inf
    turns = Rotation.from_quat(q_a[:frames]).inv() * Rotation.from_quat(q_b[:frames])
    return np.rad2deg(turns.magnitude().max())


def compare(before, now):
    """Print how far the trajectories of two folders differ; return whether they all are equal."""
    equal = True
    for path in sorted(before.glob('*.tum')):
        a, b = path.read_bytes(), (now / path.name).read_bytes()
        # A part of the recording is compared with the beginning of the whole.
        same = a[:len(b)] == b[:len(a)]
        equal &= same
        print(f'{path.stem:30}' + ('identical' if same else
              f'{difference_deg(path, now / path.name):.6f} deg at most'))
    return equal


def main():
    """Run the command line; return the exit status: 1 where orientations differ."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    commands = parser.add_subparsers(dest='command', required=True)
    writing = commands.add_parser('write', help='write trajectories into FOLDER')
    writing.add_argument('folder', type=Path, metavar='FOLDER')
    writing.add_argument('--code', type=Path, default=ROOT, metavar='CHECKOUT',
                         help='the build to run (default: this one)')
    writing.add_argument('--frames', type=int, metavar='N', help='only the first N pictures')
    comparing = commands.add_parser('compare', help='compare two such folders')
    comparing.add_argument('before', type=Path)
    comparing.add_argument('now', type=Path)
    args = parser.parse_args()
    if args.command == 'write':
        write(args.folder, args.code, args.frames)
        return 0
    return 0 if compare(args.before, args.now) else 1


if __name__ == '__main__':
    sys.exit(main())
