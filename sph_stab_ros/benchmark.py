# Copyright 2026 The sph_stab_ros developers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""
Time stages and whole pipelines side by side, beside the bare OpenCV calls they stand on.

Pictures come from a recording, since corners and flow take as long as the texture makes them, and
are resized to each width. All calls take turns, so that what disturbs the machine disturbs them
alike: ratios within a run say more than milliseconds.
"""

from argparse import ArgumentTypeError
from dataclasses import dataclass
from itertools import chain, cycle, islice
import json
import os
from pathlib import Path
import platform
import sys
from time import perf_counter, process_time

import cv2
import numpy as np
import scipy

from sph_stab_ros import matching
from sph_stab_ros.command_line import Parser, run
from sph_stab_ros.config import ANCHORED, MIN_WIDTH, StabilizerConfig, TrackerConfig
from sph_stab_ros.equirect import bearing_grid, is_equirect
from sph_stab_ros.estimators import fit_epipolar, fit_essential, fit_moment
from sph_stab_ros.flow import dense_pairs, dis, spherical_flow
from sph_stab_ros.frame import Frame
from sph_stab_ros.image_pair import METHODS
from sph_stab_ros.projection import Equirect, to_grey
from sph_stab_ros.recording import open_recording, RecordingError
from sph_stab_ros.recording.images import encode_jpeg, fill_image, image_from_compressed
from sph_stab_ros.recording.output import partial_output
from sph_stab_ros.stabilization import Stabilizer
from sph_stab_ros.trackers import make_tracker, working_width
from sph_stab_ros.trajectory import NS_PER_S
from sph_stab_ros.warp import (
    perspective_rays, perspective_view, rotate_equirect, view_rotation)

from tqdm import tqdm

WIDTHS = (640, 960, 1920, 3840)
MAX_WIDTH = 7680
VIEW_SIZE_WH = (960, 540)
VIEW_HFOV_RAD = np.deg2rad(90)
FRAME_PERIOD_NS = NS_PER_S // 30
# Turned about all axes, as a camera carried about is.
R_TURNED = view_rotation(*np.deg2rad((20, 12, -9)))
R_VIEW = R_TURNED * view_rotation(*np.deg2rad((-30, -10, 0)))
# The slowest calls need fewer repeats: the rest of them is left out after so long.
BUDGET_S = 5.


@dataclass(frozen=True)
class Input:
    """
    What the calls of one round get.

    ``frame`` is in colour, ``grey`` and ``previous_grey`` are of the same width, and
    ``working_grey`` is of the anchored tracker's.
    """

    frame: Frame
    grey: np.ndarray
    previous_grey: np.ndarray
    working_grey: np.ndarray


def inputs(images, width, anchored_width):
    """Yield an Input per consecutive pair of images; at their end they run backwards again."""
    there_and_back = cycle(chain(images, images[-2:0:-1]))
    previous_grey = None
    for number, image in enumerate(there_and_back):
        reduced = width < image.shape[1]
        image = cv2.resize(image, (width, width // 2),
                           interpolation=cv2.INTER_AREA if reduced else cv2.INTER_CUBIC)
        grey = to_grey(image, width)
        if previous_grey is not None:
            yield Input(Frame(image, number * FRAME_PERIOD_NS), grey, previous_grey,
                        to_grey(image, anchored_width))
        previous_grey = grey


def bare_calls(width):
    """Return by name the OpenCV calls to compare with, each of an Input."""
    v, u = np.mgrid[:VIEW_SIZE_WH[1], :VIEW_SIZE_WH[0]]
    rays = perspective_rays(np.stack((u, v), axis=-1), VIEW_HFOV_RAD, *VIEW_SIZE_WH)
    sphere_map, view_map = (
        cv2.convertMaps(*Equirect(width).pixels(*np.float32(
            np.moveaxis(bearings @ R.as_matrix().T, -1, 0))), cv2.CV_16SC2)
        for bearings, R in ((bearing_grid(width), R_TURNED), (rays, R_VIEW)))
    return {
        'copy': lambda one: one.frame.image.copy(),
        'cv2 flow dis': lambda one: dis(one.previous_grey, one.grey),
        'cv2 remap sphere': lambda one: cv2.remap(one.frame.image, *sphere_map, cv2.INTER_LINEAR),
        'cv2 remap view': lambda one: cv2.remap(one.frame.image, *view_map, cv2.INTER_LINEAR),
    }


def stage_calls(first, width):
    """
    Return by name the stages, each of an Input, with the bare call that it is compared with.

    The fits get flow and features of the ``first`` Input at the width they work at.
    """
    working_px = first.working_grey.shape[1]
    anchored = make_tracker(TrackerConfig(), working_px)
    fit_width = min(working_width(TrackerConfig(estimator='moment')), width)
    greys = [to_grey(grey, fit_width) for grey in (first.previous_grey, first.grey)]
    pairs = dense_pairs(*greys)
    matches = matching.match(*map(matching.detect, greys))
    start = pairs and fit_essential(matches)
    if start is None:
        raise RecordingError('its first two pictures show too little to estimate a rotation from')
    jpeg = encode_jpeg(first.frame.image)
    calls = {
        'decode JPEG': ('copy', lambda one: image_from_compressed(jpeg)),
        'grey, resize': ('copy', lambda one: to_grey(one.frame.image, working_px)),
        'flow farneback': (
            'cv2 flow dis', lambda one: spherical_flow(one.previous_grey, one.grey, 'farneback')),
        'flow dis': (
            'cv2 flow dis', lambda one: spherical_flow(one.previous_grey, one.grey, 'dis')),
        'features A-KAZE': ('cv2 flow dis', lambda one: matching.detect(one.grey)),
        'fit essential': ('copy', lambda one: fit_essential(matches)),
        'fit moment': ('copy', lambda one: fit_moment(pairs)),
        'fit epipolar': ('copy', lambda one: fit_epipolar(pairs, start)),
        'track anchored': (
            'cv2 flow dis', lambda one: anchored.track(one.working_grey, one.frame.stamp_ns)),
        'warp sphere': (
            'cv2 remap sphere', lambda one: rotate_equirect(one.frame.image, R_TURNED)),
        'warp view': (
            'cv2 remap view',
            lambda one: perspective_view(one.frame.image, R_VIEW, VIEW_HFOV_RAD, VIEW_SIZE_WH)),
        'encode JPEG': ('copy', lambda one: encode_jpeg(one.frame.image)),
    }
    try:
        from sensor_msgs.msg import Image
        calls['fill message'] = ('copy', lambda one: fill_image(Image(), one.frame.image))
    except ImportError:
        pass
    return calls


def pipeline_calls():
    """Return by name whole pipelines, each of an Input, with the call that it is compared with."""
    calls = {}
    for estimator in (ANCHORED, *METHODS):
        for pictures in ('', ' + pictures'):
            stabilizer = Stabilizer(StabilizerConfig(TrackerConfig(estimator=estimator)))
            calls[estimator + pictures] = (
                'cv2 remap sphere' if estimator == ANCHORED else ANCHORED + pictures,
                lambda one, s=stabilizer, p=bool(pictures): stabilize(s, one.frame, p))
    return calls


def stabilize(stabilizer, frame, pictures):
    """Return what a user gets: the orientation and, with ``pictures``, the sphere and a view."""
    stabilized = stabilizer.process(frame)
    if not pictures:
        return stabilized.R_world_camera
    return (stabilized.R_world_camera, stabilized.sphere(),
            stabilized.view(R_VIEW, VIEW_HFOV_RAD, VIEW_SIZE_WH))


def medians(calls, rounds, progress=iter):
    """
    Return by name the median milliseconds of calls, ``{wall_ms, cpu_ms, repeats}``.

    Each of the ``rounds`` is an Input that every call gets in turn; the first warms up. CPU time
    is that of all threads: more than wall time where OpenCV uses several cores.
    """
    samples = {name: [] for name in calls}
    spent_s = dict.fromkeys(calls, 0.)
    for one in progress(rounds):
        for name, call in calls.items():
            if spent_s[name] > BUDGET_S:
                continue
            wall_s, cpu_s = perf_counter(), process_time()
            # Kept until both clocks are read: giving back the memory is the caller's business.
            result = call(one)
            samples[name].append((perf_counter() - wall_s, process_time() - cpu_s))
            del result
            spent_s[name] += samples[name][-1][0]
    figures = {}
    for name, taken in samples.items():
        warm = taken[1:] or taken
        wall_ms, cpu_ms = (1000 * float(median) for median in np.median(warm, axis=0))
        figures[name] = {'wall_ms': wall_ms, 'cpu_ms': cpu_ms, 'repeats': len(warm)}
    return figures


def benchmark_width(images, width, repeats, progress=iter):
    """Return the figures of one width by group: ``bare``, ``stages`` and ``pipelines``."""
    anchored_width = min(working_width(TrackerConfig()), width)
    rounds = inputs(images, width, anchored_width)
    first = next(rounds)
    groups = {'stages': stage_calls(first, width), 'pipelines': pipeline_calls()}
    calls = bare_calls(width)
    bare_names = tuple(calls)
    for group in groups.values():
        calls |= {name: call for name, (_, call) in group.items()}
    taken = medians(calls, islice(chain((first,), rounds), repeats + 1), progress)
    figures = {'bare': {name: taken[name] for name in bare_names}}
    for group, members in groups.items():
        figures[group] = {
            name: taken[name] | compared(taken[name], base, taken[base])
            for name, (base, _) in members.items()}
    return figures


def compared(figures, base, base_figures):
    """Return the name of the base, and how many times its wall and CPU time was taken."""
    return {'base': base, 'ratio': figures['wall_ms'] / base_figures['wall_ms'],
            'cpu_ratio': figures['cpu_ms'] / base_figures['cpu_ms']}


def machine():
    """Return what the figures depend on besides the code."""
    model = platform.processor()
    if Path('/proc/cpuinfo').exists():
        names = [line.partition(':')[2].strip()
                 for line in Path('/proc/cpuinfo').read_text().splitlines()
                 if line.startswith('model name')]
        model = names[0] if names else model
    return {'cpu': model, 'cores': os.cpu_count(), 'opencv_threads': cv2.getNumThreads(),
            'load_before': os.getloadavg()[0], 'system': platform.platform(terse=True),
            'python': platform.python_version(), 'opencv': cv2.__version__,
            'numpy': np.__version__, 'scipy': scipy.__version__}


def table(widths):
    """Yield the lines of a table of figures by width: wall ms, CPU ms and ratio of each call."""
    some = next(iter(widths.values()))
    yield ' ' * 24 + ''.join(f'{width:>18} px ' for width in widths) + '  ratio to'
    yield ' ' * 24 + '   wall    CPU ratio  ' * len(widths)
    for group, members in some.items():
        yield group
        for name, one in members.items():
            cells = (figures[group][name] for figures in widths.values())
            yield (f'  {name:<22}' + ''.join(
                f'{cell["wall_ms"]:7.1f}{cell["cpu_ms"]:7.1f}'
                + (f'{cell["cpu_ratio"]:7.2f} ' if 'base' in cell else ' ' * 8)
                for cell in cells) + '  ' + one.get('base', '')).rstrip()


def widths_argument(text):
    """Return the widths of a comma-separated list, in pixels."""
    try:
        widths = [int(one) for one in text.split(',')]
    except ValueError:
        raise ArgumentTypeError(f"'{text}' is no list of widths such as 640,1920") from None
    for width in widths:
        if width % 2 or not MIN_WIDTH <= width <= MAX_WIDTH:
            raise ArgumentTypeError(
                f'{width} is no even width between {MIN_WIDTH} and {MAX_WIDTH}')
    return list(dict.fromkeys(widths))


def arguments(argv):
    """Return the parsed command line; exit 2 on a wrong call."""
    parser = Parser(prog='benchmark', description=__doc__)
    parser.add_argument('recording', metavar='REC', type=Path, nargs='?',
                        default=Path('bags/drone'),
                        help='where the pictures come from (default: %(default)s)')
    parser.add_argument('--widths', metavar='W,...', type=widths_argument,
                        default=','.join(map(str, WIDTHS)),
                        help='widths in pixels (default: %(default)s)')
    parser.add_argument('--repeats', metavar='N', type=int, default=20,
                        help=f'calls to take the median of, fewer for those that take more than '
                        f'{BUDGET_S:g} s in all (default: %(default)s)')
    parser.add_argument('--json', metavar='FILE', type=Path, help='write all figures')
    args = parser.parse_args(argv)
    if args.repeats < 1:
        parser.error('--repeats must be at least 1')
    if args.json and args.json.is_dir():
        parser.error(f"--json needs a file, '{args.json}' is a folder")
    if args.json and not args.json.parent.is_dir():
        parser.error(f'--json: there is no folder {args.json.parent}')
    return args


def benchmark(args):
    """Do what the command line says."""
    recording = open_recording(args.recording)
    images = [frame.image for frame in islice(recording.frames(), args.repeats + 2)]
    if len(images) < 2 or images[0].ndim < 3:
        raise RecordingError(f'{args.recording}: at least two pictures in colour are needed')
    if not is_equirect(images[0].shape):
        raise RecordingError(f'{args.recording}: its pictures are not 2:1')
    about = {'machine': machine(), 'recording': recording.name,
             'recorded_width': images[0].shape[1], 'repeats': args.repeats}
    widths = {}
    for width in args.widths:
        try:
            widths[width] = benchmark_width(images, width, args.repeats, lambda rounds: tqdm(
                rounds, f'{width} px', args.repeats + 1, unit=' rounds', disable=None))
        except RecordingError as error:
            raise RecordingError(f'{args.recording}: {error}') from error
    print(', '.join(f'{name} {value}' for name, value in about['machine'].items()))
    print(f'{recording.name}, {images[0].shape[1]} px wide, resized; medians in ms of '
          f'{args.repeats} calls (slow ones: fewer), ratios of CPU time')
    for line in table(widths):
        print(line)
    if 'fill message' not in widths[args.widths[0]]['stages']:
        print("'fill message' is left out: sensor_msgs is not installed")
    if args.json:
        with partial_output(args.json, force=True) as path:
            path.write_text(json.dumps({**about, 'widths': widths}, indent=2) + '\n')


def main(argv=None):
    """Run the command line; return the exit status."""
    args = arguments(argv)
    return run('benchmark', lambda: benchmark(args))


if __name__ == '__main__':
    sys.exit(main())
