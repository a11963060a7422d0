# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The lines that ``evaluate`` prints."""

from collections.abc import Iterator, Mapping
from typing import Any, TypeAlias

import numpy as np

from sph_stab_ros.command_line.columns import in_columns
from sph_stab_ros.evaluation.alignment import Alignment
from sph_stab_ros.geometry.conventions import NS_PER_S, R_CAMERA_BODY

# Figures by name, as they are written to JSON.
Figures: TypeAlias = dict[str, Any]


def error_lines(figures: Mapping[str, Figures], of_gyro: bool = False) -> Iterator[str]:
    """
    Yield lines of figures by estimator, a table, and another one over time where it is told.

    Where the truth is ``of_gyro`` only what it can tell is in the table.
    """
    left_out = max(one['frames_not_evaluated'] for one in figures.values())
    if left_out:
        yield (f'{left_out} frames are not evaluated: before, after or in a gap of the truth, or '
               'with a stamp that goes back')
    yield from (_table_of_turns if of_gyro else _table)(figures)
    if all('over_time' in one for one in figures.values()):
        yield from _table_over_time(figures)


def _table(figures: Mapping[str, Figures]) -> Iterator[str]:
    rows: list[tuple[str, ...]] = [
            ('estimator', 'roll', 'pitch', 'yaw', 'mean', 'max', 'end', 'median', 'p95', 'max',
             'drift', 'time', 'frames', 'lost'),
            ('', *3 * ('|deg|',), *6 * ('deg',), 'deg/min', 'ms', '', '')]
    for name, one in figures.items():
        degrees = (one[group][key] for group, keys in (
            ('mean_abs_error_deg', ('roll', 'pitch', 'yaw')),
            ('geodesic_deg', ('mean', 'max', 'end')),
            ('per_frame_deg', ('median', 'p95', 'max'))) for key in keys)
        rows.append((name, *(f'{value:.3f}' for value in degrees),
                     f'{one["drift_deg_per_min"]:.2f}', f'{one["ms_per_frame"]:.1f}',
                     f'{one["frames"]}', f'{one["lost_frames"]}'))
    widths = [max(map(len, column)) for column in zip(*rows)]
    groups = (sum(widths[i:i + 3]) + 4 for i in (1, 4, 7))
    titles = ('mean absolute', 'geodesic', 'per frame')
    yield '  '.join((widths[0] * ' ', *map(str.center, titles, groups))).rstrip()
    yield from in_columns(rows)


def _table_of_turns(figures: Mapping[str, Figures]) -> Iterator[str]:
    rows: list[tuple[str, ...]] = [
            ('estimator', 'frame: median', 'p95', 'max', 'second: median', 'p95', 'max', 'time',
             'frames', 'lost'),
            ('', *6 * ('deg',), 'ms', '', '')]
    for name, one in figures.items():
        degrees = (one[group][key] for group in ('per_frame_deg', 'per_second_deg')
                   for key in ('median', 'p95', 'max'))
        rows.append((name, *(f'{value:.3f}' for value in degrees), f'{one["ms_per_frame"]:.1f}',
                     f'{one["frames"]}', f'{one["lost_frames"]}'))
    yield from in_columns(rows)


def _table_over_time(figures: Mapping[str, Figures]) -> Iterator[str]:
    times_s = next(iter(figures.values()))['over_time']['time_s']
    yield 'geodesic [deg] after'
    yield from in_columns([
        ('', *(f'{time_s:.0f} s' for time_s in times_s)),
        *((name, *(f'{error:.3f}' for error in one['over_time']['geodesic_deg']))
          for name, one in figures.items())])


def describe(alignment: Alignment, mount_given: bool) -> Figures:
    """Return the Alignment as figures; the mount's angles as ``--mount`` takes them."""
    yaw, pitch, roll = (R_CAMERA_BODY * alignment.R_body_camera).as_euler(
        'YXZ', degrees=True).tolist()
    return {
        'mount': {
            'source': 'given' if mount_given else
                      'solved' if alignment.mount_solved else 'assumed',
            'yaw_deg': -yaw, 'pitch_deg': pitch, 'roll_deg': roll},
        'clock_offset_s': alignment.clock_offset_ns / NS_PER_S,
    } | ({} if alignment.gyro_bias_rad_s is None else {
        'gyro_bias_deg_s': np.rad2deg(alignment.gyro_bias_rad_s).tolist()})


def alignment_lines(about: Figures, clock_solved: bool) -> Iterator[str]:
    """Yield lines for people of what ``describe`` returned."""
    mount = about['mount']
    if mount['source'] == 'assumed':
        yield ('mount: cannot be solved for, the motion does not span two axes; assumed is a '
               'camera that looks forward on a REP 103 body (another: --mount YAW,PITCH,ROLL)')
    else:
        yield (f'mount, {mount["source"]}: on the body the camera looks {mount["yaw_deg"]:.2f} '
               f'deg to the left, {mount["pitch_deg"]:.2f} up, rolled by {mount["roll_deg"]:.2f}')
    how = 'found' if clock_solved else 'given'
    yield f'clock offset, {how}: {about["clock_offset_s"]:+.4f} s (stamps of truth minus images)'
    if 'gyro_bias_deg_s' in about:
        x, y, z = about['gyro_bias_deg_s']
        yield (f'the truth is a gyro, less a bias of {x:+.3f}, {y:+.3f}, {z:+.3f} deg/s about the '
               "body's axes that the estimate tells; what is left drifts, so errors are told over "
               'a frame and a second')


def injection_line(about: Figures, figures: Mapping[str, Figures]) -> str:
    """Return a line for people on what was injected, and on the clip itself."""
    kept = f' except {about["body"]}' if about['body'] else ''
    turns = ', '.join(f'{name} {one["clip_turn_deg"]:.1f} deg' for name, one in figures.items())
    return (f'turned by the known rotations of seed {about["injected_seed"]}{kept}; of the clip '
            f'itself these turns were found: {turns}')
