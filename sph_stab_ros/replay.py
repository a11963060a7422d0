# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Stabilise a recording offline: a bag or video in, a trajectory and a bag or video out."""

# Before all that takes time to import.
if __name__ == '__main__':
    from sph_stab_ros.executable import start
    raise SystemExit(start('replay'))

from argparse import Namespace
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import replace
import os
from pathlib import Path
import re
import time
from typing import Any, TypeAlias

import numpy as np

from sph_stab_ros.command_line import (
    add_imu_topic, add_recording, check_stretch, frames_to_read, given, is_cut, one_line,
    open_given, Parser, run, told_once)
from sph_stab_ros.command_line.film import add_film, check_film, FILM_OPTIONS
from sph_stab_ros.command_line.optional_packages import see_that_figures_can_be_drawn
from sph_stab_ros.command_line.parameters import (
    add_calibration, add_parameters, add_shorthands, given_parameters, Parameters, SetParameters,
    settings_from, TRACKER_OPTIONS)
from sph_stab_ros.config import (
    ANCHORED, ConfigError, IMU, Settings, StabilizerConfig, VIEW, VIEW_NAME)
from sph_stab_ros.geometry.arrays import Image
from sph_stab_ros.images.appearance_watch import PictureWatch
from sph_stab_ros.images.side_by_side import side_by_side
from sph_stab_ros.recording import Recording, STANDARD_INPUT
from sph_stab_ros.recording.partial_output import partial_output
from sph_stab_ros.stabilization.film_directions import (
    DirectionPath, read_directions, recorded_directions)
from sph_stab_ros.stabilization.offline import looking_ahead, offline_stabilizer
from sph_stab_ros.stabilization.outputs import configured_camera, draw_sphere, draw_view
from sph_stab_ros.stabilization.pipeline import Stabilizer
from sph_stab_ros.stabilization.recorded_imu import find_imu_topic, RecordedImu
from sph_stab_ros.stabilization.recording_loop import (
    FrameProcessor, stabilize_recording, Summary)
from sph_stab_ros.stabilization.sinks import (
    bag_sink, Sink, stills_sink, trajectory_sink, video_sink)
from sph_stab_ros.stabilization.stabilized_frame import StabilizedFrame
from sph_stab_ros.tracking import make_tracker, MakeTracker

from tqdm import tqdm
from tqdm.contrib.logging import logging_redirect_tqdm

# Beside the node's parameters.
REPORTED_FLAGS = ('image_topic', 'imu_topic', 'start', 'end', 'max_frames', 'offline', 'view',
                  *FILM_OPTIONS)
VIDEO_SUFFIXES = ('.mp4', '.mov')
# Passes on frames, or what is left of them, of which so many are expected if that is known, and
# may tell of it.
Progress: TypeAlias = Callable[[Iterator[Any], int | None], Iterable[Any]]


def output_sinks(args: Namespace, settings: Settings, recording: Recording, stack: ExitStack
                 ) -> Iterator[Sink]:
    """Yield the sinks for OUT, and for what is written beside it."""
    if args.out.suffix not in VIDEO_SUFFIXES:
        yield bag_sink(args.out, args.force, stack, settings)
        return
    config = settings.config
    name = viewed(args.view) if args.view else config.views[0]
    camera = configured_camera(name, settings.views[name])
    directions = directions_of(args, recording)
    is_sphere = not (args.side_by_side or args.view or directions)

    def picture(s: StabilizedFrame) -> Image:
        if is_sphere:
            return draw_sphere(s, config)
        now = camera if directions is None else replace(
            camera, look=replace(camera.look, R_virtual_view=directions(s.frame)))
        return (side_by_side(s, now.look.R_virtual_view, now.look.hfov_rad) if args.side_by_side
                else draw_view(s, config, now))
    yield video_sink(args.out, args.force, stack, recording, not is_cut(args), picture, is_sphere,
                     args.encoding, args.hyperlapse or 1)
    if args.stills:
        yield stills_sink(args.out.with_name(f'{args.out.stem}_stills'), args.force, stack,
                          args.stills, picture)


def directions_of(args: Namespace, recording: Recording) -> DirectionPath | None:
    """Return where the view looks, None where it does not turn."""
    if args.directions is None:
        return None
    if args.direction_path is not None:
        return DirectionPath(args.direction_path)
    return DirectionPath(recorded_directions(recording, args.directions), by_clock=True)


def report(summary: Summary, config: StabilizerConfig, elapsed_s: float) -> Iterator[str]:
    """Yield the lines that tell of a replay; the drift of a chain is named."""
    tracker = config.tracker
    counts = ', '.join(f'{n} {status}' for status, n in summary.statuses.items())
    yield (f'{summary.frames} frames in {elapsed_s:.1f} s '
           f'({summary.frames / elapsed_s:.1f} frames/s): {counts}')
    for counted in (summary.events, summary.left_out):
        for what, n in counted.items():
            yield f'{n}x {what}'
    assert summary.R_world_camera is not None
    turned = (f'{np.rad2deg(summary.turned_rad):.0f} deg of turning in all, '
              f'{np.rad2deg(summary.R_world_camera.magnitude()):.1f} deg from the first frame to '
              'the last')
    if tracker.estimator == ANCHORED:
        yield f'orientation anchored to keyframes: {turned}'
    else:
        yield (f'orientation chained over {summary.frames - 1} steps by {tracker.estimator}: '
               f'{turned}; the errors of all steps add up, so a slow drift is part of it')


def viewed(text: str) -> str:
    """Return the name of the view that an argument ``NAME`` or ``YAW,PITCH,ROLL,HFOV`` means."""
    return text if re.fullmatch(VIEW_NAME, text) else VIEW


def view_argument(text: str, flag: str) -> Parameters:
    """Return the Parameters of ``YAW,PITCH,ROLL,HFOV`` in degrees, none of a view's name."""
    if re.fullmatch(VIEW_NAME, text):
        return {}
    names = ('yaw_deg', 'pitch_deg', 'roll_deg', 'hfov_deg')
    try:
        return {f'{VIEW}.{name}': (flag, float(value))
                for name, value in zip(names, text.split(','), strict=True)}
    except ValueError:
        raise ConfigError(f"'{text}' is neither YAW,PITCH,ROLL,HFOV in degrees nor the name of a "
                          'view') from None


def smoothing_argument(text: str, flag: str) -> Parameters:
    """Return the Parameters of ``MODE`` or ``MODE:SECONDS``."""
    mode, colon, seconds = text.partition(':')
    try:
        return {'smoothing.mode': (flag, mode)} | (
            {'smoothing.time_constant_s': (flag, float(seconds))} if colon else {})
    except ValueError:
        raise ConfigError(f"'{seconds}' is not a number of seconds") from None


def add_options(parser: Parser) -> None:
    """Add arguments for how a recording is stabilised, whichever it is."""
    add_imu_topic(parser)
    parser.add_argument('--offline', action='store_true',
                        help='as good as can be, by what comes later too, instead of as the node '
                        'does it')
    add_film(parser)
    group = add_parameters(
        parser, 'All count as in the node but those of topics and of steering')
    group.add_argument('--view', metavar='YAW,PITCH,ROLL,HFOV', action=SetParameters,
                       read=view_argument,
                       help='where the perspective view looks, in degrees (--view=-30,0,0,90: '
                       'with = before a minus), or the name of one of the views; a video shows '
                       'it instead of the sphere')
    group.add_argument('--smoothing', metavar='MODE[:SECONDS]', action=SetParameters,
                       read=smoothing_argument,
                       help='lock keeps nothing of the turning, follow slow turns, yaw_follow '
                       'slow turns of heading, with this time constant (default: lock)')
    add_shorthands(group, ('projection', 'layout', 'join'))
    add_calibration(group)
    add_shorthands(group, TRACKER_OPTIONS)


def given_settings(parser: Parser, args: Namespace) -> Settings:
    """Return the Settings of a parsed command line; exit 2 on a usage error."""
    settings = settings_from(parser, given_parameters(parser, args))
    if args.view and viewed(args.view) not in settings.views:
        parser.error(f"--view: '{viewed(args.view)}' is none of the views: "
                     f'{", ".join(settings.views)}')
    args.direction_path = None
    if args.directions and args.directions.endswith(('.yaml', '.yml')):
        try:
            args.direction_path = read_directions(Path(args.directions))
        except ConfigError as error:
            parser.error(f'--directions: {error}')
    if args.offline and settings.config.tracker.estimator != ANCHORED:
        parser.error(f"--offline needs the estimator '{ANCHORED}'")
    return settings


def arguments(argv: Sequence[str] | None) -> tuple[Namespace, Settings]:
    """Return the parsed command line and the Settings; exit 2 on a usage error."""
    parser = Parser(prog='replay', description=__doc__)
    add_recording(parser, 'IN')
    parser.add_argument('out', metavar='OUT', type=Path, nargs='?',
                        help='rosbag2 folder, .mp4 or .mov; nothing is warped without it')
    parser.add_argument('--trajectory', metavar='FILE.tum', type=Path,
                        help='write "stamp 0 0 0 qx qy qz qw" of each picture')
    parser.add_argument('--report', metavar='FILE.html', type=Path,
                        help='write what happened with figures and pictures, in one file')
    parser.add_argument('--force', action='store_true', help='replace existing outputs')
    add_options(parser)
    # OUT may stand behind options too.
    args = parser.parse_in_any_order(argv)
    if args.out is None and args.view:
        parser.error('--view needs OUT')
    if args.out is not None and args.out.suffix not in ('', *VIDEO_SUFFIXES):
        parser.error(f"OUT is a folder for a bag, or ends in .mp4 or .mov: not '{args.out}'")
    check_film(parser, args, args.out is not None and bool(args.out.suffix),
               'an .mp4 or .mov as OUT')
    check_stretch(parser, args)
    if args.offline and (args.recording == STANDARD_INPUT or args.recording.is_fifo()):
        parser.error('--offline reads twice, which a pipe cannot be')
    recording, *outputs = (Path(os.path.realpath(path)) for path in (
        args.recording, args.out, args.trajectory, args.report) if path)
    if len({recording, *outputs}) <= len(outputs):
        parser.error('IN, OUT, --trajectory and --report must be different files')
    if any(output in recording.parents for output in outputs):
        parser.error('IN must not be in the folder OUT, which is replaced as a whole')
    return args, given_settings(parser, args)


def replay(args: Namespace, settings: Settings, progress: Progress, sinks: Sequence[Sink] = (),
           pictures: bool = False, known_tracker: MakeTracker | None = None
           ) -> tuple[Summary, list[str]]:
    """
    Do what a parsed command line says; return the Summary, and lines that tell of it.

    ``sinks`` take in the frames besides, with ``pictures`` or not. Where the orientations are
    known already, a ``known_tracker`` tells them.
    """
    if args.report is None:
        return write_outputs(args, settings, progress, sinks, pictures, known_tracker)
    see_that_figures_can_be_drawn('--report')
    from sph_stab_ros.evaluation.replay_log import ReplayLog
    from sph_stab_ros.evaluation.replay_report import page
    with partial_output(args.report, args.force) as path:
        log = ReplayLog()
        summary, lines = write_outputs(
            args, settings, progress, [*sinks, log], True, known_tracker)
        flags = {f'--{name.replace("_", "-")}': value
                 for name, value in given(args, REPORTED_FLAGS).items()}
        path.write_text(page(one_line(args.recording.name), log, lines, settings, flags), 'utf-8')
    return summary, lines


def write_outputs(args: Namespace, settings: Settings, progress: Progress, sinks: Sequence[Sink],
                  pictures: bool, known_tracker: MakeTracker | None
                  ) -> tuple[Summary, list[str]]:
    """Do what ``replay`` does, but for its report."""
    config = settings.config
    recording = open_given(args, config.join)
    imu_topic = find_imu_topic(recording, args.imu_topic) if config.level == IMU else None
    total = frames_to_read(recording, args.max_frames)
    start_s = time.perf_counter()

    def read(processor: FrameProcessor, sinks: Sequence[Sink] = (),
             watch: PictureWatch | None = None) -> tuple[Summary, RecordedImu | None]:
        imu = RecordedImu(recording, imu_topic) if imu_topic else None
        return stabilize_recording(
            recording, processor, sinks, args.max_frames, lambda frames: progress(frames, total),
            # Each time, so that all readings leave out the same.
            imu, pictures=pictures or args.out is not None, watch=watch), imu

    with ExitStack() as stack:
        sinks = [*sinks]
        if args.trajectory:
            sinks.append(trajectory_sink(args.trajectory, args.force, stack))
        if args.out:
            sinks.extend(output_sinks(args, settings, recording, stack))
        if args.offline:
            # What one reading has told of the next ones need not tell again.
            stack.enter_context(told_once())
        stabilizer = (
            Stabilizer(config, known_tracker or make_tracker) if not args.offline else
            looking_ahead(config, read, known_tracker) if known_tracker else
            offline_stabilizer(config, read, progress))
        summary, imu = read(stabilizer, sinks, PictureWatch(config))
    lines = list(report(summary, config, time.perf_counter() - start_s))
    if args.out and args.out.suffix and summary.colour and summary.colour.assumed:
        lines.append(f'colours are taken to be of {summary.colour.assumed}: no tag says so')
    if imu is not None:
        lines.append(
            f'levelled by {imu.samples} samples of {imu.topic}, {imu.refused} left out')
    return summary, lines


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit status."""
    args, settings = arguments(argv)

    def command() -> None:
        with logging_redirect_tqdm():
            # Shown on terminals only.
            _, lines = replay(args, settings, lambda frames, total: tqdm(
                frames, total=total, unit=' frames', disable=None))
        for line in lines:
            print(line)

    return run('replay', command)
