# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""
Time stages and whole pipelines side by side, beside the bare OpenCV calls they stand on.

Pictures come from a recording, since corners and flow take as long as the texture makes them, and
are resized to each width. All calls take turns, so that what disturbs the machine disturbs them
alike: ratios within a run say more than milliseconds.
"""

# Before all that takes time to import.
if __name__ == '__main__':
    from sph_stab_ros.executable import start
    raise SystemExit(start('benchmark.__main__'))

from argparse import ArgumentTypeError, Namespace
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import islice
from pathlib import Path
from typing import TypeAlias, TypeVar

from sph_stab_ros.benchmark.calls import benchmark_width, BUDGET_S
from sph_stab_ros.benchmark.growth import growth, MAX_PICTURES
from sph_stab_ros.benchmark.machine import machine, MAX_WIDTH
from sph_stab_ros.benchmark.projections import projection_times
from sph_stab_ros.benchmark.references import is_there, references
from sph_stab_ros.command_line import Parser, run
from sph_stab_ros.command_line.arguments import file_argument, names_argument, whole_number
from sph_stab_ros.config import MIN_WIDTH, TrackerConfig
from sph_stab_ros.evaluation.alignment import EvaluationError
from sph_stab_ros.evaluation.arguments import mount_argument
from sph_stab_ros.evaluation.report import Figures
from sph_stab_ros.geometry.equirect import is_equirect
from sph_stab_ros.geometry.projection import to_grey
from sph_stab_ros.recording import decoded_frames, open_recording, Recording, RecordingError
from sph_stab_ros.recording.partial_output import write_json
from sph_stab_ros.tracking import working_width

from tqdm import tqdm

WIDTHS = (640, 960, 1920, 3840)
PARTS = ('times', 'projections', 'growth', 'references')
# What the project aims at: milliseconds in all, frames per second with a core to spare, ratio.
TARGET_MS, TARGET_FPS, TARGET_RATIO = 5, 30, 1.3

# Of each width the figures of each call, by group and name.
FiguresByWidth: TypeAlias = Mapping[int, Mapping[str, Mapping[str, Figures]]]
# What is aimed at, the target, what was measured, and whether that is met.
Target: TypeAlias = tuple[str, str, str, bool]
Item = TypeVar('Item')


def table(widths: FiguresByWidth) -> Iterator[str]:
    """Yield the lines of a table of figures by width: wall ms, CPU ms and ratio of each call."""
    some = next(iter(widths.values()))
    yield ' ' * 24 + ''.join(f'{width:>18} px ' for width in widths) + '  ratio to'
    yield ' ' * 24 + '   wall    CPU ratio  ' * len(widths)
    for group, members in some.items():
        yield group
        for name, call in members.items():
            cells = (figures[group][name] for figures in widths.values())
            yield (f'  {name:<22}' + ''.join(
                f'{cell["wall_ms"]:7.1f}{cell["cpu_ms"]:7.1f}'
                + (f'{cell["cpu_ratio"]:7.2f} ' if 'base' in cell else ' ' * 8)
                for cell in cells) + '  ' + call.get('base', '')).rstrip()


def widths_argument(text: str) -> list[int]:
    """Return the widths of a comma-separated list, in pixels."""
    try:
        widths = [int(width) for width in text.split(',')]
    except ValueError:
        raise ArgumentTypeError(f"'{text}' is no list of widths such as 640,1920") from None
    for width in widths:
        if width % 2 or not MIN_WIDTH <= width <= MAX_WIDTH:
            raise ArgumentTypeError(
                f'{width} is no even width between {MIN_WIDTH} and {MAX_WIDTH}')
    return list(dict.fromkeys(widths))


def targets(widths: FiguresByWidth, cores: int) -> Iterator[Target]:
    """
    Yield what is aimed at, what was measured and whether that is met, of figures by width.

    Those whose widths were not measured are left out.
    """
    if 960 in widths:
        ms = widths[960]['pipelines']['anchored']['wall_ms']
        yield ('cost: 960x480 in, orientation out', f'<= {TARGET_MS} ms', f'{ms:.1f} ms',
               ms <= TARGET_MS)
    if 1920 in widths:
        whole = widths[1920]['pipelines']['anchored + pictures']
        fps, used = 1000 / whole['wall_ms'], whole['cpu_ms'] * TARGET_FPS / 1000
        yield ('1920x960 in, derotated + 960x540 view out',
               f'>= {TARGET_FPS} fps, a core to spare',
               f'{fps:.1f} fps, {used:.1f} of {cores} cores at {TARGET_FPS} fps',
               fps >= TARGET_FPS and used <= cores - 1)
        for stage in ('warp sphere', 'warp view'):
            ratio = widths[1920]['stages'][stage]['ratio']
            yield (f'{stage} / bare remap, 1920x960', f'<= {TARGET_RATIO}', f'{ratio:.2f}',
                   ratio <= TARGET_RATIO)


def targets_table(rows: Iterable[Target]) -> Iterator[str]:
    """Yield the lines of a table of what is aimed at."""
    for what, target, measured, met in rows:
        yield f'  {what:<44}{target:<28}{measured:<40}{"met" if met else "MISSED"}'


def growth_table(figures: Figures) -> Iterator[str]:
    """Yield the lines of a table of what growth took."""
    yield f'anchored over {figures["frames"]} frames, {figures["width"]} px wide, there and back'
    yield f'  {"":<14}{"median ms":>12}{"memory MB":>12}{"keyframes":>12}{"landmarks":>12}'
    for name in ('first_tenth', 'last_tenth'):
        tenth = figures[name]
        yield (f'  {name.replace("_", " "):<14}{tenth["median_ms"]:>12.1f}'
               f'{tenth["memory_mb"]:>12.1f}{tenth["keyframes"]:>12}{tenth["landmarks"]:>12}')


def references_table(figures: Mapping[str, Figures]) -> Iterator[str]:
    """Yield the lines of a table of errors against the truth, beside others' methods."""
    yield f'  {"":<22}{"frames":>8}{"lost":>6}{"geodesic mean":>16}{"max":>8}{"ms/frame":>10}'
    for name, method in figures.items():
        error = method['geodesic_deg']
        yield (f'  {name:<22}{method["frames"]:>8}{method["lost_frames"]:>6}'
               f'{error["mean"]:>15.3f}°{error["max"]:>7.2f}°{method["ms_per_frame"]:>10.1f}')


def arguments(argv: Sequence[str] | None) -> Namespace:
    """Return the parsed command line; exit 2 on a usage error."""
    parser = Parser(prog='benchmark', description=__doc__)
    parser.add_argument('recording', metavar='REC', type=Path, nargs='?',
                        default=Path('bags/drone'),
                        help='where the pictures come from (default: %(default)s)')
    parser.add_argument('--parts', metavar='P,...', type=names_argument(PARTS),
                        default=','.join(PARTS),
                        help='what to measure: milliseconds, those of projections, what a long '
                        'run costs, errors and times beside others '
                        '(default: %(default)s)')
    parser.add_argument('--widths', metavar='W,...', type=widths_argument,
                        default=','.join(map(str, WIDTHS)),
                        help='widths in pixels (default: %(default)s)')
    parser.add_argument('--repeats', metavar='N', type=whole_number(1), default=20,
                        help=f'calls to take the median of, fewer for those that take more than '
                        f'{BUDGET_S:g} s in all (default: %(default)s)')
    parser.add_argument('--growth-frames', metavar='N', type=whole_number(10), default=2000,
                        help='length of the long run, at least 10 (default: %(default)s)')
    parser.add_argument('--mount', metavar='YAW,PITCH,ROLL', type=mount_argument,
                        help='how the camera sits on the body whose orientation is the truth, in '
                        'degrees, --mount=-30,0,0 with = before a minus (default: solved for)')
    parser.add_argument('--json', metavar='FILE', type=file_argument, help='write all figures')
    return parser.parse_args(argv)


def bar(name: str, iterable: Iterable[Item], total: int | None,
        unit: str = ' frames') -> Iterable[Item]:
    """Return the iterable with a progress bar where there is a terminal."""
    return tqdm(iterable, name, total, unit=unit, disable=None)


def times(args: Namespace, recording: Recording) -> Figures:
    """Return the figures by width, and print their table."""
    images = [frame.image for frame in islice(decoded_frames(recording), args.repeats + 2)]
    if len(images) < 2 or images[0].ndim < 3:
        raise RecordingError(f'{args.recording}: at least two pictures in colour are needed')
    if not is_equirect(images[0].shape):
        raise RecordingError(f'{args.recording}: its pictures are not 2:1')
    widths = {}
    for width in args.widths:
        try:
            widths[width] = benchmark_width(
                images, width, args.repeats,
                lambda rounds: bar(f'{width} px', rounds, args.repeats + 1, ' rounds'))
        except RecordingError as error:
            raise RecordingError(f'{args.recording}: {error}') from error
    print(f'{recording.name}, {images[0].shape[1]} px wide, resized; medians in ms of '
          f'{args.repeats} calls (slow ones: fewer), ratios of CPU time')
    print(*table(widths), sep='\n')
    if 'fill message' not in widths[args.widths[0]]['stages']:
        print("'fill message' is left out: sensor_msgs is not installed")
    return {'recorded_width': images[0].shape[1], 'widths': widths}


def projections_part(args: Namespace, recording: Recording) -> Figures:
    """Return the figures by projection, and print them."""
    image = next(decoded_frames(recording)).image
    if image.ndim < 3:
        raise RecordingError(f'{args.recording}: a picture in colour is needed')
    found = projection_times(image, args.repeats, lambda rounds: bar(
        'projections', rounds, args.repeats + 1, ' rounds'))
    print("a sphere of 1920 columns, a view of 960, the tracker's grey sphere: CPU in ms")
    for name, members in found.items():
        print(f'  {name:<22}' + ''.join(f'{one["cpu_ms"]:7.1f}' for one in members.values()))
    return {'projections': found}


def growth_part(args: Namespace, recording: Recording) -> Figures:
    """Return the figures of growth, and print their table."""
    spheres = []
    for frame in islice(decoded_frames(recording), MAX_PICTURES):
        width = min(working_width(TrackerConfig()), frame.image.shape[1])
        spheres.append(to_grey(frame.image, width))
    if len(spheres) < 2 or not is_equirect(spheres[0].shape):
        raise RecordingError(f'{args.recording}: at least two pictures, 2:1, are needed')
    figures = growth(spheres, args.growth_frames,
                     lambda frames: bar('growth', frames, args.growth_frames))
    print(*growth_table(figures), sep='\n')
    return {'growth': figures}


def references_part(args: Namespace, recording: Recording) -> Figures:
    """Return the figures of others' methods, and print their table; none where there is none."""
    missing = [module for module in ('poselib', 'pycolmap') if not is_there(module)]
    figures = {}
    if len(missing) < 2:
        try:
            figures = references(recording, args.mount,
                                 lambda name, frames: bar(name, frames, None))
        except (RecordingError, EvaluationError) as error:
            print(f'references are left out: {error}')
    if figures:
        print(f"{recording.name}, errors against the truth, beside others' methods")
        print(*references_table(figures), sep='\n')
    if missing:
        print(f'{" and ".join(missing)} not installed (pip install .[references])')
    return {'references': figures}


def benchmark(args: Namespace) -> None:
    """Do what the command line says."""
    recording = open_recording(args.recording)
    figures = {'machine': machine(), 'recording': recording.name, 'repeats': args.repeats}
    print(', '.join(f'{name} {value}' for name, value in figures['machine'].items()))
    for part, measure in zip(PARTS, (times, projections_part, growth_part, references_part)):
        if part in args.parts:
            figures |= measure(args, recording)
    rows = list(targets(figures.get('widths', {}), figures['machine']['cores']))
    if rows:
        print('targets', *targets_table(rows), sep='\n')
        figures['targets'] = [dict(zip(('what', 'target', 'measured', 'met'), row))
                              for row in rows]
    if args.json:
        write_json(args.json, figures)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit status."""
    args = arguments(argv)
    return run('benchmark', lambda: benchmark(args))
