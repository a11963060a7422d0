# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The rows of tables of accuracy and of coverage, see docs_tables."""

from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, TypeAlias

AXES = ('roll', 'pitch', 'yaw')
# Table 1 of the paper: roll, pitch, yaw in degrees.
PAPER_DEG = {'pts': (6.29, 4.09, 9.84), 'moment': (3.54, 3.05, 8.53),
             'pts_epipolar': (1.72, 2.44, 7.36)}

# What a target wrote, a row of cells, and what makes a table.
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


def ablation(results: Sequence[Result]) -> Iterator[Row]:
    """
    Yield the rows of a table of errors without each part of a tracker.

    Flights that differ by their seed alone, ``pioneer_411`` and so on, are a column together.
    """
    result, = results
    columns: dict[str, list[str]] = defaultdict(list)
    for name in next(iter(result.values())):
        columns[name.rstrip('0123456789')].append(name)
    yield ('', *(names[0] if len(names) == 1 else
                 f'{kind.rstrip("_")}, {len(names)} flights: mean; worst'
                 for kind, names in columns.items()))
    for variant, found in result.items():
        yield (variant, *(_together([found[name] for name in names])
                          for names in columns.values()))


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


def _degrees(values: dict[str, float], *keys: str, digits: int = 2) -> str:
    return ', '.join(f'{values[key]:.{digits}f}' for key in keys) + '°'


def _together(flights: Sequence[Result]) -> str:
    means, medians = zip(*((one['geodesic_mean_deg'], one['per_frame_median_deg'])
                           for one in flights))
    worst = f'; {max(means):.2f}' if len(flights) > 1 else ''
    return f'{sum(means) / len(means):.2f}, {sum(medians) / len(medians):.3f}°{worst}'


def _percent(part: int, whole: int) -> str:
    return f'{100 * part / whole:.0f} %' if whole else '–'


def _spec(mask: str) -> str:
    return f'`{mask}`' if mask else '–'


TABLES: dict[str, Table] = {
    'errors': errors, 'beside': beside, 'times': times, 'paper': paper, 'over_time': over_time,
    'injected': injected, 'offline': offline, 'ablation': ablation, 'covered': covered}
