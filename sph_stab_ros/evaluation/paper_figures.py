# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""
The paper's figures of flow on the sphere, from two consecutive pictures of a recording.

``flow_field``: spherical flow of rotation alone and of translation alone (Fig. 3);
``derotation``: flow before and after derotation, with the epipolar circles on which it then lies,
and their difference, the flow of the rotation (Fig. 7 a to c); ``error_surface``: the cost of the
direct epipolar estimator over rotation and epipole (Fig. 8).
"""

from collections.abc import Iterable
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle
import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from sph_stab_ros.geometry.arrays import (
    Bearings, Floats, Grey, Indices, Values, Vector, Vectors)
from sph_stab_ros.geometry.conventions import NS_PER_S
from sph_stab_ros.geometry.equirect import bearings_from_pixels, pixels_from_bearings
from sph_stab_ros.geometry.projection import to_grey
from sph_stab_ros.geometry.warp import rotate_equirect
from sph_stab_ros.recording import decoded_frames, Recording
from sph_stab_ros.tracking.frame_to_frame.estimators import (
    BearingPairs, FitStatus, RotationEstimate)
from sph_stab_ros.tracking.frame_to_frame.estimators.epipolar import flow_angles, tangent_basis
from sph_stab_ros.tracking.frame_to_frame.methods import ImagePair, Sphere
from sph_stab_ros.tracking.frame_to_frame.optical_flow import dense_pairs

DPI = 200
WIDTH = 480
FLOW = 'dis'
# Of so many pairs of the recording the one with the strongest parallax is drawn.
CANDIDATES = 8

FLOW_COLOUR, CIRCLE_COLOUR, AXIS_COLOUR = '#d55e00', '#0072b2', '#cc00cc'
ARROWS = 700
# How long the arrows are drawn than which one in ten is longer.
ARROW_DEG = 12.0
EPIPOLAR_CIRCLES = 12
# Nearer to the poles arrows in an equirectangular picture say little.
MAX_LATITUDE_DEG = 80
# How far the axis of the motion is turned out of the middle of a drawn half sphere.
TILT_RAD = np.deg2rad(55)
REACH_DEG = 5.0
SURFACE_PAIRS = 3000


@dataclass(frozen=True)
class Example:
    """Two consecutive grey spheres, their flow, and what ``pts_epipolar`` makes of it."""

    time_s: float
    previous: Grey
    current: Grey
    pairs: BearingPairs
    estimate: RotationEstimate

    @property
    def epipole(self) -> Vector:
        """Return the unit epipole in the current frame."""
        assert self.estimate.t_current is not None
        return self.estimate.t_current

    @property
    def parallax_rad(self) -> float:
        """Median angle of the derotated flow."""
        moved = self.estimate.R_current_previous.apply(self.pairs.previous)
        return float(np.median(np.linalg.norm(self.pairs.current - moved, axis=1)))


def find_example(recording: Recording, frames: int) -> Example | None:
    """Return the Example of the strongest parallax in so many frames, None if there is none."""
    wanted = set(np.linspace(1, frames - 1, CANDIDATES, dtype=int).tolist())
    examples: list[Example | None] = []
    previous, first_ns = None, None
    with closing(decoded_frames(recording)) as pictures:
        for number, frame in zip(range(frames), pictures):
            first_ns = first_ns or frame.stamp_ns
            if number in wanted and previous is not None:
                examples.append(make_example((frame.stamp_ns - first_ns) / NS_PER_S, previous,
                                             to_grey(frame.image, WIDTH)))
            if number + 1 in wanted:
                previous = to_grey(frame.image, WIDTH)
    return max(filter(None, examples), key=lambda one: one.parallax_rad, default=None)


def make_example(time_s: float, previous: Grey, current: Grey) -> Example | None:
    """Return the Example of two grey spheres, or None where no epipole can be told."""
    # Unbounded, the estimator's own minimum is the one of the surface of Eq. 8.
    estimate = ImagePair(
        Sphere(previous), Sphere(current), FLOW, epipolar_bound_rad=np.inf).pts_epipolar()
    pairs = dense_pairs(previous, current, FLOW)
    if estimate is None or estimate.status is not FitStatus.OK or pairs is None:
        return None
    return Example(time_s, previous, current, pairs, estimate)


def draw(folder: Path, title: str, example: Example) -> None:
    """Write the figures of an Example into an existing folder."""
    for name, what, figure in (
            ('flow_field', 'spherical flow', flow_field_figure(example)),
            ('derotation', 'optical flow', derotation_figure(example)),
            ('error_surface', 'error of the epipolar constraint', error_surface_figure(example))):
        figure.suptitle(f'{title} at {example.time_s:.2f} s: {what}')
        figure.savefig(folder / f'{name}.png', dpi=DPI)


def flow_field_figure(example: Example) -> Figure:
    """
    Return a Figure of the flow of rotation alone and of translation alone on half spheres.

    Both are measured: between the first picture and the same turned, and between the first and
    the second picture derotated.
    """
    R = example.estimate.R_current_previous
    turned = rotate_equirect(example.previous, R.inv())
    derotated = rotate_equirect(example.current, R)
    axis = R.as_rotvec() / max(R.magnitude(), 1e-12)
    epipole = R.inv().apply(example.epipole)
    figure = Figure(figsize=(10, 5.4), layout='constrained')
    for panel, current, direction, mark, title in zip(
            figure.subplots(1, 2), (turned, derotated), (axis, epipole), ('axis', 'epipole'),
            (f'rotation by {np.rad2deg(R.magnitude()):.2f} deg', 'translation')):
        pairs = dense_pairs(example.previous, current, FLOW)
        assert pairs is not None, 'a picture keeps its texture when it is turned'
        magnified = _draw_half_sphere(panel, pairs, direction, mark)
        panel.set_title(f'{title} (arrows {magnified:.0f}× as long)')
    return figure


def derotation_figure(example: Example) -> Figure:
    """Return a Figure of the flow before and after derotation, and of their difference."""
    R, q = example.estimate.R_current_previous, example.epipole
    sample = example.pairs[_spread(example.pairs.previous)]
    x, moved = sample.previous, sample.current
    derotated = R.apply(x)
    figure = Figure(figsize=(8, 11), layout='constrained')
    panels = figure.subplots(3, 1)
    for panel, picture, start, end, title in zip(
            panels, (example.previous, example.current, example.previous),
            (x, derotated, x), (moved, moved, derotated),
            ('(a) before derotation', '(b) after derotation, on epipolar circles',
             '(c) difference of the two: flow of the rotation')):
        magnified = _draw_flow(panel, picture, start, end)
        panel.set_title(f'{title} (arrows {magnified:.0f}× as long)')
    _draw_epipolar_circles(panels[1], q)
    return figure


def error_surface_figure(example: Example) -> Figure:
    """Return a Figure of the root mean square of Ω (Eq. 8) over rotation and over epipole."""
    R, q = example.estimate.R_current_previous, example.epipole
    pairs = example.pairs[::-(-len(example.pairs) // SURFACE_PAIRS)]
    turns_deg = np.linspace(-REACH_DEG, REACH_DEG, 41)
    over_rotation = [[
        cost_deg(pairs, Rotation.from_euler('XYZ', (a, b, 0), degrees=True) * R, q)
        for b in turns_deg] for a in turns_deg]
    lon_deg, lat_deg = np.linspace(-180, 180, 73), np.linspace(-90, 90, 37)
    over_epipole = [[cost_deg(pairs, R, _bearing(lon, lat)) for lon in lon_deg] for lat in lat_deg]

    figure = Figure(figsize=(11, 4.2), layout='constrained')
    rotation, epipole = figure.subplots(1, 2, width_ratios=(1, 1.7))
    _draw_surface(figure, rotation, turns_deg, turns_deg, over_rotation, (0, 0))
    rotation.set(xlabel='β − estimate [deg]', ylabel='α − estimate [deg]', aspect='equal',
                 title='over rotation, epipole as estimated')
    _draw_surface(figure, epipole, lon_deg, lat_deg, over_epipole, _lon_lat_deg(q))
    epipole.set(xlabel='longitude of the epipole [deg]', ylabel='latitude [deg]', aspect='equal',
                title='over epipole, rotation as estimated')
    return figure


def cost_deg(pairs: BearingPairs, R_current_previous: Rotation, q: Vector) -> float:
    """Return the root of the weighted mean of Ω² (Eq. 8) in degrees."""
    weights = pairs.weights / pairs.weights.sum()
    return np.rad2deg(np.sqrt(weights @ flow_angles(pairs, R_current_previous, q) ** 2))


def _draw_surface(figure: Figure, panel: Axes, x: Values, y: Values, cost_deg: list[list[float]],
                  found: Iterable[float]) -> None:
    surface = panel.contourf(x, y, cost_deg, levels=24, cmap='viridis')
    panel.contour(x, y, cost_deg, levels=24, colors='white', linewidths=0.3)
    panel.plot(*found, 'x', color='white', markersize=9, markeredgewidth=2.5)
    panel.plot(*found, 'x', color=FLOW_COLOUR, markersize=8, markeredgewidth=1.5)
    figure.colorbar(surface, ax=panel, label='RMS of Ω [deg]', shrink=0.85, format='%.0f')


def _draw_flow(panel: Axes, picture: Grey, start: Bearings, end: Bearings) -> float:
    """Draw arrows between bearings (N, 3) over a grey sphere; return how much longer they are."""
    factor = _magnification(end - start)
    panel.imshow(picture, cmap='gray', extent=(-180, 180, -90, 90), alpha=0.55)
    here = _lon_lat_deg(start)
    there = _lon_lat_deg(start + factor * (end - start))
    step = there - here
    step[:, 0] = (step[:, 0] + 180) % 360 - 180
    drawn = np.abs(here[:, 1]) < MAX_LATITUDE_DEG
    panel.quiver(*here[drawn].T, *step[drawn].T, color=FLOW_COLOUR, angles='xy',
                 scale_units='xy', scale=1, width=0.0016, headwidth=4)
    panel.set(xlim=(-180, 180), ylim=(-90, 90), xticks=range(-180, 181, 60),
              yticks=range(-90, 91, 45), xlabel='longitude [deg]', ylabel='latitude [deg]')
    return factor


def _draw_epipolar_circles(panel: Axes, q: Vector) -> None:
    """Draw great circles through the epipole q (3,), and q itself and its antipode."""
    along = np.linspace(0, np.pi, 400)
    for around in np.linspace(0, 2 * np.pi, EPIPOLAR_CIRCLES, endpoint=False):
        side = tangent_basis(q) @ (np.cos(around), np.sin(around))
        lon, lat = _lon_lat_deg(np.cos(along)[:, None] * q + np.sin(along)[:, None] * side).T
        lon[np.append(False, np.abs(np.diff(lon)) > 180)] = np.nan
        panel.plot(lon, lat, color=CIRCLE_COLOUR, linewidth=0.8)
    for bearing, face, label in ((q, AXIS_COLOUR, 'epipole'), (-q, 'none', 'its antipode')):
        panel.plot(*_lon_lat_deg(bearing), 'o', markersize=9, markeredgewidth=2,
                   color=AXIS_COLOUR, markerfacecolor=face, label=label, linestyle='none')
    panel.legend(loc='lower right')


def _draw_half_sphere(panel: Axes, pairs: BearingPairs, direction: Vector, mark: str) -> float:
    """
    Draw the flow on the half sphere that shows a unit direction (3,), marked, above its middle.

    Return how much longer the arrows are.
    """
    sample = pairs[_spread(pairs.previous)]
    right = tangent_basis(direction)[:, 0]
    towards = np.cos(TILT_RAD) * direction + np.sin(TILT_RAD) * np.cross(direction, right)
    onto = np.array((right, np.cross(towards, right), towards))
    if onto[1] @ direction < 0:
        onto[:2] *= -1
    flow = sample.current - sample.previous
    factor = _magnification(flow)
    u, v, depth = onto @ sample.previous.T
    du, dv, _ = factor * (onto @ flow.T)
    front = depth > 0.05
    panel.add_patch(Circle((0, 0), 1, facecolor='0.95', edgecolor='0.5'))
    panel.quiver(u[front], v[front], du[front], dv[front], color=FLOW_COLOUR, angles='xy',
                 scale_units='xy', scale=1, width=0.003)
    panel.plot(*(onto @ direction)[:2], 'o', color=AXIS_COLOUR, markersize=9, label=mark)
    panel.set(xlim=(-1.08, 1.08), ylim=(-1.08, 1.08), aspect='equal')
    panel.set_axis_off()
    panel.legend(loc='lower right')
    return factor


def _magnification(flow: Vectors) -> float:
    return np.deg2rad(ARROW_DEG) / np.percentile(np.linalg.norm(flow, axis=1), 90)


def _spread(bearings: Bearings) -> Indices:
    """Return indices of bearings (N, 3) that lie evenly on the sphere (a Fibonacci lattice)."""
    number = np.arange(ARROWS) + 0.5
    y = 1 - 2 * number / ARROWS
    lon = np.pi * (1 + np.sqrt(5)) * number
    radius = np.sqrt(1 - y * y)
    lattice = np.stack((radius * np.sin(lon), y, radius * np.cos(lon)), axis=-1)
    return np.unique(cKDTree(bearings).query(lattice)[1])


def _lon_lat_deg(bearings: Bearings) -> Floats:
    """Return longitudes and latitudes (..., 2) in degrees of bearings (..., 3)."""
    # A picture 360 px wide has a pixel for each degree; pixel centres are integers.
    return (pixels_from_bearings(bearings, 360) + 0.5) * (1, -1) + (-180, 90)


def _bearing(lon_deg: float, lat_deg: float) -> Vector:
    """Return the bearing (3,) of a longitude and a latitude in degrees."""
    return bearings_from_pixels((lon_deg + 179.5, 89.5 - lat_deg), 360)
