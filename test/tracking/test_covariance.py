# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The covariance of an orientation on its way through the stabiliser."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from sph_stab_ros.config import StabilizerConfig, TrackerConfig
from sph_stab_ros.images.frame import Frame
from sph_stab_ros.stabilization.pipeline import Stabilizer
from sph_stab_ros.tracking import TrackedOrientation, TrackingStatus

IMAGE = np.zeros((128, 256), np.uint8)


class Told:
    """A tracker that gives what it was told to."""

    def __init__(self, orientation, covariance):
        self._tracked = TrackedOrientation(orientation, TrackingStatus.OK, covariance)

    def track(self, grey, stamp_ns):
        return self._tracked


def random_covariance(rng):
    """Return a covariance (3, 3) that is the same about no two axes."""
    root = rng.normal(size=(3, 3))
    return 1e-4 * root @ root.T


def stabilize(trackers):
    """Return the StabilizedFrames of a stabiliser that starts each of some trackers in turn."""
    trackers = iter(trackers)
    stabilizer = Stabilizer(make_tracker=lambda *args, **kwargs: next(trackers))
    for i in range(3):
        # Another bound does not matter to them but starts the next.
        stabilizer.reconfigure(StabilizerConfig(tracker=TrackerConfig(
            epipolar_bound_deg=10. + i)))
        yield stabilizer.process(Frame(IMAGE, 10**9 * i // 30))


def test_it_is_about_the_world_s_axes_and_adds_up():
    rng = np.random.default_rng(0)
    R = Rotation.random(3, random_state=1)
    C = [random_covariance(rng) for _ in R]
    first, second, third = stabilize(map(Told, R, C))
    assert np.allclose(first.covariance, C[0])
    A = R[0].as_matrix()
    B = (R[0] * R[1]).as_matrix()
    assert np.allclose(second.covariance, C[0] + A @ C[1] @ A.T)
    assert np.allclose(third.covariance, C[0] + A @ C[1] @ A.T + B @ C[2] @ B.T)
    assert np.isclose(third.uncertainty_rad**2, np.linalg.norm(third.covariance, 2))


def test_it_predicts_the_scatter_of_the_orientation():
    """Errors drawn with the trackers' covariances scatter about the truth as the sum says."""
    rng = np.random.default_rng(2)
    R = Rotation.random(3, random_state=3)
    C = [random_covariance(rng) for _ in R]
    *_, last = stabilize(map(Told, R, C))
    errors = []
    for _ in range(2000):
        drawn = [Rotation.from_rotvec(rng.multivariate_normal(np.zeros(3), one)) for one in C]
        wrong = drawn[0] * R[0] * drawn[1] * R[1] * drawn[2] * R[2]
        errors.append((wrong * last.R_world_camera.inv()).as_rotvec())
    assert np.linalg.norm(np.cov(errors, rowvar=False) - last.covariance) < (
        0.15 * np.linalg.norm(last.covariance))


@pytest.mark.parametrize('unknown', range(3))
def test_what_is_not_known_is_not_made_up(unknown):
    C = [None if i == unknown else np.eye(3) for i in range(3)]
    frames = list(stabilize(map(Told, Rotation.random(3, random_state=4), C)))
    for i, frame in enumerate(frames):
        assert (frame.covariance is None) == (frame.uncertainty_rad is None) == (i >= unknown)
