# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Tables over all recordings: why some failed, and how the others compare with the truth."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sph_stab_ros.batch.results import EVALUATION, manifest_of, read_json, write_json
from sph_stab_ros.command_line.columns import in_columns

HEAD = ('recording', 'mean', 'max', 'end', 'median', 'p95', 'max', 'frames', 'lost')
UNITS = ('', *6 * ('deg',), '', '')


def failure_lines(failures: Mapping[str, str]) -> Iterator[str]:
    """Yield a line for each failure, by name."""
    width = max(map(len, failures), default=0)
    for name, reason in sorted(failures.items()):
        yield f'{name.ljust(width)}  {reason}'


def evaluation_lines(out: Path, names: Sequence[str]) -> Iterator[str]:
    """Yield one table over all results that have truth, and write it as JSON."""
    rows: list[tuple[str, ...]] = []
    table: dict[str, dict[str, Any]] = {}
    without, errors = 0, {}
    for name in names:
        figures, manifest = read_json(out / name / EVALUATION), manifest_of(out / name)
        if not figures or manifest is None:
            continue
        without += 'no_truth' in figures
        if 'error' in figures:
            errors[name] = figures['error']
        if 'geodesic_deg' in figures:
            lost = manifest['frames'] - manifest['statuses'].get('ok', 0)
            table[name] = {**figures, 'lost_frames': lost}
            degrees = [figures[group][key] for group, keys in (
                ('geodesic_deg', ('mean', 'max', 'end')),
                ('per_frame_deg', ('median', 'p95', 'max'))) for key in keys]
            rows.append((name, *(f'{value:.3f}' for value in degrees),
                         f'{figures["frames"]}', f'{lost}'))
    if rows:
        means = np.mean([[float(cell) for cell in row[1:7]] for row in rows], axis=0)
        rows.append((f'mean of {len(rows)}', *(f'{value:.3f}' for value in means), '', ''))
        yield 'geodesic error, then that from frame to frame'
        yield from in_columns([HEAD, UNITS, *rows])
    if without:
        yield f'{without} have no truth'
    yield from failure_lines(errors)
    write_json(out / EVALUATION, table)
