# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Patches that are cut in one picture and found in another one; and tables of rows."""

from dataclasses import dataclass
from functools import lru_cache

from corners import corners, MAX_LATITUDE_DEG
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sph_stab_ros.geometry.equirect import bearing_grid, pixels_from_bearings
from sph_stab_ros.tracking.anchored.localization import SearchOptions
from sph_stab_ros.tracking.anchored.patches import Patches, PatchOptions, Pyramid
from sph_stab_ros.tracking.anchored.table import Table
from synthetic import random_rotation, textured_sphere, unit

WIDTH = 480
PX_PER_RAD = WIDTH / (2 * np.pi)
SEARCH = SearchOptions()


@lru_cache(maxsize=4)
def picture(seed=0):
    """Return a textured sphere that leaves room for more contrast, as float."""
    return 128 + 0.45 * (np.float64(textured_sphere(WIDTH, seed=seed)) - 128)


def seen_by(R, seed=0):
    """Return what a turned camera sees of the picture, exactly."""
    return 128 + 0.45 * (np.float64(textured_sphere(WIDTH, R, seed)) - 128)


def pyramid(image):
    return Pyramid(np.uint8(np.rint(image)), PatchOptions())


def cut(image):
    """Return bearings, tangents and Patches of the corners in a picture."""
    where = corners(image)
    return where, Patches.cut(pyramid(image), *where)


def latitude_deg(b):
    return np.rad2deg(np.arcsin(np.abs(b[:, 1])))


def find(patches, image, where, off_px=0., scale=None):
    """Look for patches, at first beside where they are; return errors (N, 2) in px, and more."""
    b, east, south = where
    off = np.broadcast_to(off_px, (len(b), 2)) / PX_PER_RAD
    expected = unit(b + off[:, :1] * east + off[:, 1:] * south)
    scale = np.ones(len(b)) if scale is None else scale
    offsets, correlation, last_step_px = patches.find(
        np.arange(len(b)), pyramid(image), expected, east, south, scale)
    found = unit(expected + offsets[:, :1] * east + offsets[:, 1:] * south)
    error = np.stack([np.einsum('ni,ni->n', found - b, t) for t in (east, south)], axis=1)
    return error * PX_PER_RAD, correlation, last_step_px


@pytest.mark.parametrize('seed, turn_deg', ((0, 0), (1, 3), (2, 25), (3, 80), (4, 110), (5, 180)))
def test_patches_are_found_wherever_the_camera_is_turned(seed, turn_deg):
    rng = np.random.default_rng(seed)
    R = random_rotation(rng, turn_deg)
    where, patches = cut(picture())
    seen = [R.inv().apply(one) for one in where]
    off_px = rng.uniform(-2, 2, (len(patches), 2))
    error, correlation, last_step_px = find(patches, seen_by(R), seen, off_px)
    low = latitude_deg(seen[0]) < MAX_LATITUDE_DEG
    size = np.linalg.norm(error, axis=1)[low]
    assert low.sum() > 80
    assert np.median(size) < 0.05
    assert (size < 0.1).mean() > 0.95
    assert np.abs(error[low].mean(axis=0)).max() < 0.02
    assert np.median(correlation[low]) > 0.95


def test_patches_are_found_across_the_seam():
    where, patches = cut(picture())
    sizes = []
    for x in where[0][:8]:
        # Brings the seam within 4 px of the corner.
        R = Rotation.from_euler('y', np.pi + np.arctan2(x[0], x[2]) - 3 / PX_PER_RAD)
        seen = [R.inv().apply(one) for one in where]
        u = pixels_from_bearings(seen[0], WIDTH)[:, 0]
        near = np.minimum(u + 0.5, WIDTH - 0.5 - u) < 4
        assert near.any()
        error, _, _ = find(patches[near], seen_by(R), [one[near] for one in seen], (2., -1.))
        sizes += [np.linalg.norm(error, axis=1)]
    sizes = np.concatenate(sizes)
    assert np.median(sizes) < 0.05


@pytest.mark.parametrize('gain, more', ((1., 30), (1., -30), (0.5, 0), (1.4, 0), (0.5, -30),
                                        (1.4, 20)))
def test_brightness_and_contrast_change_nothing(gain, more):
    R = random_rotation(np.random.default_rng(6), 30)
    where, patches = cut(picture())
    seen = [R.inv().apply(one) for one in where]
    image = seen_by(R)
    plain, correlation, _ = find(patches, image, seen, (1., 1.))
    changed, as_well, _ = find(patches, 128 + gain * (image - 128) + more, seen, (1., 1.))
    low = latitude_deg(seen[0]) < MAX_LATITUDE_DEG
    difference = (changed - plain)[low]
    # As far as eight bits go.
    assert np.median(np.abs(difference)) < 0.02
    sigmas = np.einsum('nij,nj->ni', patches.sqrt_information_px[low], difference)
    assert np.linalg.norm(sigmas, axis=1).max() < 2
    np.testing.assert_allclose(as_well[low], correlation[low], atol=0.02)


def wall(R_world_camera, position):
    """Return the grey sphere that a camera sees of a painted wall, the plane z = 1."""
    rng = np.random.default_rng(7)
    rays = bearing_grid(WIDTH) @ R_world_camera.as_matrix().T.astype(np.float32)
    ahead = rays[..., 2] > 0.2
    hit = (position + (1 - position[2]) / rays[ahead][:, 2:] * rays[ahead])[:, :2]
    vectors = np.float32(rng.uniform(15, 45, (60, 1)) * unit(rng.normal(size=(60, 2))))
    grey = np.full(rays.shape[:2], np.float32(128))
    grey[ahead] += 7 * np.sin(np.float32(hit) @ vectors.T).sum(axis=1)
    return np.clip(grey, 0, 255)


@pytest.mark.parametrize('seed', range(4))
@pytest.mark.parametrize('scale', (2., 0.6))
def test_what_has_come_nearer_or_gone_is_found_so_much_larger_or_smaller(scale, seed):
    rng = np.random.default_rng(seed)
    place = np.array((*rng.uniform(-1, 1, 2), 0.))
    first, second = random_rotation(rng, 40), random_rotation(rng, 40)
    tangents = np.array(((0., 0, 1), (1, 0, 0), (0, 1, 0)))
    patches = Patches.cut(pyramid(wall(first, place)), *first.inv().apply(tangents)[:, None])
    image = wall(second, place + (0, 0, 1 - 1 / scale))
    where = second.inv().apply(tangents)[:, None]
    error, correlation, last_step_px = find(
        patches, image, where, (1., -1.), np.array((scale,)))
    _, as_far, _ = find(patches, image, where)
    assert np.linalg.norm(error) < 0.1
    assert last_step_px[0] < SEARCH.max_last_step_px
    assert correlation[0] > 0.99 > 0.9 > as_far[0]


def test_something_else_is_not_taken_for_a_patch():
    where, patches = cut(picture())

    def found(image):
        offsets_px, correlation, last_step_px = find(patches, image, where)
        return ((correlation > SEARCH.min_correlation) & (last_step_px < SEARCH.max_last_step_px)
                & (np.linalg.norm(offsets_px, axis=1) < SEARCH.max_offset_px)), correlation
    same, correlation = found(picture())
    assert same.all() and correlation.min() > 0.99
    other, correlation = found(picture(seed=1))
    assert other.mean() < 0.15
    assert np.median(correlation) < SEARCH.min_correlation


def test_in_a_plain_picture_nothing_is_found_and_nothing_breaks():
    where, patches = cut(picture())
    error, correlation, _ = find(patches, np.full((WIDTH // 2, WIDTH), 90.), where)
    assert np.isfinite(error).all()
    assert correlation.max() < SEARCH.min_correlation
    plain = Patches.cut(pyramid(np.full((WIDTH // 2, WIDTH), 90.)), *where)
    assert plain.deviations.max() < PatchOptions.min_contrast
    assert np.isfinite(find(plain, picture(), where)[0]).all()


def test_no_patches_are_nowhere():
    where, patches = cut(picture())
    error, correlation, last_step_px = find(patches[:0], picture(), [one[:0] for one in where])
    assert error.shape == (0, 2)
    assert len(correlation) == len(last_step_px) == 0


def test_an_edge_tells_nothing_of_what_is_along_it():
    stripes = np.tile(128 + 60 * np.sin(np.arange(WIDTH) * (2 * np.pi / 12)), (WIDTH // 2, 1))
    x, east, south = (np.array(one)[None] for one in ((0., 0, 1), (1., 0, 0), (0., 1, 0)))
    information = Patches.cut(pyramid(stripes), x, east, south).sqrt_information_px[0]
    assert np.linalg.norm(information @ (1, 0)) > 20 * np.linalg.norm(information @ (0, 1))


@dataclass
class Table(Table):
    """A number and a matrix per row."""

    value: np.ndarray
    matrix: np.ndarray


def table():
    rng = np.random.default_rng(8)
    return Table(np.arange(12), rng.normal(size=(12, 2, 3)))


def assert_same(one, other):
    assert len(one) == len(other)
    np.testing.assert_array_equal(one.value, other.value)
    np.testing.assert_array_equal(one.matrix, other.matrix)


@pytest.mark.parametrize('cuts', ((0,), (5,), (12,), (3, 3, 9)))
def test_joining_rows_undoes_parting_them(cuts):
    whole = table()
    edges = (0, *cuts, 12)
    parts = [whole[start:end] for start, end in zip(edges, edges[1:])]
    assert [len(one) for one in parts] == list(np.diff(edges))
    assert_same(Table.joined(parts), whole)


def test_rows_are_selected_by_number_and_by_truth():
    whole = table()
    order = np.random.default_rng(9).permutation(12)
    assert_same(whole[order][np.argsort(order)], whole)
    odd = whole.value % 2 == 1
    assert_same(whole[odd], whole[np.flatnonzero(odd)])
    assert whole[odd].matrix[0, 0, 0] == whole.matrix[1, 0, 0]
