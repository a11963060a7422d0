# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""A box with painted walls, what a camera sees on a flight through it, and what is tracked."""

from functools import lru_cache

import numpy as np
from scipy.spatial.transform import Rotation
from sph_stab_ros.geometry.equirect import bearing_grid
from sph_stab_ros.tracking.anchored.tracker import AnchoredTracker
from synthetic import angle_deg, unit

WIDTH = 320
PERIOD_NS = 33_333_333
HALF_ROOM = np.float32((3, 1.5, 2))


# Waves on the walls, in radians per unit of length; the finest are 3 degrees long from 2 away.
COARSE, FINE = (2, 16), (10, 60)


@lru_cache(maxsize=2)
def waves(paint):
    """Return wave vectors (3, K) and phases (K,) of the paint on the walls."""
    rng = np.random.default_rng(7)
    frequencies = rng.uniform(*paint, size=60)
    vectors = frequencies[:, None] * unit(rng.normal(size=(60, 3)))
    return np.float32(vectors.T), np.float32(rng.uniform(0, 6.3, size=60))


def room(R_world_camera, position=(0, 0, 0), width=WIDTH, paint=COARSE):
    """
    Return the grey sphere (width / 2, width) that a camera sees in a painted box.

    Given as many orientations and positions (H, 3) as there are rows, the camera moves meanwhile.
    """
    rays = bearing_grid(width) @ R_world_camera.as_matrix().swapaxes(-1, -2).astype(np.float32)
    rays = np.where(np.abs(rays) < 1e-6, np.float32(1e-6), rays)
    position = np.float32(position)[..., None, :]
    distance = ((np.sign(rays) * HALF_ROOM - position) / rays).min(axis=-1)
    vectors, phases = waves(paint)
    grey = np.sin((position + distance[..., None] * rays) @ vectors + phases).sum(axis=-1)
    return np.uint8(np.clip(128 + 12 * grey, 0, 255))


def flight(frames, step_deg=(0.4, 0.9, -0.3), step=(0.02, 0.004, 0.01)):
    """Return orientations and positions (frames, 3) of a steady flight."""
    count = np.arange(frames)[:, None]
    return Rotation.from_rotvec(count * np.deg2rad(step_deg)), count * np.array(step)


def tracked(images, tracker=None, **options):
    """Return the TrackedOrientations of images at 30 Hz."""
    tracker = tracker or AnchoredTracker(**options)
    return [tracker.track(image, i * PERIOD_NS) for i, image in enumerate(images)]


def errors_deg(results, R_world_camera):
    """Return the angles between the orientations tracked and the true ones."""
    return np.array([angle_deg(result.R_world_camera, R_world_camera[0].inv() * R)
                     for result, R in zip(results, R_world_camera)])
