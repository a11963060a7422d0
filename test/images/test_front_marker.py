# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The mark of the robot's front: where it is, or the way to it."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from sph_stab_ros.geometry.warp import perspective_view, rotate_equirect, view_rotation
from sph_stab_ros.images.front_marker import mark_sphere, mark_view

HFOV_RAD = np.deg2rad(80)
WIDTH, HEIGHT = 321, 241
BORDER_PX = 30


def drawn(mark, shape, *args):
    """Return the pixels (N, 2), as (u, v), that a mark changes in a grey picture."""
    image = np.full(shape, 128, np.uint8)
    mark(image, *args)
    return np.argwhere(image != 128)[:, ::-1]


def centre_of(pixels):
    """Return the middle of the smallest box around pixels (N, 2)."""
    return (pixels.min(axis=0) + pixels.max(axis=0)) / 2


def view_mark(R_view_camera, front_yaw_rad=0.):
    """Return the pixels of the mark in a view."""
    return drawn(mark_view, (HEIGHT, WIDTH), R_view_camera, front_yaw_rad, HFOV_RAD)


@pytest.mark.parametrize('yaw_deg, pitch_deg', ((0, 0), (20, 10), (-25, 15), (10, -20)))
def test_it_lies_on_the_front(yaw_deg, pitch_deg):
    """The picture of a sphere with one white spot in front shows the spot within the ring."""
    sphere = np.zeros((256, 512), np.uint8)
    sphere[126:130, 254:258] = 255
    R_camera_view = view_rotation(*np.deg2rad((yaw_deg, pitch_deg)))
    view = perspective_view(sphere, R_camera_view, HFOV_RAD, (WIDTH, HEIGHT))
    spot = centre_of(np.argwhere(view > 128)[:, ::-1])
    pixels = view_mark(R_camera_view.inv())
    # The wings are as long, the fin is on one side only.
    ring = pixels[np.linalg.norm(pixels - spot, axis=1) < 12]
    assert np.abs(centre_of(ring) - spot).max() < 1.5
    assert np.linalg.norm(pixels - spot, axis=1).max() < 25


def test_the_front_may_be_another_than_the_camera_s():
    looking_there = view_rotation(np.deg2rad(70)).inv()
    there = view_mark(looking_there, front_yaw_rad=np.deg2rad(70))
    assert np.array_equal(there, view_mark(Rotation.identity()))


def test_wings_lie_along_the_camera_s_horizon():
    level, rolled = view_mark(Rotation.identity()), view_mark(view_rotation(0, 0, np.pi / 2))
    assert np.ptp(level, axis=0)[0] > np.ptp(level, axis=0)[1]
    assert np.ptp(rolled, axis=0)[1] > np.ptp(rolled, axis=0)[0]
    # Half a turn puts the fin below.
    upside_down = view_mark(view_rotation(0, 0, np.pi))
    assert centre_of(level)[1] < (HEIGHT - 1) / 2 < centre_of(upside_down)[1]


@pytest.mark.parametrize('yaw_deg, pitch_deg, side', (
    (90, 0, 'right'), (170, 0, 'right'), (-60, 0, 'left'), (-179, 0, 'left'),
    (0, 80, 'below'), (0, -80, 'above')))
def test_an_arrow_points_to_a_front_beyond_the_border(yaw_deg, pitch_deg, side):
    """Who looks to the left has the front on the right."""
    u, v = view_mark(view_rotation(*np.deg2rad((yaw_deg, pitch_deg))).inv()).T
    assert {'right': WIDTH - 1 - BORDER_PX < u.min(), 'left': u.max() < BORDER_PX,
            'below': HEIGHT - 1 - BORDER_PX < v.min(), 'above': v.max() < BORDER_PX}[side]
    assert u.min() > 0 and v.min() > 0 and u.max() < WIDTH - 1 and v.max() < HEIGHT - 1


def test_turning_towards_the_arrow_brings_the_front_into_view():
    rng = np.random.default_rng(1)
    for R_view_camera in Rotation.random(30, random_state=2):
        to_arrow = centre_of(view_mark(R_view_camera)) - ((WIDTH - 1) / 2, (HEIGHT - 1) / 2)
        before_rad = np.arccos(R_view_camera.apply((0, 0, 1))[2])
        if before_rad < HFOV_RAD:
            continue
        # The axis about which the view turns its centre towards the arrow.
        axis = np.array((-to_arrow[1], to_arrow[0], 0)) / np.linalg.norm(to_arrow)
        step = Rotation.from_rotvec(rng.uniform(0.1, 0.5) * axis)
        after_rad = np.arccos((step.inv() * R_view_camera).apply((0, 0, 1))[2])
        assert after_rad < before_rad


def test_straight_behind_is_somewhere():
    assert len(view_mark(view_rotation(np.pi)))


@pytest.mark.parametrize('yaw_deg', (0, 100, 179, 180))
def test_the_sphere_shows_it_too_across_the_seam(yaw_deg):
    """A turn by whole pixels turns the picture with its mark."""
    R_virtual_camera = view_rotation(np.deg2rad(yaw_deg), 0.2)
    sphere = np.full((180, 360), 128, np.uint8)
    mark_sphere(sphere, R_virtual_camera, 0.)
    ahead = rotate_equirect(sphere, view_rotation(np.deg2rad(yaw_deg)))
    pixels = np.argwhere(ahead != 128)[:, ::-1]
    assert abs(centre_of(pixels)[0] - 179.5) < 1
    assert abs(np.median(pixels[:, 1]) - (89.5 - np.rad2deg(0.2))) < 4


def test_it_stands_out_of_bright_and_dark_and_is_anti_aliased():
    for background in (0, 255):
        for shape in ((HEIGHT, WIDTH), (HEIGHT, WIDTH, 3)):
            image = np.full(shape, background, np.uint8)
            mark_view(image, view_rotation(0.2, 0.1, 0.1), 0., HFOV_RAD)
            contrast = np.abs(image.astype(int) - background)
            assert contrast.max() > 150
            # Lines without anti-aliasing have as many levels as they have colours.
            assert len(np.unique(contrast)) > 20
