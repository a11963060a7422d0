# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""
Segments of a recording that were tracked each for itself, joined on SO(3) where they overlap.

Each segment has a world of its own. One rotation turns the second's into the first's: the L1 mean
of what the two differ by where both have seen the same frames. What they differ by then is spread
over the overlap, so that there is no step: at its start the second one, which has just begun, says
nothing, at its end everything.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce

import numpy as np
from scipy.spatial.transform import Rotation

from sph_stab_ros.geometry.arrays import Covariance, Stamps
from sph_stab_ros.geometry.rotations import rotate_covariance
from sph_stab_ros.tracking.base import MAX_OK_SIGMA_RAD, status_of, TrackedOrientation
from sph_stab_ros.tracking.offline.fusion import common_world, is_seen, LOST_COVARIANCE


class JoiningError(ValueError):
    """Segments that are none of the same recording in a row, said in one line."""


@dataclass(frozen=True)
class Segment:
    """The TrackedOrientation of N frames in a row, and their stamps in ns (N,), which increase."""

    stamps_ns: Stamps
    orientations: list[TrackedOrientation]


def join_segments(segments: Sequence[Segment]) -> Segment:
    """Return the Segment of all frames in the world of the first one."""
    for segment in segments:
        if np.any(np.diff(segment.stamps_ns) <= 0):
            raise JoiningError('stamps that do not increase tell no overlap')
    return reduce(join, segments)


def join(first: Segment, second: Segment) -> Segment:
    """
    Return the Segment of the frames of two: the end of the first is the start of the second.

    Of frames behind the overlap the covariance is the second's, and besides that of its world in
    the first's: what the first one says there, and what both differ by. Where there is no frame
    that both have seen nothing is known of that, and all that follows is uncertain.
    """
    before = int(np.searchsorted(first.stamps_ns, second.stamps_ns[0]))
    count = len(first.stamps_ns) - before
    if not count or not np.array_equal(first.stamps_ns[before:], second.stamps_ns[:count]):
        raise JoiningError('two segments do not overlap in the same pictures')
    pair = first.orientations[before:], second.orientations[:count]
    R_first, R_second = (Rotation.concatenate([one.R_world_camera for one in orientations])
                         for orientations in pair)
    seen = np.array([[is_seen(one) for one in orientations] for orientations in pair])
    P = np.array([[_covariance(one) for one in orientations] for orientations in pair])
    ramp = np.arange(1, 1 + count) / (1 + count)
    weights = np.array((1 - ramp, ramp)) / (P.trace(axis1=2, axis2=3) / 3 + MAX_OK_SIGMA_RAD ** 2)
    both = weights.prod(axis=0) * seen.all(axis=0)
    is_known = bool(both.any())
    R_first_second = common_world(
        R_first, R_second, both if is_known else weights.prod(axis=0))
    apart = (R_first_second * R_second * R_first.inv()).as_rotvec()
    P_world = (np.average(P[0] + apart[:, :, None] * apart[:, None], axis=0, weights=both)
               if is_known else LOST_COVARIANCE)

    def in_first(one: TrackedOrientation) -> TrackedOrientation:
        covariance = P_world + rotate_covariance(_covariance(one), R_first_second)
        return _told(one, R_first_second * one.R_world_camera, covariance)

    share = weights[1] / weights.sum(axis=0)
    R_blended = Rotation.from_rotvec(share[:, None] * apart) * R_first
    blended = []
    for i, (one, other) in enumerate(zip(*pair)):
        surer = min((one, in_first(other)), key=lambda a: float(np.trace(_covariance(a))))
        spread = share[i] * (1 - share[i]) * np.outer(apart[i], apart[i])
        blended.append(_told(surer, R_blended[i], _covariance(surer) + spread))
    return Segment(
        np.concatenate((first.stamps_ns[:before], second.stamps_ns)),
        [*first.orientations[:before], *blended, *map(in_first, second.orientations[count:])])


def _covariance(one: TrackedOrientation) -> Covariance:
    return one.covariance if one.covariance is not None and is_seen(one) else LOST_COVARIANCE


def _told(one: TrackedOrientation, R_world_camera: Rotation,
          covariance: Covariance) -> TrackedOrientation:
    """Return an orientation that is as it was come by, but turned and as sure as is said."""
    if not is_seen(one):
        return TrackedOrientation(R_world_camera, one.status, one.covariance)
    return TrackedOrientation(R_world_camera, status_of(covariance), covariance)
