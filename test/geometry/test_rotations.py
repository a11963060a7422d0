# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Rotations and vectors by quicker ways than SciPy's and NumPy's."""

import numpy as np
import pytest
from sph_stab_ros.geometry.equirect import pad_sphere
from sph_stab_ros.geometry.rotations import cross, rotation_from_matrix
from sph_stab_ros.tracking.anchored.thumbnail import change_by_rotation, rotation_gradient
from synthetic import random_rotation, textured_sphere


@pytest.mark.parametrize('max_deg', [1e-5, 1., 179.99])
def test_matrices_become_rotations(max_deg):
    rng = np.random.default_rng(0)
    for _ in range(50):
        R = random_rotation(rng, max_deg)
        product = R.as_matrix() @ R.as_matrix() @ R.as_matrix()
        assert (rotation_from_matrix(product) * (R * R * R).inv()).magnitude() < 1e-12


def test_cross_products():
    a, b = np.random.default_rng(0).normal(size=(2, 100, 3))
    np.testing.assert_allclose(cross(a, b), np.cross(a, b), rtol=1e-12, atol=1e-12)


def test_change_is_that_of_the_gradient():
    grey = textured_sphere(160).astype(np.float32)
    padded = pad_sphere(grey, 4)
    omega = np.float32((0.01, -0.02, 0.03))
    np.testing.assert_allclose(change_by_rotation(padded, 4, omega),
                               rotation_gradient(padded, 4) @ omega, atol=1e-3)
