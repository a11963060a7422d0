# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Evaluate estimators against a recording's truth, or against rotations injected into it."""

# Before all that takes time to import.
if __name__ == '__main__':
    from sph_stab_ros.executable import start
    raise SystemExit(start('evaluate'))

from argparse import Namespace
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from itertools import product
import json
import logging
from typing import TypeAlias

import numpy as np
from sph_stab_ros.command_line import (
    add_imu_topic, add_recording, check_stretch, frames_to_read, open_given, Parser, run)
from sph_stab_ros.command_line.arguments import (
    file_argument, names_argument, output_argument, period_argument, whole_number)
from sph_stab_ros.command_line.optional_packages import see_that_figures_can_be_drawn
from sph_stab_ros.command_line.parameters import (
    add_calibration, add_parameters, add_shorthands, given_parameters, refuse_bad_mask,
    settings_from, TRACKER_OPTIONS)
from sph_stab_ros.config import (
    ANCHORED, AUTO, EQUIRECT, FLOWS, IMU, METHODS, MIN_WIDTH, StabilizerConfig)
from sph_stab_ros.evaluation import report
from sph_stab_ros.evaluation.alignment import Alignment, EvaluationError
from sph_stab_ros.evaluation.arguments import clock_argument, frames_argument, mount_argument
from sph_stab_ros.evaluation.ground_truth import find_truth_topic, read_truth
from sph_stab_ros.evaluation.orientation_errors import Errors
from sph_stab_ros.evaluation.output_folders import draw, make_folder, write_trajectories
from sph_stab_ros.evaluation.report import Figures
from sph_stab_ros.evaluation.runs import evaluate_against_truth, evaluate_injected, Progress
from sph_stab_ros.evaluation.stitched import Stitched
from sph_stab_ros.evaluation.telemetry_truth import is_of_gyro
from sph_stab_ros.geometry.masks import load_mask, MaskError
from sph_stab_ros.images.appearance_watch import PictureWatch
from sph_stab_ros.images.frame import Frame
from sph_stab_ros.recording import Recording, RecordingError
from sph_stab_ros.recording.partial_output import partial_output
from sph_stab_ros.stabilization.recorded_imu import find_imu_topic

from tqdm import tqdm
from tqdm.contrib.logging import logging_redirect_tqdm

logger = logging.getLogger(__name__)

ESTIMATORS = (ANCHORED, *METHODS)
WITHOUT_FLOW = (ANCHORED, 'pts')
# Turns of truth and estimate that differ by more do not belong together.
MAX_RESIDUAL_RATIO = 1 / 3
MIN_DOUBTED_RAD = np.deg2rad(1)
# A day at 60 frames a second: what is said to be longer is not known.
MOST_INJECTED = 24 * 3600 * 60

# By the name of the estimator, or of estimator and flow.
Configs: TypeAlias = Mapping[str, StabilizerConfig]
# What to say about the truth; errors and figures by the same names.
Evaluation: TypeAlias = tuple[Figures, dict[str, Errors], dict[str, Figures]]


def evaluate(args: Namespace, configs: Configs) -> None:
    """Do what the command line says."""
    config = next(iter(configs.values()))
    recording = open_given(args, config.join)
    watch = PictureWatch(config)
    spheres = Stitched(recording, config, watch)
    frames = frames_to_read(recording, args.max_frames)
    if args.plots:
        make_folder(args.plots)
        see_that_figures_can_be_drawn('--plots')
    if args.tum:
        make_folder(args.tum)

    def progress(name: str, pictures: Iterator[Frame]) -> Iterable[Frame]:
        # Shown on terminals only.
        return tqdm(pictures, name, frames, unit=' frames', disable=None)

    with ExitStack() as stack:
        if args.json:
            file = stack.enter_context(partial_output(args.json, force=True))
        stack.enter_context(logging_redirect_tqdm())
        if args.inject is None:
            about, errors, figures = by_truth(args, recording, configs, progress, watch)
        else:
            about, errors, figures = by_injection(args, spheres, configs, frames, progress)
        if args.every:
            for name, estimator_errors in errors.items():
                figures[name]['over_time'] = estimator_errors.over_time(args.every)
        for line in report.error_lines(figures, of_gyro='gyro_bias_deg_s' in about):
            print(line)
        if args.json:
            file.write_text(json.dumps(
                {'recording': recording.name, **about, 'estimators': figures}, indent=2) + '\n')
    if args.tum:
        write_trajectories(args.tum, errors)
    if args.plots:
        draw(args.plots, spheres, errors)


def by_truth(args: Namespace, recording: Recording, configs: Configs,
             progress: Progress, watch: PictureWatch) -> Evaluation:
    """Return what to say about the alignment, and Errors and figures by estimator."""
    topic = args.truth or find_truth_topic(recording, args.truth_frames)
    levelled = any(config.level == IMU for config in configs.values())
    imu_topic = find_imu_topic(recording, args.imu_topic) if levelled else None
    truth = read_truth(recording, topic, args.truth_frames)
    clock_offset = args.clock_offset
    if clock_offset is None:
        # A camera's sensors have clocks of their own.
        clock_offset = 0 if recording.telemetry is None else AUTO
    alignment, errors, figures = evaluate_against_truth(
        recording, configs, truth, args.mount, None if clock_offset == AUTO else clock_offset,
        args.max_frames, progress, imu_topic, watch, args.offline, is_of_gyro(recording))
    about = {'truth': topic, **report.describe(alignment, args.mount is not None)}
    of_frames = ''
    if args.truth_frames:
        about['truth_frames'] = ':'.join(args.truth_frames)
        of_frames = f', {about["truth_frames"]}'
    print(f'{recording.name}: {len(truth)} true orientations in {topic}{of_frames}')
    for line in report.alignment_lines(about, clock_offset == AUTO):
        print(line)
    warn(recording.name, alignment)
    return about, errors, figures


def by_injection(args: Namespace, spheres: Stitched, configs: Configs, frames: int | None,
                 progress: Progress) -> Evaluation:
    """Return what to say about the injection, and Errors and figures by estimator."""
    if frames is None or frames > MOST_INJECTED:
        raise EvaluationError('unknown length, add --max-frames N')
    if frames < 2:
        raise EvaluationError('--inject needs two frames or more')
    if not spheres.shows_all():
        # The edge of what is seen would turn with the world, and be tracked.
        raise EvaluationError('--inject needs pictures of the whole sphere')
    mask = next(iter(configs.values())).tracker.mask
    # What they are is the Stitched frames' own.
    configs = {name: replace(config, projection=EQUIRECT, layout=AUTO)
               for name, config in configs.items()}
    errors, figures = evaluate_injected(
        spheres, configs, args.inject, frames, args.body, progress, args.offline)
    about = {'injected_seed': args.inject, 'body': args.body, 'mask': mask}
    print(f'{spheres.name}: ' + report.injection_line(about, figures))
    return about, errors, figures


def warn(name: str, alignment: Alignment) -> None:
    """Say so if truth and estimate do not turn alike."""
    if alignment.residual_rad > max(MAX_RESIDUAL_RATIO * alignment.turn_rad, MIN_DOUBTED_RAD):
        residual_deg, turn_deg = np.rad2deg((alignment.residual_rad, alignment.turn_rad))
        logger.warning(
            '%s: truth and the best estimate turn differently, by %.1f of %.1f deg in a second; '
            'the wrong topic, clock, mount or convention?', name, residual_deg, turn_deg)


def command_line() -> Parser:
    """Return the parser of the command line."""
    parser = Parser(prog='evaluate', description=__doc__)
    add_recording(parser, 'REC')
    parser.add_argument('--estimators', metavar='A,B,...', type=names_argument(ESTIMATORS),
                        help=f'of {", ".join(ESTIMATORS)} (default: what the parameters say, or '
                        'all)')
    parser.add_argument('--flows', metavar='A,B', type=names_argument(FLOWS),
                        help=f'each estimator with each of {", ".join(FLOWS)} '
                        "(default: the parameters')")
    parser.add_argument('--offline', action='store_true',
                        help=f'measure {ANCHORED} as replay --offline has it, too')
    parser.add_argument('--truth', metavar='TOPIC',
                        help='PoseStamped, PoseWithCovarianceStamped, QuaternionStamped, '
                        'TransformStamped, Odometry, Imu, Path or TFMessage, or "telemetry": '
                        "what the camera's own sensors measured, in the metadata of a video "
                        '(default: the topic there is)')
    parser.add_argument('--truth-frames', metavar='PARENT:CHILD', type=frames_argument,
                        help='which transform of a TFMessage topic is the truth: from the frame '
                        'of the world to that of the body')
    parser.add_argument('--mount', metavar='YAW,PITCH,ROLL', type=mount_argument,
                        help="where the camera looks on the truth's body, in degrees to the left, "
                        'up, clockwise, or as a quaternion x,y,z,w of the optical frame; '
                        '--mount=-30,0,0 with = before a minus (default: solved for)')
    parser.add_argument('--clock-offset', metavar='auto|SECONDS', type=clock_argument,
                        help="the truth's stamps minus the images' (default: 0, of telemetry "
                        'auto)')
    parser.add_argument('--inject', metavar='SEED', type=whole_number(0),
                        help='instead of a truth: turn the footage by known rotations, drawn with '
                        'this seed')
    parser.add_argument('--body', metavar='MASK',
                        help='with --inject, what is fixed to the camera and does not turn with '
                        'the world, written as --mask is (default: what that leaves out)')
    parser.add_argument('--every', metavar='SECONDS', type=period_argument,
                        help='tell the error at every so many seconds, too')
    parser.add_argument('--json', metavar='FILE', type=file_argument,
                        help='write the figures, replacing the file')
    parser.add_argument('--tum', metavar='DIR', type=output_argument,
                        help='write truth and estimates relative to the first frame into a '
                        'folder as TUM files, truth.tum and ESTIMATOR.tum')
    parser.add_argument('--plots', metavar='DIR', type=output_argument,
                        help='draw figures into a folder')
    add_imu_topic(parser)
    group = add_parameters(parser, 'Those of estimator, projection, level and IMU count')
    add_shorthands(group, ('projection', 'layout', 'join'))
    add_calibration(group)
    add_shorthands(group, (name for name in TRACKER_OPTIONS if name not in ('estimator', 'flow')))
    return parser


def arguments(argv: Sequence[str] | None) -> tuple[Namespace, Configs]:
    """Return the parsed command line and StabilizerConfigs by name; exit 2 on a usage error."""
    parser = command_line()
    args = parser.parse_args(argv)
    check_stretch(parser, args)
    parameters = given_parameters(parser, args)
    config = settings_from(parser, parameters).config
    if args.inject is not None:
        if (args.truth or args.truth_frames or args.mount is not None
                or args.clock_offset is not None
                or args.tum):
            parser.error('--inject needs no --truth, --mount, --clock-offset or --tum')
        args.body = config.tracker.mask if args.body is None else args.body
        try:
            load_mask(args.body, MIN_WIDTH)
        except MaskError as error:
            parser.error(f'--body: {error}')
        if config.level == IMU:
            parser.error('--inject turns the pictures but no IMU: add -p level:=first_frame')
    elif args.body:
        parser.error('--body needs --inject')
    if args.estimators is None:
        args.estimators = [config.tracker.estimator] if 'estimator' in parameters else ESTIMATORS
    configs = {}
    for estimator, flow in product(args.estimators, args.flows or [config.tracker.flow]):
        name = f'{estimator}/{flow}' if args.flows and estimator not in WITHOUT_FLOW else estimator
        tracker = replace(config.tracker, estimator=estimator, flow=flow)
        # Estimators work on pictures of different widths.
        refuse_bad_mask(parser, parameters, tracker)
        configs[name] = replace(config, tracker=tracker)
    if args.offline and ANCHORED not in configs:
        parser.error(f"--offline needs the estimator '{ANCHORED}'")
    # The names of these.
    args.offline = [f'{ANCHORED}/offline'] if args.offline else []
    configs |= {name: configs[ANCHORED] for name in args.offline}
    return args, configs


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit status."""
    args, configs = arguments(argv)

    def command() -> None:
        try:
            evaluate(args, configs)
        except EvaluationError as error:
            raise RecordingError(f'{args.recording.name}: {error}') from error

    return run('evaluate', command)
