# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Figures of a replay: how the camera turned, how the pictures turn, how sure that is."""

from collections.abc import Iterator

from matplotlib.axes import Axes
from matplotlib.figure import Figure
import numpy as np

from sph_stab_ros.evaluation.orientation_errors import roll_pitch_yaw_deg
from sph_stab_ros.evaluation.plots import AXES, COLOURS
from sph_stab_ros.evaluation.replay_log import ReplayLog
from sph_stab_ros.tracking.base import MAX_OK_SIGMA_RAD

RECORDED, SHOWN = COLOURS[1], COLOURS[0]
# What is not tracked well is shaded.
SHADES = {'uncertain': '#f0e442', 'predicted': COLOURS[3], 'lost': '#999999'}


def figures(log: ReplayLog) -> Iterator[tuple[str, Figure]]:
    """Yield Figures with what they show."""
    yield ('Orientation of the camera, which is taken out of the pictures, and of the virtual '
           'camera that shows them.', orientation_figure(log))
    yield ('By how much the picture turns from one frame to the next: as recorded, and as shown, '
           'both as far as the orientation found is right.', steps_figure(log))
    yield ('One standard deviation of the orientation; from the dashed line on it is uncertain. '
           'Shaded: frames of which the status is not ok.', uncertainty_figure(log))
    yield 'Where the middle of the picture looks in the world, to the right positive.', (
        directions_figure(log))


def orientation_figure(log: ReplayLog) -> Figure:
    """Return a Figure of roll, pitch and yaw of both cameras."""
    figure = Figure(figsize=(10, 6), layout='constrained')
    panels = figure.subplots(3, 1, sharex=True)
    for label, colour, R in (('camera', RECORDED, log.R_world_camera),
                             ('virtual camera', SHOWN, log.R_world_virtual)):
        for panel, name, angles in zip(panels, AXES, roll_pitch_yaw_deg(R).T):
            panel.plot(log.time_s, angles, color=colour, linewidth=1.2, label=label)
            panel.set_ylabel(f'{name} [deg]')
    figure.legend(*panels[0].get_legend_handles_labels(), loc='outside upper right', ncols=2)
    finish(panels, log)
    return figure


def steps_figure(log: ReplayLog) -> Figure:
    """Return a Figure of the turns from frame to frame."""
    figure = Figure(figsize=(10, 3), layout='constrained')
    panel = figure.subplots()
    for label, colour, R in (('recorded', RECORDED, log.R_world_camera),
                             ('shown', SHOWN, log.R_world_virtual)):
        # Of the first one from itself, since a replay may have but one frame.
        steps = R[np.maximum(np.arange(len(R)) - 1, 0)].inv() * R
        panel.plot(log.time_s, np.rad2deg(steps.magnitude()), color=colour, linewidth=1,
                   label=label)
    panel.set_ylabel('step [deg]')
    panel.set_ylim(bottom=0)
    figure.legend(loc='outside upper right', ncols=2)
    finish([panel], log)
    return figure


def uncertainty_figure(log: ReplayLog) -> Figure:
    """Return a Figure of how sure the orientation is."""
    figure = Figure(figsize=(10, 2.5), layout='constrained')
    panel = figure.subplots()
    panel.plot(log.time_s, log.uncertainty_deg, color=SHOWN, linewidth=1.2)
    panel.axhline(np.rad2deg(MAX_OK_SIGMA_RAD), color='black', linestyle='--', linewidth=0.8)
    panel.set_ylabel('σ [deg]')
    panel.set_ylim(bottom=0)
    finish([panel], log)
    if {*log.statuses} & {*SHADES}:
        panel.legend(loc='upper right')
    return figure


def directions_figure(log: ReplayLog) -> Figure:
    """Return a Figure of where both cameras look, on a map of the sphere."""
    figure = Figure(figsize=(10, 5), layout='constrained')
    panel = figure.add_subplot(projection='mollweide')
    for label, colour, R in (('camera', RECORDED, log.R_world_camera),
                             ('virtual camera', SHOWN, log.R_world_virtual)):
        x, y, z = R.apply((0, 0, 1)).T
        panel.plot(np.arctan2(x, z), -np.arcsin(np.clip(y, -1, 1)), '.', color=colour,
                   markersize=2.5, label=label)
    panel.grid(alpha=0.3)
    figure.legend(loc='outside upper right', markerscale=4)
    return figure


def finish(panels: list[Axes], log: ReplayLog) -> None:
    """Shade what is not tracked well; name the time."""
    statuses = np.array(log.statuses)
    for panel in panels:
        panel.grid(alpha=0.3)
        panel.margins(x=0)
        for status, colour in SHADES.items():
            # Each until the next frame.
            is_so = statuses == status
            is_so[1:] |= is_so[:-1].copy()
            if is_so.any():
                panel.fill_between(
                    log.time_s, 0, 1, where=is_so, color=colour, alpha=0.35, linewidth=0,
                    transform=panel.get_xaxis_transform(), label=status)
    panels[-1].set_xlabel('time [s]')
