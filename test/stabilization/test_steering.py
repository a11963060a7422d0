# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Steering: laws of turning and zooming, whenever they are asked about."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from sph_stab_ros.geometry.warp import view_rotation
from sph_stab_ros.stabilization.steering import (
    Look, MAX_PITCH_RAD, Rates, steer, Steering, view_angles)
from synthetic import angle_deg

LIMITS_RAD = np.deg2rad((10, 150))
HOME = Look(Rotation.identity(), np.deg2rad(90))


def random_cases(count=20):
    """Yield a Look, Rates that stay within all limits for two seconds, and a time in seconds."""
    rng = np.random.default_rng(0)
    for _ in range(count):
        yaw, roll = rng.uniform(-np.pi, np.pi, size=2)
        look = Look(view_rotation(yaw, rng.uniform(-0.5, 0.5), roll),
                    np.deg2rad(rng.uniform(60, 120)))
        yield (look, Rates(rng.uniform(-3, 3), rng.uniform(-0.5, 0.5), rng.uniform(-0.4, 0.4)),
               rng.uniform(0.1, 1))


def same(a, b):
    """Tell whether two Looks are the same."""
    return (angle_deg(a.R_virtual_view, b.R_virtual_view) < 1e-6
            and abs(a.hfov_rad - b.hfov_rad) < 1e-9)


@pytest.mark.parametrize('look, rates, time_s', random_cases())
def test_turning_adds_up_and_goes_back(look, rates, time_s):
    once = steer(look, rates, 2 * time_s, LIMITS_RAD)
    twice = steer(steer(look, rates, time_s, LIMITS_RAD), rates, time_s, LIMITS_RAD)
    assert same(once, twice) and not same(once, look)
    back = Rates(-rates.yaw_rad_s, -rates.pitch_rad_s, -rates.zoom_per_s)
    assert same(steer(once, back, 2 * time_s, LIMITS_RAD), look)


@pytest.mark.parametrize('look, rates, time_s', random_cases(5))
def test_yaw_and_pitch_leave_the_roll_and_each_other(look, rates, time_s):
    yaw, pitch, roll = view_angles(look.R_virtual_view)
    turned = view_angles(steer(look, rates, time_s, LIMITS_RAD).R_virtual_view)
    expected = view_rotation(
        yaw + time_s * rates.yaw_rad_s, pitch + time_s * rates.pitch_rad_s, roll)
    assert angle_deg(view_rotation(*turned), expected) < 1e-6


def test_rates_go_left_up_and_closer():
    def forward(rates):
        return steer(HOME, rates, 0.1, LIMITS_RAD).R_virtual_view.apply((0, 0, 1))

    # Optical axes: left is -x, up is -y.
    assert np.allclose(forward(Rates(yaw_rad_s=1)), (-np.sin(0.1), 0, np.cos(0.1)))
    assert np.allclose(forward(Rates(pitch_rad_s=1)), (0, -np.sin(0.1), np.cos(0.1)))
    closer = steer(HOME, Rates(zoom_per_s=1), 0.1, LIMITS_RAD)
    # The focal length grows e-fold in a second.
    assert np.isclose(np.tan(HOME.hfov_rad / 2) / np.tan(closer.hfov_rad / 2), np.exp(0.1))


@pytest.mark.parametrize('up', (1, -1))
def test_pitch_ends_at_the_poles_and_comes_back(up):
    there = steer(HOME, Rates(1., up * 50.), 1., LIMITS_RAD)
    yaw, pitch, roll = view_angles(there.R_virtual_view)
    assert np.isclose(pitch, up * MAX_PITCH_RAD)
    # At once, not only after what was asked for too much has been taken back.
    back = steer(there, Rates(0., -up * 1.), 1., LIMITS_RAD)
    assert np.allclose(view_angles(back.R_virtual_view), (1, up * (MAX_PITCH_RAD - 1), 0))


def test_zoom_ends_at_the_limits():
    for zoom, limit_rad in zip((50, -50), LIMITS_RAD):
        assert steer(HOME, Rates(0, 0, zoom), 1e2, LIMITS_RAD).hfov_rad == limit_rad


def test_turning_ends_with_the_timeout_whenever_it_is_looked_at():
    rates = Rates(0.5, 0.2, 0.1)
    for times_s in ((30,), (10.1, 10.2, 10.5, 11), (10.4, 20)):
        steering = Steering(HOME, LIMITS_RAD)
        steering.turn(10, rates, timeout_s=0.5)
        looks = [steering.at(time_s) for time_s in times_s]
        assert same(looks[-1], steer(HOME, rates, 0.5, LIMITS_RAD))


def test_the_last_word_counts():
    steering = Steering(HOME, LIMITS_RAD)
    left = view_rotation(np.pi / 2)
    steering.turn(0, Rates(1, 0, 0), timeout_s=10)
    steering.turn(1, Rates(-1, 0, 0), timeout_s=10)
    assert same(steering.at(2), HOME)
    steering.turn(2, Rates(), timeout_s=10)
    assert same(steering.at(3), HOME)
    steering.turn(3, Rates(1, 0, 0), timeout_s=10)
    steering.look(4, R_virtual_view=left)
    assert same(steering.at(5), Look(left, HOME.hfov_rad))
    steering.turn(5, Rates(1, 0, 0), timeout_s=1)
    # A field of view does not stop the turning.
    steering.look(5.5, hfov_rad=1.)
    assert same(steering.at(7), Look(view_rotation(np.pi / 2 + 1), 1.))


def test_directions_stay_exact_while_nothing_moves():
    steering = Steering(HOME, LIMITS_RAD)
    for R in Rotation.random(5, random_state=0):
        steering.look(0, R_virtual_view=R)
        assert steering.at(1).R_virtual_view is R
