# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Points of known depth, seen from a known pose."""

import numpy as np
from sph_stab_ros.tracking.anchored.pose_estimation import Points
from synthetic import unit

POSITION = np.array((0.1, -0.05, 0.2))
SIGMA_RAD = 1e-3
HERE = np.zeros(3)


def tangents(y):
    """Return the sphere's unit directions (N, 2, 3) at y per standard deviation."""
    first = unit(np.cross(y, (0.3, 0.5, 0.8)))
    return np.stack((first, np.cross(y, first)), axis=1) / SIGMA_RAD


def points(rng, R, position, count=400, noise_rad=0., information=1e6, spread=0.3):
    """Return Points 1 to 5 away from origins spread around zero, seen from a pose."""
    x = unit(rng.normal(size=(count, 3)))
    origins = rng.uniform(-spread, spread, size=(count, 3))
    rho = rng.uniform(0.2, 1, size=count)
    y = unit(R.apply(x - rho[:, None] * (position - origins)))
    y = unit(y + noise_rad * rng.normal(size=y.shape))
    return Points(x, origins, rho, np.full(count, float(information)), y, tangents(y))
