# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""
Two passes over the same frames in one: orientations fused on SO(3).

What either pass does not know yet the other one has seen before; and each compares with first
looks, the one with older, the other with newer ones, so that what is wrong about these is wrong
the other way round.
"""

import numpy as np
from scipy.spatial.transform import Rotation

from sph_stab_ros.geometry.arrays import Choice, Covariance, Floats, Values
from sph_stab_ros.geometry.rotations import rotate_covariance
from sph_stab_ros.tracking.base import (
    MAX_OK_SIGMA_RAD, status_of, TrackedOrientation, TrackingStatus)

# Their common world is fitted so often, each time by those that agree, as an L1 fit.
ROBUST_ITERATIONS = 10
MIN_RESIDUAL_RAD = np.deg2rad(0.01)
# How a camera is turned that sees nothing nobody knows.
LOST_COVARIANCE = np.eye(3)


def fuse(forward: list[TrackedOrientation], backward: list[TrackedOrientation],
         lag_frames: int = 0) -> list[TrackedOrientation]:
    """
    Return the TrackedOrientation of N frames from those of two passes, in the frames' order.

    The world is the camera's at the first frame that was seen. Of two that are sure each counts
    half, of two of which one is lost the other one: weights are ``1 / (σ² + σ_ok²)``, down to half
    of that in the last ``lag_frames`` of a pass, for which it had less hindsight or none. Frames
    that neither has seen are bridged from both sides. What is returned is as sure as the surer one
    of both, but for what they disagree by.
    """
    passes = (forward, backward)
    nobody = ~np.any([[is_seen(one) for one in tracked] for tracked in passes], axis=0)
    if nobody.all():
        return forward
    R_f, R_b = (Rotation.concatenate([one.R_world_camera for one in tracked])
                for tracked in passes)
    P = np.array([[LOST_COVARIANCE if one.covariance is None else one.covariance
                   for one in tracked] for tracked in passes])
    weights = 1 / (P.trace(axis1=2, axis2=3) / 3 + MAX_OK_SIGMA_RAD ** 2)
    hindsight = np.minimum(1, np.arange(1, 1 + len(R_f)) / (1 + lag_frames))
    weights *= (1 + np.array((hindsight[::-1], hindsight))) / 2
    R_b = common_world(R_f, R_b, weights.prod(axis=0) * ~nobody) * R_b
    weights[:, nobody] = bridging(nobody)[:, nobody]
    share = weights[1] / weights.sum(axis=0)
    apart = (R_b * R_f.inv()).as_rotvec()
    R = Rotation.from_rotvec(share[:, None] * apart) * R_f
    first = int(np.argmin(nobody))
    R_first_world = R[first].inv()
    # The backward pass counts from the last frame on.
    P[1] += P[1, first]
    surer = np.argmin(P.trace(axis1=2, axis2=3), axis=0)
    # From who is not sure himself nobody differs.
    doubt = share * (1 - share) * weights.min(axis=0) * MAX_OK_SIGMA_RAD ** 2
    spread = doubt[:, None, None] * apart[:, :, None] * apart[:, None]
    return [TrackedOrientation(R_first_world * R[i], forward[i].status) if nobody[i] else
            _oriented(R_first_world * R[i], rotate_covariance(P[surer[i], i] + spread[i],
                                                              R_first_world))
            for i in range(len(R))]


def common_world(R_a: Rotation, R_b: Rotation, weights: Values) -> Rotation:
    """Return R_worlda_worldb of N orientations in two worlds, by weights (N,)."""
    R_a_b, robust = R_a * R_b.inv(), np.ones(len(weights))
    for _ in range(ROBUST_ITERATIONS):
        mean = R_a_b.mean(weights * robust)
        robust = 1 / np.maximum((R_a_b * mean.inv()).magnitude(), MIN_RESIDUAL_RAD)
    return mean


def bridging(unseen: Choice) -> Floats:
    """
    Return weights (2, N) of two passes by for how many frames in a row, (N,) bool, they are blind.

    What comes before either has begun to see does not count.
    """
    return np.array([_by_blindness(unseen), _by_blindness(unseen[::-1])[::-1]])


def _by_blindness(unseen: Choice) -> Values:
    number = np.arange(len(unseen))
    last_seen = np.maximum.accumulate(np.where(unseen, -1, number))
    return np.where(last_seen < 0, 0., 1 / np.maximum(number - last_seen, 1))


def is_seen(one: TrackedOrientation) -> bool:
    return one.status in (TrackingStatus.OK, TrackingStatus.UNCERTAIN)


def _oriented(R_world_camera: Rotation, covariance: Covariance) -> TrackedOrientation:
    return TrackedOrientation(R_world_camera, status_of(covariance), covariance)
