# Copyright 2026 The sph_stab_ros developers
# SPDX-License-Identifier: Apache-2.0
"""What each part of the anchored tracker is worth: the recordings without it, mean errors."""

from pathlib import Path
import sys
from unittest import mock

import numpy as np

from sph_stab_ros.config import StabilizerConfig
from sph_stab_ros.evaluation.ground_truth import find_truth_topic, read_truth
from sph_stab_ros.evaluation.runs import evaluate_against_truth
from sph_stab_ros.recording import open_recording
from sph_stab_ros.simulation.recordings import R_CAMERA_MARKERS
from sph_stab_ros.tracking.anchored import (
    correction, landmark_map, landmarks, lens_misalignment, localization, pose_hypotheses, tracker)

VARIANTS = {
    'as it is': (),
    'no probation: all landmarks have a say': ((landmarks, 'MATURE_FRAMES', 0),),
    'one keyframe adjusted at a time': ((landmark_map, 'ADJUSTED_KEYFRAMES', 1),),
    'inactive landmarks are not looked for': ((localization, 'MAX_RETURNING', 0),),
    '300 landmarks': ((landmark_map, 'MAX_LANDMARKS', 300),),
    'no random starts where much moves': ((pose_hypotheses, 'TRIALS', 0),),
    'the lenses are taken for one': ((lens_misalignment, 'SIGNIFICANT', np.inf),),
    'always searched coarsely first': ((tracker, 'MAX_FINE_S', -1.),),
    'corrections at once': ((correction, 'MIN_STEP_RAD', np.pi),),
}


def main(folder='bags', frames=None):
    """Print a table of geodesic means and medians per frame, in degrees."""
    recordings = [open_recording(Path(folder) / name)
                  for name in ('drone', 'pioneer', 'handheld')]
    print('| | ' + ' | '.join(recording.name for recording in recordings) + ' |')
    print('| --- ' * (1 + len(recordings)) + '|')
    for name, changes in VARIANTS.items():
        cells = []
        for recording in recordings:
            patches = [mock.patch.object(*change) for change in changes]
            for patch in patches:
                patch.start()
            _, errors, _ = evaluate_against_truth(
                recording, {name: StabilizerConfig()},
                read_truth(recording, find_truth_topic(recording)), R_CAMERA_MARKERS.inv(),
                max_frames=frames and int(frames))
            for patch in patches:
                patch.stop()
            cells.append(f'{errors[name].geodesic_deg.mean():.2f}, '
                         f'{np.median(errors[name].per_frame_deg):.3f}°')
        print(f'| {name} | ' + ' | '.join(cells) + ' |', flush=True)


if __name__ == '__main__':
    main(*sys.argv[1:])
