# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The figures of an evaluation show what was measured."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sph_stab_ros.evaluate import main
from sph_stab_ros.evaluation.orientation_errors import errors
from sph_stab_ros.images.frame import Frame
from sph_stab_ros.tracking.frame_to_frame.estimators import RotationEstimate

from synthetic import point_pairs, textured_sphere

pytest.importorskip('matplotlib')
paper_figures = pytest.importorskip('sph_stab_ros.evaluation.paper_figures')
plots = pytest.importorskip('sph_stab_ros.evaluation.plots')

R_CURRENT_PREVIOUS = Rotation.from_rotvec((0.02, -0.03, 0.01))
EPIPOLE = np.array((0.6, 0., 0.8))


@pytest.fixture
def measured():
    """Return Errors by estimator, with a pause of two seconds in the truth."""
    t = np.append(np.arange(0, 4, 0.1), np.arange(6, 8, 0.1))
    R = Rotation.from_rotvec(np.transpose((0.2 * np.sin(t), 0.1 * t, 0 * t)))
    return {name: errors((t * 1e9).astype(np.int64), R, R * Rotation.from_rotvec(
        np.transpose((0 * t, error_rad * t, 0 * t))))
        for name, error_rad in (('pts', 0.01), ('moment/dis', 0.002))}


@pytest.fixture
def example():
    """Return an Example whose flow obeys a known rotation and epipole exactly."""
    pairs = point_pairs(np.random.default_rng(0), R_CURRENT_PREVIOUS, 0.2 * EPIPOLE)
    previous, current = textured_sphere(160), textured_sphere(160, R_CURRENT_PREVIOUS.inv())
    return paper_figures.Example(1.5, previous, current, pairs, RotationEstimate(
        R_CURRENT_PREVIOUS, 0., len(pairs), EPIPOLE))


def labels(figure):
    return [label for panel in figure.axes for label in (panel.get_xlabel(), panel.get_ylabel())
            if label]


def test_orientation_is_drawn_against_truth_with_gaps_left_blank(measured):
    figure = plots.orientation_figure('bag', measured)
    assert set(labels(figure)) == {
        'time [s]', *(f'{what}{axis} [deg]' for what in ('', 'error of ')
                      for axis in ('roll', 'pitch', 'yaw'))}
    pitch, pitch_error = figure.axes[2:4]
    assert [line.get_label() for line in pitch.lines] == ['truth', *measured]
    assert [len(line.get_ydata()) for line in pitch_error.lines] == [61, 61]
    assert np.flatnonzero(np.isnan(pitch.lines[1].get_ydata())).tolist() == [40]


def test_estimators_of_different_truth_are_each_drawn_on_their_own(measured):
    measured['pts'] = replace(measured['pts'], truth_rpy_deg=measured['pts'].truth_rpy_deg + 1)
    roll = plots.orientation_figure('bag', measured).axes[0]
    assert [line.get_label() for line in roll.lines] == [
        'truth of pts', 'pts', 'truth of moment/dis', 'moment/dis']


def test_bars_are_as_high_as_the_errors(measured):
    panel, = plots.methods_figure('bag', measured).axes
    heights = sorted(bar.get_height() for bar in panel.patches)
    assert heights == pytest.approx(sorted(
        one.absolute_rpy_deg[:, axis].mean() for one in measured.values() for axis in range(3)))
    assert labels(panel.figure) == ['mean absolute error [deg]']


def test_error_surface_is_lowest_at_the_true_motion(example):
    lowest = paper_figures.cost_deg(example.pairs, R_CURRENT_PREVIOUS, EPIPOLE)
    assert lowest == pytest.approx(0, abs=1e-4)
    aside = Rotation.from_rotvec((0.01, 0, 0)) * R_CURRENT_PREVIOUS
    assert paper_figures.cost_deg(example.pairs, aside, EPIPOLE) > 3
    assert paper_figures.cost_deg(example.pairs, R_CURRENT_PREVIOUS, (0, 0, 1)) > 3


def test_figures_of_flow_are_written(example, tmp_path):
    paper_figures.draw(tmp_path, 'bag', example)
    written = sorted(path.name for path in tmp_path.iterdir())
    assert written == ['derotation.png', 'error_surface.png', 'flow_field.png']
    for name in written:
        assert cv2.imread(str(tmp_path / name)).std() > 10


def test_figures_of_flow_are_labelled_in_degrees(example):
    for figure in (paper_figures.derotation_figure(example),
                   paper_figures.error_surface_figure(example)):
        assert labels(figure)
        assert all('[deg]' in label for label in labels(figure))


class Pictures:
    """A recording of given pictures."""

    name = 'pictures'

    def __init__(self, *greys):
        self._greys = greys

    def frames(self):
        """Yield the pictures at 10 Hz."""
        for number, grey in enumerate(self._greys):
            yield Frame(grey, 5 * 10**9 + number * 10**8)


def test_pictures_without_parallax_are_no_example():
    turning = [textured_sphere(256, Rotation.from_rotvec((0, 0.02 * n, 0))) for n in range(3)]
    assert paper_figures.find_example(Pictures(*turning), 3) is None


def test_evaluate_draws_into_a_folder(turning_bag, tmp_path, capsys):
    folder = tmp_path / 'plots'
    assert main([str(turning_bag), '--inject', '1', '--estimators', 'moment', '--flows', 'dis',
                 '--plots', str(folder)]) == 0
    assert {'orientation.png', 'methods.png'} <= {path.name for path in folder.iterdir()}


def test_plots_into_a_file_are_refused_before_the_work(turning_bag, tmp_path, capsys):
    file = tmp_path / 'file'
    file.touch()
    assert main([str(turning_bag), '--inject', '1', '--plots', str(file)]) == 1
    captured = capsys.readouterr()
    assert captured.out == '' and 'cannot be written' in captured.err
