# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""
The process in which one recording, or a segment of it, is stabilised.

Its task is on stdin, on stdout are lines of JSON.
"""

from argparse import Namespace
from collections.abc import Iterable, Iterator
from datetime import datetime, timezone
import json
import logging
import os
from pathlib import Path
import pickle
import resource
import socket
import sys
import time
from typing import Any, IO

import cv2

from sph_stab_ros.batch.results import (
    BAG, EVALUATION, MANIFEST, manifest_of, publish, REPORT, TRAJECTORY, VIDEO,
    write_json)
from sph_stab_ros.batch.segments import join_tracked, track_segment
from sph_stab_ros.batch.tasks import Task
from sph_stab_ros.command_line import is_out_of_memory
from sph_stab_ros.command_line.process_setup import set_up_process
from sph_stab_ros.evaluation.alignment import align_trajectories, EvaluationError
from sph_stab_ros.evaluation.ground_truth import find_truth_topic, read_truth
from sph_stab_ros.evaluation.orientation_errors import compare
from sph_stab_ros.evaluation.report import Figures
from sph_stab_ros.geometry.trajectory import read_tum
from sph_stab_ros.images.frame import Frame
from sph_stab_ros.recording import open_recording, RecordingError
from sph_stab_ros.replay import replay

PROGRESS_S = 1.


class Abandoned(Exception):
    """Nobody waits for the result any more."""


class Warnings(logging.Handler):
    """Keeps what the library warns of, for the manifest."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.lines: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        """Keep a line."""
        self.lines.append(record.getMessage())


def bound(task: Task) -> None:
    """Keep the process within its cores and its memory."""
    if task.cores:
        os.sched_setaffinity(0, task.cores)
    # More processes at once are better than more threads in each.
    cv2.setNumThreads(1)
    set_up_process()
    resource.setrlimit(resource.RLIMIT_DATA, 2 * (task.memory_mb * 2**20,))


def work(task: Task, channel: IO[str]) -> str:
    """Do the task; return a line that tells of it."""
    if not task.track:
        evaluate(task, task.result)
        return 'evaluated'
    warnings = Warnings()
    logging.getLogger().addHandler(warnings)
    partial = task.partial
    out = None if task.video is None else partial / (VIDEO if task.video else BAG)
    args = Namespace(**{**vars(task.args), 'recording': task.recording, 'out': out,
                        'trajectory': partial / TRAJECTORY, 'force': False,
                        'report': partial / REPORT if task.args.report else None})

    def progress(frames: Iterator[Frame], total: int | None) -> Iterable[Frame]:
        said_s = 0.
        for count, frame in enumerate(frames):
            if time.monotonic() > said_s + PROGRESS_S:
                said_s = time.monotonic()
                if not partial.is_dir():
                    raise Abandoned
                say(channel, frames=count, total=total)
            yield frame

    start_s = time.perf_counter()
    if task.stretch is not None:
        summary, lines = track_segment(task, args, progress)
    elif task.segments:
        summary, lines = join_tracked(task, args, progress)
    else:
        summary, lines = replay(args, task.settings, progress)
    elapsed_s = time.perf_counter() - start_s
    if task.evaluate:
        evaluate(task, partial)
    outputs = {path.relative_to(partial).as_posix(): path.stat().st_size
               for path in sorted(partial.rglob('*'))
               if path.is_file() and path.name != EVALUATION}
    before = [manifest for manifest in map(manifest_of, task.segments) if manifest]
    said = (line for manifest in before for line in manifest['warnings'])
    write_json(partial / MANIFEST, {
        'identity': task.identity, 'recording': str(task.recording), 'outputs': outputs,
        'frames': summary.frames, 'statuses': summary.statuses, 'events': summary.events,
        'left_out': summary.left_out, 'report': lines,
        'warnings': [*dict.fromkeys((*said, *warnings.lines))],
        'cost': cost(elapsed_s),
        **({'segments': [manifest['cost'] for manifest in before]} if before else {}),
        'host': socket.gethostname(),
        'finished': datetime.now(timezone.utc).isoformat(timespec='seconds')})
    publish(partial, task.result, task.identity)
    return lines[0]


def cost(elapsed_s: float) -> dict[str, float]:
    """Return what this process has used."""
    used = resource.getrusage(resource.RUSAGE_SELF)
    return {'elapsed_s': round(elapsed_s, 2),
            'cpu_s': round(used.ru_utime + used.ru_stime, 2),
            'peak_rss_mb': round(used.ru_maxrss / 1024, 1)}


def evaluate(task: Task, result: Path) -> None:
    """Write how a trajectory compares with the recording's truth, or why it does not."""
    write_json(result / EVALUATION, figures_of(task, result / TRAJECTORY))


def figures_of(task: Task, trajectory: Path) -> Figures:
    """Return the figures as ``evaluate`` has them, but those of time, or a reason."""
    recording = open_recording(
        task.recording, task.args.image_topic, join=task.settings.config.join)
    try:
        topic = find_truth_topic(recording)
    except RecordingError as error:
        return {'no_truth': str(error)}
    try:
        truth, estimate = read_truth(recording, topic), read_tum(trajectory)
        alignment = align_trajectories(truth, estimate, None, 0)
        return {'truth': topic, **compare(truth, estimate, alignment).summary()}
    except (EvaluationError, RecordingError, ValueError) as error:
        return {'error': str(error)}


def say(channel: IO[str], **what: Any) -> None:
    """Write a line to whoever has started this process."""
    channel.write(json.dumps(what) + '\n')
    channel.flush()


def main() -> int:
    """Do one task; return the exit status, which is 0 where it has failed but that was said."""
    channel = os.fdopen(os.dup(sys.stdout.fileno()), 'w')
    # Whatever libraries print is not for the channel.
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    task: Task = pickle.loads(bytes.fromhex(sys.stdin.read()))
    try:
        bound(task)
        said: dict[str, Any] = {'line': work(task, channel)}
    except (Abandoned, BrokenPipeError):
        return 1
    except RecordingError as error:
        # Of the system's errors the next attempt may be free.
        said = {'line': str(error), 'failed': True,
                'lasting': not isinstance(error.__cause__, OSError)}
    except Exception as error:
        # Whatever one recording does to a library must not end the others.
        said = {'line': f'{type(error).__name__}: {" ".join(str(error).split())}', 'failed': True}
        if is_out_of_memory(error):
            said['line'] = f'it needs more memory than {task.memory_mb} MB (--memory-mb)'
    say(channel, **said)
    return 0


if __name__ == '__main__':
    sys.exit(main())
