# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Landmarks and their life: born in a keyframe, agreed, missed, inactive, woken again."""

from dataclasses import dataclass

import numpy as np

from sph_stab_ros.geometry.arrays import Bearings, Choice, Floats, Indices, Values
from sph_stab_ros.tracking.anchored.pose_estimation import cauchy_weights
from sph_stab_ros.tracking.anchored.table import Table

# A landmark has a say in the pose once it has agreed with the others for so many frames: who walks
# by, or carries the camera, does not for long.
MATURE_FRAMES = 8
# Landmarks are deactivated when they are missed for so many frames, or disagree for as many.
MAX_MISSED = 6
MIN_AGREED, DISAGREEING = -5, -2


@dataclass
class Landmarks(Table):
    """
    N things to be seen again; each belongs to the keyframe in which its patch was cut, its host.

    ``number`` (N,) rises; ``host`` (N,) is the keyframe's, ``x``, ``east``, ``south`` (N, 3) the
    bearing and the patch's tangents in the host's camera, ``inverse_depth`` and ``information``
    (N,) as counted from there. ``agreed`` (N,) is for how many frames it has lately agreed with
    the others, ``missed`` (N,) for how many it has not been seen, ``active`` (N,) bool whether it
    is looked for, ``patch`` (N,) the row of its patch in the store.
    """

    number: Indices
    host: Indices
    x: Bearings
    east: Bearings
    south: Bearings
    inverse_depth: Values
    information: Values
    agreed: Indices
    missed: Indices
    active: Choice
    patch: Indices

    def is_mature(self, rows: Indices) -> Choice:
        """Tell which of those in rows have a say in the pose."""
        return self.agreed[rows] >= MATURE_FRAMES

    def judge(self, rows: Indices, agreeing: Choice, inverse_depths: Values) -> None:
        """Take in how those in rows were seen, which of them where the pose says; age the rest."""
        self.agreed[rows] += np.where(agreeing, 1, DISAGREEING)
        np.minimum(self.agreed, 2 * MATURE_FRAMES, out=self.agreed)
        self.inverse_depth[rows[agreeing]] = inverse_depths[agreeing]
        self._miss_all_but(rows[agreeing])

    def judge_for_now(self, rows: Indices, agreeing: Choice, inverse_depths: Values) -> None:
        """Do the same by a pose that may turn out to be wrong: being seen is enough to stay."""
        self.agreed[:] = 0
        self.agreed[rows[agreeing]] = MATURE_FRAMES
        self.inverse_depth[rows[agreeing]] = inverse_depths[agreeing]
        self._miss_all_but(rows)

    def wake(self, rows: Indices) -> None:
        """Look for those in rows again, which have just been seen."""
        self.active[rows] = True
        self.missed[rows] = 0

    def _miss_all_but(self, rows: Indices) -> None:
        """Deactivate those that have been missed for long, or disagree."""
        self.missed[self.active] += 1
        self.missed[rows] = 0
        self.active &= (self.missed < MAX_MISSED) & (self.agreed > MIN_AGREED)


@dataclass
class Observations(Table):
    """
    Landmarks as one camera saw them.

    Their numbers (N,), ascending, bearings y (N, 3) in the camera, ``sqrt_information`` (N, 2, 3).
    """

    number: Indices
    y: Bearings
    sqrt_information: Floats


def inlier_mask(sizes: Values, scale: float) -> Choice:
    """Tell which whitened residuals of such sizes (N,) are worth more than a quarter."""
    return cauchy_weights(sizes, scale) > 0.25
