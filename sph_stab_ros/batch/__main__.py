# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Stabilise many recordings, here or on a cluster; after any end the same call goes on."""

# Before all that takes time to import.
if __name__ == '__main__':
    from sph_stab_ros.executable import start
    raise SystemExit(start('batch.__main__'))

from argparse import Namespace
from collections.abc import Sequence
from contextlib import closing
from dataclasses import replace
import math
from pathlib import Path
import sys

from sph_stab_ros.batch.cluster import run_on_cluster
from sph_stab_ros.batch.discovery import find_recordings
from sph_stab_ros.batch.local import most_jobs, run_here
from sph_stab_ros.batch.plan import (
    Entry, EVALUATE, FAILED, make_plan, note_failures, plan_lines)
from sph_stab_ros.batch.progress import ProgressLines
from sph_stab_ros.batch.results import clear, options_of, results_folder, SEGMENTS
from sph_stab_ros.batch.segments import failure_of, is_done, segment_tasks
from sph_stab_ros.batch.tables import evaluation_lines, failure_lines
from sph_stab_ros.batch.tasks import Outcome, Task
from sph_stab_ros.command_line import add_selection, check_stretch, given, Parser, run
from sph_stab_ros.command_line.arguments import whole_number
from sph_stab_ros.command_line.film import check_film, FILM_OPTIONS
from sph_stab_ros.config import ANCHORED, IMU, Settings
from sph_stab_ros.config.options import with_option
from sph_stab_ros.recording import RecordingError
from sph_stab_ros.replay import add_options, given_settings

# Whether a video is written, or a bag, or neither.
WRITTEN = {'mp4': True, 'bag': False, 'trajectory': None}
# Parts of what a result is of where they are given.
OTHER_OPTIONS = ('start', 'end', 'offline', 'report', 'split', 'direction_path', *FILM_OPTIONS)
# More than a replay takes of pictures 3840 wide, see docs/scale.md.
MEMORY_MB = 2000
MIN_MEMORY_MB = 500
# Half of it is the overlap, of which the tracker needs a part to begin.
MIN_SPLIT_S = 10


def batch(args: Namespace, settings: Settings) -> None:
    """Do what the command line says; RecordingError where recordings have failed."""
    recordings = find_recordings(args.inputs, args.out)
    options = options_of(settings, {name: getattr(args, name) for name in (
        'write', 'image_topic', 'imu_topic', 'max_frames', 'side_by_side', 'view')}
        # So that results of those who know of no other way are still the same.
        | given(args, OTHER_OPTIONS))
    entries = list(make_plan(recordings, args.out, options, evaluate=args.evaluate,
                             force=args.force, retry=args.retry))
    for line in plan_lines(entries, args.out):
        print(line, flush=True)
    failures = {entry.found.name: entry.note for entry in entries if entry.state == FAILED}
    if not args.dry_run:
        with results_folder(args.out):
            outcomes = execute(entries, args, settings)
            if args.evaluate:
                for line in evaluation_lines(args.out, [name for name, _ in recordings]):
                    print(line)
        failures |= {name: outcome.line for name, outcome in outcomes.items() if outcome.failed}
    for line in failure_lines(failures):
        print(line)
    sys.stdout.flush()
    if failures and not args.dry_run:
        raise RecordingError(f'{len(failures)} of {len(entries)} recordings have no result')


def execute(entries: Sequence[Entry], args: Namespace, settings: Settings) -> dict[str, Outcome]:
    """Do what is to be done; return how each has ended, by name."""
    tasks = [task_of(entry, args, settings) for entry in entries if entry.is_work]
    segments = {task.name: segment_tasks(task, args.split) for task in tasks
                if args.split and task.track}
    outcomes: dict[str, Outcome] = {}
    try:
        run_tasks([one for task in tasks for one in segments.get(task.name) or [task]
                   if one is task or not is_done(one)], args, outcomes)
        joining = []
        for task in tasks:
            if parts := segments.get(task.name):
                if failure := failure_of(task, parts, outcomes):
                    outcomes[task.name] = failure
                else:
                    joining.append(replace(task, segments=tuple(one.result for one in parts)))
        run_tasks(joining, args, outcomes)
    except KeyboardInterrupt:
        done = sum(not outcomes[task.name].failed for task in tasks if task.name in outcomes)
        raise RecordingError(f'interrupted, {done} of {len(tasks)} are done; the same call goes '
                             'on with the others') from None
    finally:
        outcomes = {task.name: outcomes[task.name] for task in tasks if task.name in outcomes}
        clear(args.out)
        if len(outcomes) == len(tasks) and not any(one.failed for one in outcomes.values()):
            clear(args.out, SEGMENTS)
        note_failures(args.out, entries, outcomes)
    return outcomes


def run_tasks(tasks: Sequence[Task], args: Namespace, outcomes: dict[str, Outcome]) -> None:
    """Do tasks, here or on a cluster; note how each has ended, by name."""
    if not tasks:
        return
    events = (run_on_cluster(tasks, args.scheduler) if args.scheduler else
              run_here(tasks, args.jobs or most_jobs(args.memory_mb)))
    with closing(events), ProgressLines(len(tasks)) as lines:
        for event in events:
            lines.show(event)
            if isinstance(event, Outcome):
                outcomes[event.name] = event


def task_of(entry: Entry, args: Namespace, settings: Settings) -> Task:
    """Return what a process needs to know."""
    return Task(entry.found.name, entry.found.path, args.out, entry.identity, args, settings,
                WRITTEN[args.write], args.evaluate, entry.state != EVALUATE, args.memory_mb)


def arguments(argv: Sequence[str] | None) -> tuple[Namespace, Settings]:
    """Return the parsed command line and the Settings; exit 2 on a usage error."""
    parser = Parser(prog='batch', description=__doc__)
    parser.add_argument('inputs', metavar='IN', type=Path, nargs='+',
                        help='a recording, or a folder that is searched for them')
    parser.add_argument('--out', metavar='DIR', type=Path, required=True,
                        help='where each recording gets a folder for its result')
    parser.add_argument('--write', choices=WRITTEN, default='mp4',
                        help='the stabilised video, a bag, or nothing besides the trajectory '
                        '(default: mp4)')
    parser.add_argument('--report', action='store_true',
                        help='a page for each as by replay --report')
    parser.add_argument('--dry-run', action='store_true', help='show the plan only')
    parser.add_argument('--evaluate', action='store_true',
                        help='one table over all recordings that have truth')
    parser.add_argument('--jobs', metavar='N', type=whole_number(1),
                        help='how many at once, on as many cores (default: as many as there are '
                        'cores, and memory for)')
    parser.add_argument('--memory-mb', metavar='MB', default=MEMORY_MB,
                        type=whole_number(MIN_MEMORY_MB),
                        help=f'what each may take (default: {MEMORY_MB})')
    parser.add_argument('--scheduler', metavar='tcp://HOST:PORT',
                        help='have it done by the workers of this Dask cluster, to which files '
                        'have the same paths as here')
    parser.add_argument('--split', metavar='SECONDS', type=whole_number(MIN_SPLIT_S),
                        help='track longer recordings in overlapping segments of about this '
                        'length, each of which is a task, and join these')
    parser.add_argument('--force', action='store_true',
                        help='replace results of other contents, options or versions')
    parser.add_argument('--retry', action='store_true',
                        help='try what has failed because of the recording itself again')
    add_selection(parser)
    add_options(parser)
    args = parser.parse_args(argv)
    check_stretch(parser, args)
    if args.scheduler and args.jobs:
        parser.error('--jobs is for this machine; a cluster has the workers that it has')
    check_film(parser, args, args.write == 'mp4', '--write mp4')
    if args.view and args.write == 'trajectory':
        parser.error('--view needs --write mp4 or bag')
    settings = given_settings(parser, args)
    if args.split:
        check_split(parser, args, settings)
    # Whoever does it may stand in another folder, or see no file of parameters.
    args.out = args.out.absolute()
    args.params_file, args.parameters = [], {}
    mask = Path(settings.config.tracker.mask)
    if mask.is_file():
        settings = replace(settings, config=with_option(
            settings.config, 'tracker.mask', str(mask.absolute())))
    return args, settings


def check_split(parser: Parser, args: Namespace, settings: Settings) -> None:
    """Exit 2 where segments could not be joined."""
    if settings.config.tracker.estimator != ANCHORED or settings.config.level == IMU:
        parser.error(f"--split needs the estimator '{ANCHORED}', and no level:={IMU}")
    if args.max_frames or args.start or args.end < math.inf:
        parser.error('--split is of whole recordings: without --start, --end and --max-frames')


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit status."""
    args, settings = arguments(argv)
    return run('batch', lambda: batch(args, settings))
