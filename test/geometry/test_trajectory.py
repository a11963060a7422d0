# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Trajectories: slerp, and TUM files."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sph_stab_ros.geometry.trajectory import read_tum, Trajectory, tum_line, write_tum

SINCE_1970_NS = 1_700_000_000_123_456_789


def random_trajectory(count=20, seed=0):
    """Return a Trajectory with irregular stamps and unrelated orientations."""
    rng = np.random.default_rng(seed)
    stamps_ns = SINCE_1970_NS + np.cumsum(rng.integers(1, 10**8, count))
    return Trajectory(stamps_ns, Rotation.random(count, seed))


def angles_rad(R_a, R_b):
    """Return the angles between rotations."""
    return (R_a.inv() * R_b).magnitude()


def test_at_its_own_stamps_a_trajectory_is_itself():
    """Slerp interpolates."""
    trajectory = random_trajectory()
    assert angles_rad(trajectory.at(trajectory.stamps_ns), trajectory.rotations).max() < 1e-7


def test_between_two_stamps_the_turn_is_even():
    """A constant angular velocity is reproduced at every stamp, to the nanosecond."""
    axis = np.array((0.6, 0., 0.8))
    stamps_ns = SINCE_1970_NS + np.array((0, 400, 1000)) * 10**6
    coarse = Trajectory(stamps_ns, Rotation.from_rotvec(np.outer((0., 0.4, 1.), axis)))
    asked_ns = SINCE_1970_NS + np.array((0, 100, 333, 401, 999, 1000)) * 10**6 + (0, 1, 2, 3, 4, 0)
    expected = Rotation.from_rotvec(np.outer((asked_ns - SINCE_1970_NS) / 1e9, axis))
    assert angles_rad(coarse.at(asked_ns), expected).max() < 1e-8


def test_outside_of_it_there_are_no_orientations():
    """A trajectory does not extrapolate."""
    trajectory = random_trajectory()
    first, last = trajectory.stamps_ns[[0, -1]]
    asked_ns = np.array((first - 1, first, last, last + 1))
    assert list(trajectory.covers(asked_ns)) == [False, True, True, False]
    for outside in asked_ns[[0, 3]]:
        with pytest.raises(ValueError, match='outside'):
            trajectory.at([outside])


def test_a_single_orientation_is_a_trajectory():
    """One pose can be asked for at its own stamp."""
    R = Rotation.random(1, 1)
    assert angles_rad(Trajectory([5], R).at([5]), R).max() < 1e-9


def test_relative_to_first_forgets_the_world_and_keeps_the_motion():
    """R_first⁻¹ R begins with the identity and does not change with the world."""
    trajectory = random_trajectory()
    R_other_world = Rotation.random(None, 7)
    moved = Trajectory(trajectory.stamps_ns, R_other_world * trajectory.rotations)
    relative = trajectory.relative_to_first()
    assert relative.rotations[0].magnitude() < 1e-9
    assert angles_rad(relative.rotations, moved.relative_to_first().rotations).max() < 1e-7


@pytest.mark.parametrize('stamps_ns, count', [([], 0), ([1, 2], 3), ([1, 1], 2), ([2, 1], 2)])
def test_stamps_must_increase_and_match(stamps_ns, count):
    """A trajectory refuses stamps that it could not interpolate between."""
    with pytest.raises(ValueError):
        Trajectory(stamps_ns, Rotation.from_rotvec(np.zeros((count, 3))))


@pytest.mark.parametrize('stamp_ns, text', [
    (0, '0.000000000'), (1, '0.000000001'), (1_700_000_000_000_000_001, '1700000000.000000001'),
    (33_333_333, '0.033333333'), (-1, '-0.000000001'), (-1_500_000_000, '-1.500000000')])
def test_tum_stamps_keep_every_nanosecond(stamp_ns, text):
    """Stamps are written from integers; a float would round those of our days."""
    zero, one = '0.000000000', '1.000000000'
    line = f'{text} 0 0 0 {zero} {zero} {zero} {one}\n'
    assert tum_line(stamp_ns, Rotation.identity()) == line


def test_tum_files_are_read_as_written(tmp_path):
    """Writing and reading give the same stamps and orientations."""
    trajectory = random_trajectory()
    path = tmp_path / 'a.tum'
    write_tum(path, trajectory)
    path.write_text('# a comment\n\n' + path.read_text())
    again = read_tum(path)
    assert np.array_equal(again.stamps_ns, trajectory.stamps_ns)
    assert angles_rad(again.rotations, trajectory.rotations).max() < 1e-8


def test_lines_that_are_not_later_are_left_out(tmp_path, caplog):
    """The file of a recording with repeated stamps is a trajectory all the same."""
    path = tmp_path / 'a.tum'
    path.write_text(''.join(tum_line(ns, Rotation.identity()) for ns in (1, 2, 2, 1, 3)))
    assert list(read_tum(path).stamps_ns) == [1, 2, 3]
    assert '2 lines' in caplog.text


def test_quaternions_that_are_not_of_unit_length_are_normalised_and_told(tmp_path, caplog):
    path = tmp_path / 'a.tum'
    path.write_text('1 0 0 0 0 0 0 1.009\n2 0 0 0 3 0 0 4\n3 0 0 0 0.6 0 0 0.8\n')
    found = read_tum(path).rotations
    assert angles_rad(found[1], found[2]) < 1e-8
    assert '1 lines with a quaternion not of unit length' in caplog.text


@pytest.mark.parametrize('line', ['1 0 0 0 0 0 1', '1 0 0 0 0 0 0 x', 'x 0 0 0 0 0 0 1', '1 2 3'])
def test_what_is_not_tum_is_named_with_its_line(tmp_path, line):
    """The error says where."""
    path = tmp_path / 'a.tum'
    path.write_text(f'# stamps\n{line}\n')
    with pytest.raises(ValueError, match='line 2'):
        read_tum(path)
