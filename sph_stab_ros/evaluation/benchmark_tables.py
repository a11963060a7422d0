# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The rows of tables of times, of loads, and of what others measured, see docs_tables."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from sph_stab_ros.evaluation.accuracy_tables import Result, Row, Table

OPERATOR_PAGE = 'operator_page'


def targets(results: Sequence[Result]) -> Iterator[Row]:
    """Yield the rows of a table of what is aimed at, and of what a long run costs."""
    result, = results
    yield 'columns in, what comes out', 'aim', 'measured', ''
    for one in result.get('targets', ()):
        yield (one['what'], one['target'], one['measured'], 'met' if one['met'] else '*missed*')
    growth = result.get('growth')
    if growth:
        first, last = growth['first_tenth'], growth['last_tenth']
        yield (f'{growth["frames"]} frames there and back, first and last tenth', 'no growth',
               f'{first["median_ms"]:.1f}, {last["median_ms"]:.1f} ms; '
               f'{last["memory_mb"] - first["memory_mb"]:+.0f} MB at {last["keyframes"]} '
               'keyframes', '')


def references(results: Sequence[Result]) -> Iterator[Row]:
    """Yield the rows of a table of errors beside others' methods, each recording's in turn."""
    yield ('recording', 'method', 'frames', 'geodesic: mean, max', 'seconds for a picture')
    for result in results:
        for name, one in result.get('references', {}).items():
            error = one['geodesic_deg']
            yield (result['recording'], name.split(',')[0],
                   f'{one["frames"]} of {one["frames"] + one["lost_frames"]}',
                   f'{error["mean"]:.2f}, {error["max"]:.2f}°', f'{one["ms_per_frame"] / 1e3:.3f}')


def projections(results: Sequence[Result]) -> Iterator[Row]:
    """Yield the rows of a table of what reading each projection takes."""
    result, = results
    yield 'CPU in ms', 'sphere', 'view', 'grey'
    for name, one in result['projections'].items():
        yield (f'`{name}`', *(f'{one[what]["cpu_ms"]:.0f}' for what in ('sphere', 'view', 'grey')))


def node(results: Sequence[Result]) -> Iterator[Row]:
    """Yield the rows of a table of the node, from the player to the subscriber."""
    result, = results
    yield ('', 'orientations', 'images', 'orientation after p50, p95 in ms',
           'image after p50, p95, p99 in ms', 'CPU player, node, subscriber')
    for name, one in result['scenarios'].items():
        yield (name, f'{one["orientations"]}/{one["frames"]}', f'{one["images"]}/{one["frames"]}',
               _whole(one['orientation_latency_ms'], 'p50', 'p95'),
               _whole(one['latency_ms'], 'p50', 'p95', 'p99'),
               _whole(one['cpu_percent'], 'player', 'node', 'subscriber') + ' %')


def source(results: Sequence[Result]) -> Iterator[Row]:
    """Yield the rows of a table of the node with a source, by width, without and with a view."""
    result, = results
    yield ('H.264 by RTSP', 'orientations', 'p50, p95, p99 in ms', 'views', 'p50, p95, p99 in ms',
           'CPU node, sender', 'load before')
    for key, one in sorted(result.items()):
        if key.startswith('source'):
            views = 'the view as JPEG' if one['views'] else 'nobody wants pictures'
            cells = [cell for name in ('orientations', 'views') for cell in (
                f'{one[name]}/{one["frames"]}' if one[name] else '–',
                _whole(one[f'{name}_latency_ms'], 'p50', 'p95', 'p99'))]
            yield (f'{one["width"]}×{one["width"] // 2} at {one["rate_hz"]:g} Hz, {views}', *cells,
                   _whole(one['cpu_percent'], 'node', 'sender') + ' %',
                   f'{one["machine"]["load_before"]:.1f}')


def page(results: Sequence[Result]) -> Iterator[Row]:
    """Yield the rows of a table of the operator's page, from publishing to pixels."""
    result, = results
    yield ('the browser gets', 'at', 'link', 'Mbit/s', 'drawn',
           'camera to pixels p50, p95 in ms', 'CPU server, node')
    for key, one in result.items():
        if key.startswith(OPERATOR_PAGE):
            yield (_pictures(one), f'{one["rate_hz"]:g} Hz', _link(one['link']),
                   f'{one["mbit_s"]:.1f}', f'{one["drawn"]} of {one["frames"]}',
                   _whole(one['latency_ms'], 'p50', 'p95'),
                   _whole(one['cpu_percent'], 'operator', 'stabilizer') + ' %')


def soak(results: Sequence[Result]) -> Iterator[Row]:
    """Yield the rows of a table of a long run of the node."""
    result, = results
    yield 'seconds', 'frames', 'heartbeats, longest gap', 'memory', 'checks'
    memory = (f'{result["memory_mb"]:.0f} MB, {result["memory_growth_mb"]:+.1f} MB'
              if 'memory_mb' in result else '–')
    yield (str(result['seconds']), str(result['frames']),
           f'{result["heartbeats"]}, {result["longest_gap_s"]:.2f} s', memory,
           'failed' if result['failed'] else 'passed')


def hour(results: Sequence[Result]) -> Iterator[Row]:
    """Yield the rows of a table of what an hour of footage costs, by what is written of it."""
    result, = results
    yield 'width', 'writes', 'CPU, core hours', 'memory, peak', 'read', 'written'
    for one in result['hour']:
        yield (f'{one["width"]} ({one["kind"]})', one['writes'], f'{one["cpu_s"] / 3600:.1f}',
               f'{one["peak_rss_mb"]:.0f} MB', _bytes(one['read_bytes']),
               _bytes(one['written_bytes']))


def workers(results: Sequence[Result]) -> Iterator[Row]:
    """Yield the rows of a table of the days that 10 000 hours take, calculated from ``hour``."""
    result, = results
    counts = 10, 100, 1000
    yield ('', *(f'{count} workers' for count in counts), 'read, written a second by the last')
    for one in result['hour']:
        if one['writes'] != 'bag':
            total_s = 10_000 * one['cpu_s']
            rate = [_bytes(10_000 * one[f'{way}_bytes'] * counts[-1] / total_s)
                    for way in ('read', 'written')]
            yield (f'{one["width"]}, {one["writes"]}',
                   *(f'{total_s / count / 86400:.1f} days' for count in counts),
                   ', '.join(rate))


def split(results: Sequence[Result]) -> Iterator[Row]:
    """Yield the rows of a table of a recording in one run and in segments."""
    result, = results
    yield '', 'CPU of the tasks one after the other', 'geodesic: mean, max', 'per frame: max'
    for name, one in result['split'].items():
        yield (name, ', '.join(f'{cpu_s:.1f}' for cpu_s in one['cpu_s']) + ' s',
               f'{one["geodesic_deg"]["mean"]:.3f}, {one["geodesic_deg"]["max"]:.2f}°',
               f'{one["per_frame_deg"]["max"]:.3f}°')


def stated(results: Sequence[Result]) -> Iterator[Row]:
    """Yield the rows of a table that stands in its file as it is, with where it comes from."""
    result, = results
    yield tuple(result['columns'])
    yield from map(tuple, result['rows'])


def _pictures(one: Mapping[str, Any]) -> str:
    how = {'h264': 'H.264', 'jpeg': 'JPEG'}[one['video']]
    return how + (', derotated by the node' if one['pictures'] == 'stabilizer' else '')


def _link(link: Sequence[float] | None) -> str:
    if not link:
        return 'none'
    mbit_s, round_trip_s, lost = link
    return f'{mbit_s:g} Mbit/s, {1e3 * round_trip_s:g} ms, {100 * lost:g} % lost'


def _whole(values: Mapping[str, float], *keys: str) -> str:
    return ', '.join(f'{values[key]:.0f}' for key in keys) if values else '–'


def _bytes(count: float) -> str:
    return f'{count / 1e9:.1f} GB' if count >= 1e8 else f'{count / 1e6:.0f} MB'


TABLES: dict[str, Table] = {
    'targets': targets, 'projections': projections, 'references': references, 'node': node,
    'source': source, 'page': page, 'soak': soak, 'hour': hour, 'workers': workers,
    'split': split, 'stated': stated}
