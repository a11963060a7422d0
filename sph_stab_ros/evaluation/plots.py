# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Figures of an evaluation: orientations against truth, errors over time, methods compared."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator
import numpy as np

from sph_stab_ros.evaluation.orientation_errors import Errors
from sph_stab_ros.geometry.arrays import Values

AXES = ('roll', 'pitch', 'yaw')
# Okabe and Ito's, apart for colour-blind eyes and on grey paper; black is the truth's.
COLOURS = ('#0072b2', '#d55e00', '#009e73', '#cc79a7', '#e69f00', '#56b4e9')
LINES = ('-', '--', '-.', (0, (4, 1, 1, 1, 1, 1)))
DPI = 200
# Errors of the methods differ by factors of a hundred; smaller ones than this are of no interest.
MIN_ERROR_DEG = 0.01
# Longer pauses are left blank.
GAP_INTERVALS = 2.5


def draw(folder: Path, title: str, errors: Mapping[str, Errors]) -> None:
    """Write ``orientation.png`` and ``methods.png`` of Errors by estimator into a folder."""
    for name, figure in (('orientation', orientation_figure(title, errors)),
                         ('methods', methods_figure(title, errors))):
        figure.savefig(folder / f'{name}.png', dpi=DPI)


def orientation_figure(title: str, errors: Mapping[str, Errors]) -> Figure:
    """
    Return a Figure of roll, pitch, yaw against truth, and their absolute errors (Fig. 16).

    The truth of injected rotations differs between estimators: broad and pale beneath each.
    """
    figure = Figure(figsize=(10, 7), layout='constrained')
    figure.suptitle(f'{title}: orientation of the body relative to the first frame')
    panels = figure.subplots(3, 2, sharex=True)
    first, *others = errors.values()
    one_truth = all(np.array_equal(one.truth_rpy_deg, first.truth_rpy_deg) for one in others)
    for axis, (angle_panel, error_panel) in enumerate(panels):
        if one_truth:
            angle_panel.plot(*_with_gaps(first.time_s, first.truth_rpy_deg[:, axis]),
                             color='black', linewidth=2.2, label='truth')
        for number, (name, one) in enumerate(errors.items()):
            style = _style(number)
            if not one_truth:
                angle_panel.plot(*_with_gaps(one.time_s, one.truth_rpy_deg[:, axis]), alpha=0.3,
                                 color=style['color'], linewidth=5, label=f'truth of {name}')
            angle_panel.plot(*_with_gaps(one.time_s, one.estimate_rpy_deg[:, axis]),
                             label=name, **style)
            error_panel.plot(*_with_gaps(one.time_s, one.absolute_rpy_deg[:, axis]), **style)
        angle_panel.set_ylabel(f'{AXES[axis]} [deg]')
        error_panel.set_ylabel(f'error of {AXES[axis]} [deg]')
        _logarithmic(error_panel)
    panels[0, 0].set_title('orientation')
    panels[0, 1].set_title('absolute error')
    for panel in panels.flat:
        panel.grid(alpha=0.3)
        panel.margins(x=0)
    for panel in panels[-1]:
        panel.set_xlabel('time [s]')
    figure.legend(*panels[0, 0].get_legend_handles_labels(), loc='outside lower center',
                  ncols=4)
    return figure


def methods_figure(title: str, errors: Mapping[str, Errors]) -> Figure:
    """Return a Figure of the mean absolute error of each angle by each estimator (Table 1)."""
    # Wide enough for the title where there is one estimator only.
    figure = Figure(figsize=(max(1.6 + 1.5 * len(errors), 5), 4), layout='constrained')
    panel = figure.subplots()
    panel.set_title(f'{title}: mean absolute error')
    for axis, name in enumerate(AXES):
        heights = [one.absolute_rpy_deg[:, axis].mean() for one in errors.values()]
        bars = panel.bar(np.arange(len(errors)) + 0.27 * (axis - 1), heights, 0.25, label=name,
                         color=COLOURS[axis])
        panel.bar_label(bars, fmt='%.2f', fontsize=7, padding=1)
    panel.set_xticks(range(len(errors)), [name.replace('/', '\n') for name in errors])
    panel.set_ylabel('mean absolute error [deg]')
    _logarithmic(panel)
    # Room for the number on the highest bar.
    panel.set_ylim(top=1.4 * panel.get_ylim()[1])
    panel.grid(axis='y', alpha=0.3)
    panel.set_axisbelow(True)
    # Beside the bars, none of which it hides there.
    figure.legend(loc='outside right upper')
    return figure


def _logarithmic(panel: Axes) -> None:
    panel.set_yscale('log')
    panel.set_ylim(bottom=MIN_ERROR_DEG)
    panel.yaxis.set_major_formatter('{x:g}')
    # Where there is but one power of ten the axis would have one number, or powers beside it.
    panel.yaxis.set_minor_locator(LogLocator(subs=(2, 5)))
    panel.yaxis.set_minor_formatter('{x:g}')


def _style(number: int) -> dict[str, Any]:
    return {'color': COLOURS[number % len(COLOURS)], 'linewidth': 1.2,
            'linestyle': LINES[number % len(LINES)]}


def _with_gaps(time_s: Values, values: Values) -> tuple[Values, Values]:
    """Return both (N + gaps,) with a NaN where frames are missing, so that no line is drawn."""
    intervals_s = np.diff(time_s)
    before = np.flatnonzero(intervals_s > GAP_INTERVALS * np.median(intervals_s)) + 1
    return np.insert(time_s, before, np.nan), np.insert(values, before, np.nan)
