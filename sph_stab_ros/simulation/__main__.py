# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Simulate a flight and write it as a recording with exact truth."""

from argparse import Namespace
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
import sys
from typing import Any

from sph_stab_ros.command_line import Parser, run
from sph_stab_ros.command_line.arguments import whole_number
from sph_stab_ros.geometry.arrays import Image
from sph_stab_ros.geometry.conventions import R_BODY_CAMERA
from sph_stab_ros.recording import RecordingError
from sph_stab_ros.simulation import company, flights
from sph_stab_ros.simulation.flights import Flight
from sph_stab_ros.simulation.recordings import R_CAMERA_MARKERS, read_frames, write_recording
from sph_stab_ros.simulation.renderer import render, RenderOptions
from sph_stab_ros.simulation.room import Room
from tqdm import tqdm

NAME = 'simulation'
FROM_LOGS: dict[str, Callable[[Path], Flight]] = {
    'drone': flights.drone, 'pioneer': flights.pioneer, 'handheld': flights.handheld}
COMPANY: dict[str, Callable[[int], Flight]] = {
    'company_pioneer': company.pioneer, 'company_handheld': company.handheld}
SYNTHETIC: dict[str, Callable[[int], Flight]] = {
    'synthetic': flights.synthetic, 'hover': flights.hover, 'shake': flights.shake, **COMPANY}
PEOPLE = {'pioneer': 2, 'handheld': 4, 'hover': 2}
HARD: dict[str, dict[str, Any]] = {
    'plain': {},  # a property of the room
    'blur': {'exposure_s': 1 / 30},
    'rolling': {'readout_s': 0.02},
    'stitch': {'stitch_error_deg': 0.5},
    'exposure': {'exposure_step': 0.3},
}


def parser() -> Parser:
    """Return the parser of the command line."""
    result = Parser(f'python3 -m sph_stab_ros.{NAME}', description=__doc__)
    result.add_argument('flight', choices=[*FROM_LOGS, *SYNTHETIC])
    result.add_argument('out', type=Path, metavar='OUT', help='rosbag2 folder to write')
    result.add_argument('--logs', type=Path, metavar='DIR',
                        help=f'rotation logs; {", ".join(FROM_LOGS)} need them')
    result.add_argument('--frames', type=Path, metavar='DIR',
                        help='take the pictures from this folder instead of rendering them')
    result.add_argument('--first-frame', type=int, default=0, metavar='N',
                        help='where in the flight to start (default: %(default)s)')
    result.add_argument('--every', type=int, default=1, metavar='N',
                        help='take every N-th frame only (default: %(default)s)')
    result.add_argument('--frames-limit', type=int, metavar='N',
                        help='number of frames to write (default: all)')
    result.add_argument('--width', type=int, default=640, metavar='PX',
                        help='of the pictures, a multiple of 4 (default: %(default)s)')
    result.add_argument('--quality', type=whole_number(1, 100), default=80, metavar='1-100',
                        help='of the JPEG compression (default: %(default)s)')
    result.add_argument('--seed', type=whole_number(0), default=0,
                        help='of the room, noise and synthetic motion (default: %(default)s)')
    result.add_argument('--hard', action='append', choices=HARD, default=[],
                        help='difficulty, may be repeated')
    result.add_argument('--force', action='store_true', help='replace OUT')
    return result


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit status."""
    command_line = parser()
    args = command_line.parse_args(argv)
    if args.flight in FROM_LOGS and args.logs is None:
        command_line.error(f'{args.flight} needs --logs')
    if args.width < 16 or args.width % 4:
        command_line.error('--width must be a multiple of 4 and at least 16')
    if args.frames is not None and args.hard:
        command_line.error('--hard is for rendering, not for --frames')
    return run(NAME, lambda: simulate(command_line, args))


def simulate(command_line: Parser, args: Namespace) -> None:
    """Write the recording that the arguments describe."""
    whole = whole_flight(args)
    flight = part(command_line, whole, args)
    if args.frames is not None:
        images = read_frames(args.frames, flight, whole)
    else:
        images = rendered(args, whole, flight)
    progress = tqdm(images, args.flight, len(flight.stamps_ns), unit='frame', disable=None)
    # A ground robot's motion does not tell how the markers sit; in company they sit straight.
    R_camera_markers = R_BODY_CAMERA.inv() if args.flight in COMPANY else R_CAMERA_MARKERS
    write_recording(args.out, flight, progress, args.quality, args.force, R_camera_markers)


def rendered(args: Namespace, whole: Flight, flight: Flight) -> Iterator[Image]:
    """Return an iterator over the pictures of a flight, part of a whole one."""
    if args.flight in COMPANY:
        # Where people walk is planned over the whole flight.
        seen, options = whole, company.render_options(args.seed)
        room = company.room(whole, args.seed, 'plain' in args.hard)
    else:
        seen = flight
        room = Room(flight, args.seed, people=PEOPLE.get(args.flight, 1),
                    plain_walls='plain' in args.hard)
        options = RenderOptions(robot=args.flight == 'pioneer', seed=args.seed)
    for difficulty in args.hard:
        options = replace(options, **HARD[difficulty])
    times_s = (flight.stamps_ns - seen.stamps_ns[0]) * 1e-9
    return (render(room, seen, float(t_s), args.width, options) for t_s in times_s)


def whole_flight(args: Namespace) -> Flight:
    """Return the flight that is named, at its full length."""
    if args.flight in SYNTHETIC:
        return SYNTHETIC[args.flight](args.seed)
    try:
        return FROM_LOGS[args.flight](args.logs)
    except ValueError as error:
        raise RecordingError(str(error)) from error


def part(command_line: Parser, whole: Flight, args: Namespace) -> Flight:
    """Return the part of the flight that is wanted; a part it does not have is a usage error."""
    frames = args.frames_limit
    if frames is None:
        frames = len(whole.stamps_ns[max(args.first_frame, 0)::max(args.every, 1)])
    try:
        return whole.cut(args.first_frame, frames, args.every)
    except ValueError as error:
        command_line.error(str(error))


if __name__ == '__main__':
    sys.exit(main())
