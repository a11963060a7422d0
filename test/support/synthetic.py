# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Pairs of bearings and images whose true motion is known."""

import numpy as np
from scipy.spatial.transform import Rotation

from sph_stab_ros.geometry.equirect import bearing_grid
from sph_stab_ros.geometry.warp import rotate_equirect
from sph_stab_ros.tracking.frame_to_frame.estimators import BearingPairs


def random_rotation(rng, angle_deg):
    """Return a Rotation by a given angle about a random axis."""
    return Rotation.from_rotvec(np.deg2rad(angle_deg) * unit(rng.normal(size=3)))


def unit(vectors):
    """Return vectors (..., 3) at length one."""
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def point_pairs(rng, R_current_previous, t_current, count=3000, noise_rad=0., outliers=0.):
    """
    Return BearingPairs of points 1 to 10 away all around, under X' = R X + t.

    ``noise_rad`` is the standard deviation per axis of the current bearings, ``outliers`` the
    share of pairs that have nothing to do with each other.
    """
    points = unit(rng.normal(size=(count, 3))) * rng.uniform(1, 10, size=(count, 1))
    moved = R_current_previous.apply(points) + t_current
    current = unit(unit(moved) + noise_rad * rng.normal(size=moved.shape))
    wrong = rng.random(count) < outliers
    current[wrong] = unit(rng.normal(size=(wrong.sum(), 3)))
    return BearingPairs(unit(points), current, np.ones(count))


def turned_pair(image, R_current_previous):
    """Return the image and what a camera sees of it after turning by R_current_previous⁻¹."""
    return image, rotate_equirect(image, R_current_previous.inv())


def angle_deg(R_a, R_b):
    """Return the angle in degrees between two Rotations."""
    return np.rad2deg((R_a * R_b.inv()).magnitude())


def textured_sphere(width, R_world_camera=Rotation.identity(), seed=0):
    """Return a grey image of a richly textured world at infinity, exact under any rotation."""
    return texture_along(
        bearing_grid(width) @ R_world_camera.as_matrix().T.astype(np.float32), seed)


def texture_along(x, seed=0):
    """Return the grey values (H, W) uint8 of that world along bearings (H, W, 3) in it."""
    rng = np.random.default_rng(seed)
    grey = np.zeros(x.shape[:2], np.float32)
    for _ in range(120):
        frequency = np.float32(rng.uniform(4, 50))
        wave_vector = np.float32(frequency * unit(rng.normal(size=3)))
        grey += np.sin(x @ wave_vector + np.float32(rng.uniform(0, 6.3))) / np.sqrt(frequency)
    return np.uint8(np.clip(128 + 25 * grey, 0, 255))
