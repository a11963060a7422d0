# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Keyframes and the points that they see, exactly and disturbed."""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation
from sph_stab_ros.tracking.anchored.bundle_adjustment import BundleOptions
from sph_stab_ros.tracking.anchored.bundle_window import Window
from synthetic import random_rotation, unit

SIGMA_RAD = 1e-3
KEYFRAMES = 6
STEP = np.array((0.12, 0.02, 0.05))


def true_window(rng, count=120, noise_rad=0., information=0.03):
    """Return a Window at the truth: points 1 to 5 away, each seen in all but its host."""
    R = Rotation.concatenate([random_rotation(rng, 10 * i) for i in range(KEYFRAMES)])
    p = np.arange(KEYFRAMES)[:, None] * STEP + rng.normal(0, 0.02, (KEYFRAMES, 3))
    p[0] = 0
    host = rng.integers(KEYFRAMES, size=count)
    x = unit(rng.normal(size=(count, 3)))
    rho = rng.uniform(0.2, 1, size=count)
    keyframe, point = (one.ravel() for one in np.meshgrid(
        np.arange(KEYFRAMES), np.arange(count), indexing='ij'))
    elsewhere = keyframe != host[point]
    keyframe, point = keyframe[elsewhere], point[elsewhere]
    h = host[point]
    y = R[keyframe].inv().apply(
        R[h].apply(x[point]) - rho[point, None] * (p[keyframe] - p[h]))
    y = unit(unit(y) + noise_rad * rng.normal(size=y.shape))
    first = unit(np.cross(y, (0.3, 0.5, 0.8)))
    sqrt_information = np.stack((first, np.cross(y, first)), axis=1) / SIGMA_RAD
    free = np.arange(KEYFRAMES) > 0
    return Window(R.as_matrix(), p, free, host, x, rho, np.full(count, float(information)),
                  keyframe, point, y, sqrt_information)


def perturbed(rng, window, turn_deg=1., move=0.02, depth=0.2):
    """Return the Window with its free keyframes and all depths disturbed."""
    R, p, free = window.R.copy(), window.p.copy(), window.free
    for i in np.flatnonzero(free):
        R[i] = random_rotation(rng, turn_deg).as_matrix() @ R[i]
    p[free] += rng.normal(0, move, (free.sum(), 3))
    rho = np.minimum(window.inverse_depths * np.exp(rng.normal(0, depth, len(window.x))),
                     BundleOptions.max_inverse_depth)
    return replace(window, R=R, p=p, inverse_depths=rho)
