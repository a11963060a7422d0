# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""
Render a simulated flight photoreal, frame by frame; run again to resume.

Writes DIR/000000.png and so on, 2:1 equirectangular, the middle of the exposure at the frame's
stamp. Frames that exist are skipped.
"""

import argparse
import os
from pathlib import Path
import sys
import time

import bpy
import camera
import cv2
import numpy as np
from scene import SCENES, walkers

REPOSITORY = Path(__file__).resolve().parents[2]
FLIGHTS = {'drone': 'laboratory', 'pioneer': 'lobby', 'handheld': 'office',
           'hover': 'laboratory', 'shake': 'laboratory'}
BASE_EV = -0.55  # keeps lit walls below white


def arguments():
    """Return the parsed command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('flight', choices=FLIGHTS)
    parser.add_argument('directory', type=Path, metavar='DIR')
    parser.add_argument('--logs', type=Path, help='folder of the rotation logs that drive drone, '
                        'pioneer and handheld')
    parser.add_argument('--frames', type=int, help='length of the flight (default: all)')
    parser.add_argument('--first', type=int, default=0, help='index of the first frame to render')
    parser.add_argument('--every', type=int, default=1,
                        help='render every n-th frame only; file names keep their index')
    parser.add_argument('--width', type=int, default=640)
    parser.add_argument('--samples', type=int, default=6, help='per pixel, before denoising')
    parser.add_argument('--exposure-s', type=float, default=1 / 90)
    hard = parser.add_argument_group('hard variants')
    hard.add_argument('--bare', action='store_true', help='plain walls, no furniture')
    hard.add_argument('--people', type=int, default=0, help='walking around, besides those of '
                      'the room (up to 2)')
    hard.add_argument('--rolling-shutter-s', type=float, default=0.0,
                      help='delay of the last row after the first; the stamp is the mean time')
    hard.add_argument('--stitch-deg', type=float, default=0.0,
                      help='rotation between the two lenses')
    hard.add_argument('--exposure-steps-ev', type=float, default=0.0,
                      help='largest change of brightness, stepping about every 1.5 s')
    options = parser.parse_args()
    if options.flight in ('drone', 'pioneer', 'handheld') and not options.logs:
        parser.error(f'{options.flight} needs --logs')
    if options.width < 16 or options.width % 2:
        parser.error('--width must be even and at least 16')
    if not 0 <= options.people <= 2:
        parser.error('--people must be within 0 and 2')
    if min(options.samples, options.every) < 1 or options.first < 0 or options.exposure_s <= 0:
        parser.error('--samples, --every, --first and --exposure-s must be positive')
    return options


def load_flight(options):
    """Return the flight named on the command line."""
    sys.path.insert(0, str(REPOSITORY))
    from sph_stab_ros.simulation import flights
    given = {} if options.frames is None else {'frames': options.frames}
    if options.flight == 'hover':
        return flights.hover()
    if options.flight == 'shake':
        return flights.shake(**given)
    return getattr(flights, options.flight)(options.logs, **given)


def brightness_ev(t_s, largest_ev):
    """Exposure compensation in stops at a time: constant for 1.5 s, then another."""
    return largest_ev * np.random.default_rng(int(t_s / 1.5)).uniform(-1.0, 1.0)


def render_frame(path, stitch_rad):
    """Render the current frame to `path`, which appears only when it is complete."""
    partial = path.with_name(f'.partial-{path.name}')
    bpy.context.scene.render.filepath = str(partial)
    bpy.ops.render.render(write_still=True)
    if stitch_rad:
        cv2.imwrite(str(partial), camera.stitch(cv2.imread(str(partial)), stitch_rad))
    os.replace(partial, path)


def main():
    """Render what is missing."""
    options = arguments()
    try:
        flight = load_flight(options)
    except (OSError, ValueError) as error:
        sys.exit(f'render: {error}')
    span_s = options.exposure_s + options.rolling_shutter_s
    eye = camera.setup(options.width, options.samples, options.rolling_shutter_s / span_s)
    movers = SCENES[FLIGHTS[options.flight]](flight, options.bare)
    movers += walkers(flight, options.people)
    movers.append(camera.follow(eye, flight))
    view = bpy.context.scene.view_settings
    view.view_transform, view.look = 'AgX', 'AgX - Medium High Contrast'
    options.directory.mkdir(parents=True, exist_ok=True)
    times = flight.frame_times_s[:options.frames]
    for index in range(options.first, len(times), options.every):
        path = options.directory / f'{index:06d}.png'
        if path.exists():
            continue
        started = time.monotonic()
        bpy.context.scene.cycles.seed = index
        view.exposure = BASE_EV + brightness_ev(times[index], options.exposure_steps_ev)
        camera.expose(movers, index, times[index], span_s)
        render_frame(path, np.deg2rad(options.stitch_deg))
        print(f'{path} {time.monotonic() - started:.1f} s', flush=True)


if __name__ == '__main__':
    main()
