# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What is compiled does the same as what is written in NumPy."""

from dataclasses import replace
import shutil

from bundle_windows import perturbed, true_window
from corners import corners
import cv2
import numpy as np
from pose_points import points, POSITION
import pytest
from scipy.spatial.transform import Rotation

from sph_stab_ros import kernels
from sph_stab_ros.geometry.warp import perspective_view, rotate_equirect
from sph_stab_ros.images.colour import resized
from sph_stab_ros.tracking.anchored import bundle_adjustment, bundle_window, pose_estimation
from sph_stab_ros.tracking.anchored.patches import Patches, PatchOptions, Pyramid
from synthetic import random_rotation, textured_sphere, unit

COMPILER = shutil.which('cc') or shutil.which('gcc')
# With a compiler it is an error that there is nothing compiled, and these fail.
pytestmark = pytest.mark.skipif(
    kernels.library is None and not COMPILER, reason='there is no C compiler here')


@pytest.mark.skipif(not COMPILER, reason='there is no C compiler here')
def test_they_are_compiled_where_there_is_a_compiler():
    assert kernels.library is not None


@pytest.fixture
def both(monkeypatch):
    """Return what a function without arguments returns, compiled and in NumPy."""
    def both(function):
        compiled = function()
        monkeypatch.setattr(kernels, 'library', None)
        in_numpy = function()
        monkeypatch.undo()
        return compiled, in_numpy
    return both


def assert_close(compiled, in_numpy):
    for one, other in zip(compiled, in_numpy, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-9 * np.abs(other).max())


@pytest.mark.parametrize('seed', range(3))
def test_fits_of_a_pose(both, seed):
    rng = np.random.default_rng(seed)
    R = random_rotation(rng, 50)
    seen = points(rng, R, POSITION, noise_rad=1e-3, information=10.)
    near = random_rotation(rng, 2) * R
    state = near.as_matrix(), POSITION + 0.01
    assert_close(*both(lambda: (
        pose_estimation.residuals(seen, *state, 1.1 * seen.inverse_depths),)))
    options = pose_estimation.PoseOptions()
    assert_close(*both(lambda: (pose_estimation.depths_at(seen, *state, options),)))
    say = rng.uniform(0.5, 1, len(seen))
    for power in 1, 2:
        options = replace(options, loss=replace(options.loss, power=power))

        def fitted():
            pose = pose_estimation.fit_pose(
                seen, near, POSITION + 0.01, 0.1, options, say)
            return (pose.R_camera_world.as_matrix(), pose.position, pose.inverse_depths,
                    pose.sizes, pose.weights, pose.scale, pose.covariance)
        assert_close(*both(fitted))


@pytest.mark.parametrize('seed', range(3))
def test_equations_of_a_bundle(both, seed):
    rng = np.random.default_rng(seed)
    window = perturbed(rng, true_window(rng, noise_rad=1e-3))
    state = window.R, window.p, window.inverse_depths
    assert_close(*both(lambda: (bundle_window.residual_lengths(window, *state),)))
    sizes = bundle_window.residual_lengths(window, *state)
    weights = rng.uniform(size=len(sizes))

    def equations():
        one = bundle_adjustment.normal_equations(
            window, *state, sizes, bundle_adjustment.BundleOptions())
        return one.H, one.g, one.H_rp, one.H_rr, one.g_r
    assert_close(*both(equations))
    assert_close(*both(lambda: bundle_window.pose_and_point_equations(
        window, *state, weights, lenses=True)))


@pytest.mark.parametrize('turn_deg', (0, 20, 150))
def test_patches(both, turn_deg):
    rng = np.random.default_rng(turn_deg)
    R = random_rotation(rng, turn_deg)
    width = 480
    x, east, south = corners(textured_sphere(width))
    patches = Patches.cut(Pyramid(textured_sphere(width), PatchOptions()), x, east, south)
    image = Pyramid(textured_sphere(width, R), PatchOptions())
    seen = [R.inv().apply(one) for one in (unit(x + rng.normal(0, 0.01, x.shape)), east, south)]
    rows, scale = rng.permutation(len(x))[:80], rng.uniform(0.9, 1.1, 80)
    (offsets, correlation, _), (in_numpy, also, _) = both(lambda: patches.find(
        rows, image, *(one[rows] for one in seen), scale))
    low = np.abs(seen[0][rows, 1]) < np.sin(np.deg2rad(60))
    found = low & (correlation > 0.9) & (also > 0.9)
    assert found.sum() > 30
    # OpenCV reads at 32nds of a pixel, and NumPy goes on with those that have settled.
    px = np.linalg.norm(offsets - in_numpy, axis=1)[found] * width / (2 * np.pi)
    assert np.median(px) < 0.03 and np.percentile(px, 95) < 0.1
    np.testing.assert_allclose(correlation[found], also[found], atol=0.02)


def test_what_is_read_is_copied_where_it_is_not_dense():
    rng = np.random.default_rng(5)
    seen = points(rng, Rotation.identity(), POSITION)
    loose = np.asfortranarray(seen.x)
    assert not loose.flags.c_contiguous
    r = pose_estimation.residuals(seen, np.eye(3), POSITION, seen.inverse_depths)
    again = pose_estimation.residuals(
        pose_estimation.Points(loose, *(getattr(seen, one) for one in (
            'origins', 'inverse_depths', 'information', 'y', 'sqrt_information'))),
        np.eye(3), POSITION, seen.inverse_depths)
    np.testing.assert_array_equal(r, again)


def test_what_cannot_be_written_to_is_read_as_well():
    seen = points(np.random.default_rng(6), Rotation.identity(), POSITION)
    r = pose_estimation.residuals(seen, np.eye(3), POSITION, seen.inverse_depths)
    seen.y.flags.writeable = False
    np.testing.assert_array_equal(
        r, pose_estimation.residuals(seen, np.eye(3), POSITION, seen.inverse_depths))


@pytest.mark.parametrize('wrong', [
    np.empty(4), np.empty(8, np.float32)[::2], np.broadcast_to(np.float32(0), (4,))],
    ids=['float64', 'not dense', 'read only'])
def test_what_is_written_must_be_dense_and_of_its_type(wrong):
    image, place = np.zeros((2, 2), np.uint8), np.zeros(4, np.float32)
    kernels.library.read_pixels(4, image, 2, 2, place, place, np.empty(4, np.float32))
    with pytest.raises(TypeError):
        kernels.library.read_pixels(4, image, 2, 2, place, place, wrong)


def test_numbers_of_the_wrong_kind_or_count_are_refused():
    with pytest.raises(TypeError):
        kernels.library.pose_residuals('many', *[np.zeros(9)] * 8)
    with pytest.raises(ValueError):
        kernels.library.pose_residuals(1, *[np.zeros(9)] * 7)


class Interrupting:
    """An array that somebody presses Ctrl-C at."""

    def __array__(self, *_, **__):
        raise KeyboardInterrupt


def test_an_interruption_stays_one():
    with pytest.raises(KeyboardInterrupt):
        kernels.library.pose_residuals(1, Interrupting(), *[np.zeros(9)] * 7)


@pytest.mark.parametrize('shape', ((128, 256), (128, 256, 3), (75, 150, 3), (640, 1280, 3)))
@pytest.mark.parametrize('R', Rotation.random(3, random_state=2))
def test_the_warp(both, shape, R):
    """At the seam, at both poles and between; both read in steps of 1/32 px."""
    image = np.random.default_rng(0).integers(0, 256, shape, np.uint8)
    image = cv2.GaussianBlur(image, (0, 0), 1.5, borderType=cv2.BORDER_REFLECT)
    for read in (lambda: rotate_equirect(image, R),
                 lambda: perspective_view(image, R, np.deg2rad(130), (201, 133))):
        compiled, with_opencv = both(read)
        assert compiled.shape == with_opencv.shape and compiled.dtype == np.uint8
        steepest = np.abs(np.diff(np.int16(image), axis=0)).max()
        np.testing.assert_allclose(np.int16(compiled), with_opencv, atol=1 + steepest / 16)


def test_pictures_that_are_not_dense_or_not_to_be_written_to(both):
    """A crop, and the memory of a message."""
    wide = np.random.default_rng(0).integers(0, 256, (64, 200, 3), np.uint8)
    crop, locked = wide[:, :128], wide[:, :128].copy()
    locked.flags.writeable = False
    R = Rotation.random(random_state=2)
    np.testing.assert_array_equal(rotate_equirect(crop, R), rotate_equirect(locked, R))


@pytest.mark.parametrize('shape', ((1, 1), (2, 1), (7, 5), (33, 512), (20, 1025)))
def test_planes_of_colours_twice_as_fine(both, shape):
    plane = np.random.default_rng(0).integers(0, 256, shape, np.uint8)
    size_wh = 2 * shape[1], 2 * shape[0]
    compiled, with_opencv = both(lambda: resized(plane, size_wh))
    # In whole sixteenths.
    exact = cv2.resize(plane.astype(np.float32), size_wh)
    np.testing.assert_array_equal(compiled, np.floor(exact + 0.5))
    np.testing.assert_allclose(np.int16(with_opencv), compiled, atol=1)
