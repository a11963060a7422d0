# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.


"""
Write the tables of an evaluation into the pages that show them.

A page marks a table's place, what it tells and of which results::

    <!-- errors drone -->
    …
    <!-- end -->

``FOLDER/drone.json`` is what ``evaluate --json`` wrote, or ``coverage json``. Tables whose results
are not there stay as they are. Times differ from run to run and have a table of their own.
"""

from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
import json
from pathlib import Path
import re
import sys
from typing import Any, TypeAlias

from sph_stab_ros.command_line import Parser, run
from sph_stab_ros.recording import RecordingError
from sph_stab_ros.recording.partial_output import partial_output

BLOCK = re.compile(r'(<!-- (\w+)((?: [\w-]+)+) -->\n).*?(<!-- end -->)', re.DOTALL)
AXES = ('roll', 'pitch', 'yaw')
# Table 1 of the paper: roll, pitch, yaw in degrees.
PAPER_DEG = {'pts': (6.29, 4.09, 9.84), 'moment': (3.54, 3.05, 8.53),
             'pts_epipolar': (1.72, 2.44, 7.36)}


# What ``evaluate --json`` wrote, a row of cells, and what makes a table.
Result: TypeAlias = dict[str, Any]
Row: TypeAlias = tuple[str, ...]
Table: TypeAlias = Callable[[Sequence[Result]], Iterator[Row]]


def errors(results: Sequence[Result]) -> Iterator[Row]:
    """Yield the rows of a table of errors, of one result or of several one after the other."""
    yield ('estimator', 'roll, pitch, yaw: mean absolute', 'geodesic: mean, max, end',
           'per frame: median, max', 'lost frames')
    for result in results:
        for name, one in result['estimators'].items():
            yield (f'`{name}`', _degrees(one['mean_abs_error_deg'], *AXES),
                   _degrees(one['geodesic_deg'], 'mean', 'max', 'end'),
                   _degrees(one['per_frame_deg'], 'median', 'max', digits=3),
                   f'{one["lost_frames"]} of {one["frames"]}')


def times(results: Sequence[Result]) -> Iterator[Row]:
    """Yield the rows of a table of times per frame, a column for each result."""
    yield ('estimator', *(result['recording'] for result in results))
    for name in results[0]['estimators']:
        yield (f'`{name}`', *(f'{result["estimators"][name]["ms_per_frame"]:.0f} ms'
                              for result in results))


def beside(results: Sequence[Result]) -> Iterator[Row]:
    """Yield the rows of a table of errors of several recordings, a column for each."""
    yield ('geodesic: mean; per frame: median', *(result['recording'] for result in results))
    for name in results[0]['estimators']:
        estimates = [result['estimators'][name] for result in results]
        yield (f'`{name}`', *(f'{_degrees(one["geodesic_deg"], "mean")}; '
                              f'{_degrees(one["per_frame_deg"], "median", digits=3)}'
                              for one in estimates))


def paper(results: Sequence[Result]) -> Iterator[Row]:
    """Yield the rows of a table of mean absolute errors beside the paper's."""
    result, = results
    yield ('roll, pitch, yaw', 'paper, Table 1', 'here, Farneback', 'here, DIS')
    for method, expected in PAPER_DEG.items():
        found = [result['estimators'].get(name) for flow in ('farneback', 'dis')
                 for name in (f'{method}/{flow}', method) if name in result['estimators']]
        yield (f'`{method}`', ', '.join(f'{value:.2f}' for value in expected) + '°',
               *(_degrees(one['mean_abs_error_deg'], *AXES) for one in found))


def over_time(results: Sequence[Result]) -> Iterator[Row]:
    """Yield the rows of a table of the geodesic error in the course of time."""
    result, = results
    first = next(iter(result['estimators'].values()))
    yield ('geodesic after', *(f'{time_s:.0f} s' for time_s in first['over_time']['time_s']))
    for name, one in result['estimators'].items():
        yield (f'`{name}`', *(f'{error:.2f}°' for error in one['over_time']['geodesic_deg']))


def injected(results: Sequence[Result]) -> Iterator[Row]:
    """Yield the rows of a table of rotations injected into clips, several results together."""
    yield ('estimator', 'seed', 'not turned', 'mask', 'turn found in the clip itself',
           'geodesic: mean, max', 'per frame: median, max')
    for name in results[0]['estimators']:
        for result in results:
            one = result['estimators'].get(name)
            if one is not None:
                yield (f'`{name}`', str(result['injected_seed']), _spec(result['body']),
                       _spec(result['mask']), f'{one["clip_turn_deg"]:.1f}°',
                       _degrees(one['geodesic_deg'], 'mean', 'max'),
                       _degrees(one['per_frame_deg'], 'median', 'max', digits=3))


def offline(results: Sequence[Result]) -> Iterator[Row]:
    """Yield the rows of a table of the live tracker beside the offline one, and of the means."""
    yield ('recording', 'live, geodesic: mean, max', 'offline',
           'live, per frame: median, max', 'offline')
    pairs = [[result['estimators'][name] for name in ('anchored', 'anchored/offline')]
             for result in results]
    for result, pair in zip(results, pairs):
        seed = result.get('injected_seed')
        yield (result['recording'] + (f', turned by seed {seed}' if seed else ''),
               *(_degrees(one['geodesic_deg'], 'mean', 'max', digits=3) for one in pair),
               *(_degrees(one['per_frame_deg'], 'median', 'max', digits=3) for one in pair))
    live, known = ([sum(one[kind][key] for one in column) / len(results) for kind, key in (
        ('geodesic_deg', 'mean'), ('per_frame_deg', 'median'))] for column in zip(*pairs))
    yield ('**mean of all**', *(f'{means[i]:.3f}°' for i in (0, 1) for means in (live, known)))


def covered(results: Sequence[Result]) -> Iterator[Row]:
    """Yield the rows of a table of lines and branches that tests run, by room."""
    result, = results
    counts: dict[str, Counter[str]] = defaultdict(Counter)
    for name, one in result['files'].items():
        _, *room, _ = Path(name).parts
        counts[f'`{room[0]}`' if room else 'executables'].update(one['summary'])
    yield 'room', 'lines', 'branches'
    for name, counted in sorted(counts.items()):
        yield (name, _percent(counted['covered_lines'], counted['num_statements']),
               _percent(counted['covered_branches'], counted['num_branches']))


TABLES: dict[str, Table] = {
    'errors': errors, 'beside': beside, 'times': times, 'paper': paper, 'over_time': over_time,
    'injected': injected, 'offline': offline, 'covered': covered}


def filled(page: str, folder: Path) -> str:
    """Return a page with the tables of a folder's results in their places."""
    def block(match: re.Match[str]) -> str:
        start, kind, names, end = match.groups()
        files = [folder / f'{name}.json' for name in names.split()]
        if kind not in TABLES:
            raise RecordingError(f"there is no table '{kind}', but {', '.join(TABLES)}")
        if not all(file.exists() for file in files):
            return match.group()
        results = [json.loads(file.read_text()) for file in files]
        return start + markdown(TABLES[kind](results)) + end
    return BLOCK.sub(block, page)


def markdown(rows: Iterable[Row]) -> str:
    """Return a Markdown table of rows of cells, the first one its head."""
    head, *body = rows
    lines = [head, ['---'] * len(head), *body]
    return '\n' + ''.join(f'| {" | ".join(cells)} |\n' for cells in lines) + '\n'


def _degrees(values: dict[str, float], *keys: str, digits: int = 2) -> str:
    return ', '.join(f'{values[key]:.{digits}f}' for key in keys) + '°'


def _percent(part: int, whole: int) -> str:
    return f'{100 * part / whole:.0f} %' if whole else '–'


def _spec(mask: str) -> str:
    return f'`{mask}`' if mask else '–'


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit status."""
    parser = Parser(prog='python3 -m sph_stab_ros.evaluation.page_tables',
                    description='Write the tables of an evaluation into the pages that show them.')
    parser.add_argument('folder', metavar='FOLDER', type=Path, help='where the results are')
    parser.add_argument('pages', metavar='PAGE', type=Path, nargs='+', help='Markdown to fill in')
    args = parser.parse_args(argv)

    def command() -> None:
        for page in args.pages:
            try:
                text = filled(page.read_text(), args.folder)
            except OSError as error:
                raise RecordingError(f'{page} cannot be read: {error.strerror}') from error
            with partial_output(page, force=True) as partial:
                partial.write_text(text)

    return run('page_tables', command)


if __name__ == '__main__':
    sys.exit(main())
