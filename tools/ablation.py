# Copyright 2026 The sph_stab_ros developers
# SPDX-License-Identifier: Apache-2.0
"""What each part of the anchored tracker is worth: recordings without it, mean errors."""

import argparse
from dataclasses import replace
from functools import partial, reduce
import json
from pathlib import Path

import numpy as np

from sph_stab_ros.config import StabilizerConfig
from sph_stab_ros.evaluation.alignment import Alignment
from sph_stab_ros.evaluation.ground_truth import find_truth_topic, read_truth
from sph_stab_ros.evaluation.orientation_errors import compare
from sph_stab_ros.evaluation.runs import Run
from sph_stab_ros.geometry.conventions import R_BODY_CAMERA
from sph_stab_ros.recording import open_recording
from sph_stab_ros.simulation.recordings import R_CAMERA_MARKERS
from sph_stab_ros.stabilization.recording_loop import stabilize_recording
from sph_stab_ros.tracking import make_tracker
from sph_stab_ros.tracking.anchored.options import AnchoredOptions

MOUNTS = R_CAMERA_MARKERS.inv(), R_BODY_CAMERA
# By name, the options that are changed and to what.
VARIANTS = {
    'as it is': {},
    'no probation: all landmarks have a say': {'landmark_map.landmarks.mature_frames': 0},
    'one keyframe adjusted at a time': {'landmark_map.adjusted_keyframes': 1},
    'inactive landmarks are not looked for': {'localization.max_returning': 0},
    '300 landmarks': {'landmark_map.max_landmarks': 300},
    'no random starts where much moves': {'localization.hypotheses.trials': 0},
    'the lenses are taken for one': {'landmark_map.lenses.significant': np.inf},
    'always searched coarsely first': {'max_fine_s': -1.},
    'corrections at once': {'correction.min_step_rad': np.pi},
}


def changed(options, path, value):
    """Return options with another value of what a dotted path names."""
    name, _, rest = path.partition('.')
    return replace(options, **{
        name: changed(getattr(options, name), rest, value) if rest else value})


def errors(recording, options, frames):
    """Return the Errors over a simulated recording under AnchoredOptions."""
    run = Run(StabilizerConfig(), partial(make_tracker, anchored=options))
    stabilize_recording(recording, run, max_frames=frames)
    truth = read_truth(recording, find_truth_topic(recording))
    # By the mount that it was simulated with: 8 degrees lie between the two.
    return min((compare(truth, run.trajectory(), Alignment(mount)) for mount in MOUNTS),
               key=lambda one: one.geodesic_deg.mean())


def main():
    """Print the figures of each variant, in degrees, and write them."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('recordings', nargs='*', type=Path, metavar='RECORDING', default=[
        Path('bags') / name for name in ('drone', 'pioneer', 'handheld')])
    parser.add_argument('--max-frames', type=int, metavar='N')
    parser.add_argument('--json', type=Path, metavar='FILE', help='write all figures')
    args = parser.parse_args()
    recordings = [open_recording(path) for path in args.recordings]
    found = {}
    for variant, changes in VARIANTS.items():
        options = reduce(lambda known, change: changed(known, *change), changes.items(),
                         AnchoredOptions())
        found[variant] = {}
        for recording in recordings:
            one = errors(recording, options, args.max_frames)
            found[variant][recording.name] = {
                'geodesic_mean_deg': float(one.geodesic_deg.mean()),
                'per_frame_median_deg': float(np.median(one.per_frame_deg))}
            print(f'{variant}, {recording.name}: {one.geodesic_deg.mean():.3f}, '
                  f'{np.median(one.per_frame_deg):.3f}°', flush=True)
    if args.json:
        args.json.write_text(json.dumps(found, indent=2) + '\n')


if __name__ == '__main__':
    main()
