# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Landmarks in pictures that are read row by row while the camera turns and moves."""

import numpy as np
from painted_room import errors_deg, PERIOD_NS, room, tracked, WIDTH
import pytest
from scipy.spatial.transform import Rotation
from sph_stab_ros.geometry.projection import Equirect
from sph_stab_ros.geometry.rolling_shutter import readout_shares, shares_along
from sph_stab_ros.tracking.anchored.readout import Readout
from synthetic import unit

READOUT_S = 0.02
SHARES = readout_shares(Equirect(WIDTH), (WIDTH, WIDTH // 2))
RATE_RAD_S, VELOCITY_PER_S = np.array((0.4, -0.9, 0.3)), np.array((0.5, -0.2, 0.4))


def moving():
    """Return the Readout of a camera that turns and moves."""
    readout = Readout(READOUT_S, SHARES)
    readout.set_motion(RATE_RAD_S, VELOCITY_PER_S)
    return readout


@pytest.fixture(name='points')
def some_points():
    """Return points (200, 3) around a camera."""
    rng = np.random.default_rng(3)
    return unit(rng.normal(size=(200, 3))) * rng.uniform(1, 5, (200, 1))


def test_points_are_seen_where_the_camera_of_their_row_sees_them(points):
    """To the first order."""
    distance = np.linalg.norm(points, axis=1)
    seen = moving().as_seen(points / distance[:, None], 1 / distance)
    time_s = READOUT_S * shares_along(SHARES, points)[:, None]
    exact = unit(Rotation.from_rotvec(-time_s * RATE_RAD_S).apply(
        points - time_s * VELOCITY_PER_S))
    size = np.linalg.norm(exact - points / distance[:, None], axis=1).max()
    assert size > 0.005
    assert np.linalg.norm(seen - exact, axis=1).max() < 3 * size ** 2


def test_what_is_seen_is_corrected_to_where_it_was(points):
    """There and back; and nothing happens in what is read at once, or by who stands still."""
    bearings, nearness = unit(points), 1 / np.linalg.norm(points, axis=1)
    readout = moving()
    back = readout.corrected(readout.as_seen(bearings, nearness), nearness)
    size = np.linalg.norm(readout.as_seen(bearings, nearness) - bearings, axis=1).max()
    assert np.linalg.norm(back - bearings, axis=1).max() < 3 * size ** 2
    assert Readout().as_seen(bearings, nearness) is bearings
    readout.stand_still()
    np.testing.assert_allclose(readout.as_seen(bearings, nearness), bearings, atol=1e-15)


def shaken_flight(time_s):
    """Return orientations and positions (N, 3) at times (N,)."""
    phases = 2 * np.pi * np.outer(time_s, (1.1, 0.7, 0.9))
    return (Rotation.from_rotvec(0.15 * np.sin(phases) + np.outer(time_s, (0.1, 0.5, -0.2))),
            0.03 * np.sin(phases[:, ::-1]) + np.outer(time_s, (0.2, 0.02, 0.1)))


@pytest.mark.parametrize('readout_s', (READOUT_S, -READOUT_S))
def test_errors_fall_by_half_where_the_shutter_is_known_to_roll(readout_s):
    """Of a camera that is shaken, whichever row is the first."""
    times_s = np.arange(40) * PERIOD_NS / 1e9
    rows = (np.arange(WIDTH // 2) + 0.5) / (WIDTH / 2) - 0.5
    images = [room(*shaken_flight(t_s + readout_s * rows)) for t_s in times_s]
    R_world_camera, _ = shaken_flight(times_s)
    ignorant, known = (
        errors_deg(tracked(images, readout=readout), R_world_camera).mean()
        for readout in (None, Readout(readout_s, SHARES)))
    assert known < ignorant / 2
