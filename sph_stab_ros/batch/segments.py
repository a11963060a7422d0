# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""
A long recording in overlapping segments: each tracked by a process of its own, then joined.

What was tracked of a segment is a result like others: whole or absent, with a manifest. So after
any end the same call goes on with those that are missing.
"""

from argparse import Namespace
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import islice
import math
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from sph_stab_ros.batch.results import manifest_of
from sph_stab_ros.batch.tasks import Outcome, Task
from sph_stab_ros.config import LOCK, NOT_JOINED
from sph_stab_ros.config.options import with_option
from sph_stab_ros.geometry.conventions import NS_PER_S
from sph_stab_ros.geometry.trajectory import Trajectory, write_tum
from sph_stab_ros.recording import open_recording, RecordingError
from sph_stab_ros.recording.base import EmptyStretch, Stretch
from sph_stab_ros.replay import Progress, replay, report
from sph_stab_ros.stabilization.recording_loop import Summary
from sph_stab_ros.stabilization.stabilized_frame import StabilizationEvent, StabilizedFrame
from sph_stab_ros.tracking.base import TrackedOrientation, TrackingStatus
from sph_stab_ros.tracking.offline.joining import join_segments, JoiningError, Segment
from sph_stab_ros.tracking.offline.two_passes import KnownOrientations

# How much of two segments is the same: half, as long as that is less. So long that slow errors of
# either average out: at four places of a long flight what followed was 1.5, 1.05 and 0.93 times as
# wrong as in one run after 10, 20 and 30 s.
OVERLAP_S = 30.
OVERLAP_SHARE = 0.5
# For the rate of a recording's pictures.
FIRST_PICTURES = 31
ORIENTATIONS = 'orientations.npz'
CHANGED = 'its pictures are not those that were tracked before: the recording has changed'


def stretches_of(
        path: Path, image_topic: str | None, split_s: float, join: str = NOT_JOINED
        ) -> list[Stretch]:
    """
    Return overlapping Stretches of about ``split_s`` seconds that make up a recording.

    Bags do not say how long they are: it is estimated. The last one has no end.
    """
    recording = open_recording(path, image_topic, join=join)
    times_ns = [frame.time_ns for frame in islice(recording.frames(), FIRST_PICTURES)]
    if recording.frame_count is None or len(times_ns) < 2:
        return [Stretch()]
    length_s = recording.frame_count * float(np.median(np.diff(times_ns))) / NS_PER_S
    bounds_s = np.linspace(0, length_s, 1 + max(1, round(length_s / split_s))).tolist()
    half_s = min(OVERLAP_S, OVERLAP_SHARE * split_s) / 2
    return [Stretch(max(0., start_s - half_s), end_s + half_s)
            for start_s, end_s in zip(bounds_s, (*bounds_s[1:-1], math.inf))]


def segment_tasks(task: Task, split_s: float) -> list[Task]:
    """Return the Tasks of a recording's segments; none where it is not split."""
    try:
        stretches = stretches_of(
            task.recording, task.args.image_topic, split_s, task.settings.config.join)
    except RecordingError:
        # Its own process tells the reason as well.
        return []
    return [replace(task, name=f'{task.name} [{number} of {len(stretches)}]', stretch=stretch,
                    identity={**task.identity, 'stretch': list(stretch)}, evaluate=False)
            for number, stretch in enumerate(stretches, 1) if len(stretches) > 1]


def is_done(segment: Task) -> bool:
    """Tell whether a segment was tracked before."""
    manifest = manifest_of(segment.result)
    return manifest is not None and manifest['identity'] == segment.identity


def failure_of(task: Task, segments: Sequence[Task], outcomes: Mapping[str, Outcome]
               ) -> Outcome | None:
    """Return why a recording has no result, where one of its segments has none."""
    for segment in segments:
        outcome = outcomes.get(segment.name)
        if outcome is not None and outcome.failed:
            return replace(outcome, name=task.name, line=f'{segment.name}: {outcome.line}')
    return None


def track_segment(task: Task, args: Namespace, progress: Progress) -> tuple[Summary, list[str]]:
    """Track a segment and write its orientations down; return what ``replay`` does."""
    assert task.stretch is not None
    args = Namespace(**{**vars(args), 'start': task.stretch.start_s, 'end': task.stretch.end_s,
                        'out': None, 'trajectory': None, 'report': None})
    # Only the orientations are asked for.
    settings = replace(task.settings, config=with_option(
        task.settings.config, 'smoothing.mode', LOCK))
    stamps_ns: list[int] = []
    orientations: list[TrackedOrientation] = []

    def keep(stabilized: StabilizedFrame) -> None:
        stamps_ns.append(stabilized.stamp_ns)
        orientations.append(TrackedOrientation(
            stabilized.R_world_camera, stabilized.status, stabilized.covariance))
    try:
        summary, lines = replay(args, settings, progress, [keep], task.video is not None)
    except EmptyStretch:
        if task.stretch.end_s < math.inf:
            raise
        # The recording is shorter than was thought.
        summary, lines = Summary(), ['no picture is left for it']
    if StabilizationEvent.RESIZED.value in summary.events:
        raise RecordingError('its pictures change their size, which --split cannot deal with')
    save(task.partial / ORIENTATIONS, Segment(np.array(stamps_ns, np.int64), orientations))
    return summary, lines


def join_tracked(task: Task, args: Namespace, progress: Progress) -> tuple[Summary, list[str]]:
    """Join what was tracked of segments and write the outputs; return what ``replay`` does."""
    segments = [load(folder / ORIENTATIONS) for folder in task.segments]
    try:
        joined = join_segments([segment for segment in segments if segment.orientations])
    except JoiningError as error:
        raise RecordingError(f'{error}: it cannot be split') from None
    if args.out or args.report:
        try:
            summary, lines = replay(
                args, task.settings, progress,
                known_tracker=lambda *_: KnownOrientations(joined.orientations))
        except StopIteration:
            raise RecordingError(CHANGED) from None
        if summary.frames < len(joined.orientations):
            raise RecordingError(CHANGED)
        return summary, lines
    rotations = Rotation.concatenate([one.R_world_camera for one in joined.orientations])
    write_tum(args.trajectory, Trajectory(joined.stamps_ns, rotations))
    summary = Summary(
        len(rotations), Counter(one.status.value for one in joined.orientations),
        turned_rad=float((rotations[:-1].inv() * rotations[1:]).magnitude().sum()),
        R_world_camera=rotations[-1])
    elapsed_s = 0.
    for manifest in filter(None, map(manifest_of, task.segments)):
        # Of overlaps twice.
        summary.events.update(manifest['events'])
        summary.left_out.update(manifest['left_out'])
        elapsed_s += manifest['cost']['elapsed_s']
    return summary, list(report(summary, task.settings.config, elapsed_s))


def save(path: Path, segment: Segment) -> None:
    """Write a Segment into a file of NumPy's."""
    orientations = segment.orientations
    np.savez(path, stamps_ns=segment.stamps_ns,
             quaternions=[one.R_world_camera.as_quat() for one in orientations],
             statuses=[one.status.value for one in orientations],
             covariances=[np.full((3, 3), np.nan) if one.covariance is None else one.covariance
                          for one in orientations])


def load(path: Path) -> Segment:
    """Return the Segment in a file that ``save`` has written."""
    with np.load(path) as file:
        columns = [file[name] for name in ('quaternions', 'statuses', 'covariances')]
        return Segment(file['stamps_ns'], [
            TrackedOrientation(Rotation.from_quat(quaternion), TrackingStatus(str(status)),
                               None if np.isnan(covariance).any() else covariance)
            for quaternion, status, covariance in zip(*columns)])
