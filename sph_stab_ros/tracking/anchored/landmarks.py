# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Landmarks and their life: born in a keyframe, agreed, missed, inactive, woken again."""

from dataclasses import dataclass, fields, replace

import numpy as np

from sph_stab_ros.geometry.arrays import Bearings, Choice, Floats, Indices, Values
from sph_stab_ros.tracking.anchored.table import Table


@dataclass(frozen=True)
class LandmarkOptions:
    """When a landmark has a say, and when it is looked for no more."""

    # It has a say in the pose once it has agreed with the others for so many frames: who walks by,
    # or carries the camera, does not for long.
    mature_frames: int = 8
    # It is deactivated when it has been missed for so many frames, or disagreed until its count of
    # frames, by so much with each, has come down so far.
    max_missed: int = 6
    disagreeing: int = -2
    min_agreed: int = -5


@dataclass(frozen=True)
class Landmarks(Table):
    """
    N things to be seen again; each belongs to the keyframe in which its patch was cut, its host.

    ``number`` (N,) rises; ``host`` (N,) is the keyframe's, ``x``, ``east``, ``south`` (N, 3) the
    bearing and the patch's tangents in the host's camera, ``inverse_depth`` and ``information``
    (N,) as counted from there. ``agreed`` (N,) is for how many frames it has lately agreed with
    the others, ``missed`` (N,) for how many it has not been seen, ``active`` (N,) bool whether it
    is looked for, ``patch`` (N,) the row of its patch in the store.

    Nothing of it can be written to; who changes a landmark makes a new table. The map alone does.
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

    def __post_init__(self) -> None:
        """Protect all columns."""
        for one in fields(self):
            getattr(self, one.name).flags.writeable = False

    @classmethod
    def none(cls) -> 'Landmarks':
        """Return an empty table."""
        numbers, bearings, values = np.empty(0, int), np.empty((0, 3)), np.empty(0)
        return cls(numbers, numbers, bearings, bearings, bearings, values, values, numbers,
                   numbers, np.empty(0, bool), numbers)

    @classmethod
    def new(cls, first_number: int, host: int, axes: tuple[Bearings, Bearings, Bearings],
            inverse_depth: float, information: float, patch: Indices) -> 'Landmarks':
        """Return landmarks that are born in a keyframe: x, east and south (N, 3) are ``axes``."""
        n = len(patch)
        return cls(first_number + np.arange(n), np.full(n, host), *axes,
                   np.full(n, inverse_depth), np.full(n, information), np.zeros(n, int),
                   np.zeros(n, int), np.ones(n, bool), patch)

    def judged(self, rows: Indices, agreeing: Choice, inverse_depths: Values,
               options: LandmarkOptions) -> 'Landmarks':
        """Return them as those in rows were seen, some where the pose says; the rest aged."""
        agreed = self.agreed.copy()
        agreed[rows] += np.where(agreeing, 1, options.disagreeing)
        np.minimum(agreed, 2 * options.mature_frames, out=agreed)
        return self._aged(agreed, rows[agreeing], rows[agreeing], inverse_depths[agreeing],
                          options)

    def judged_for_now(self, rows: Indices, agreeing: Choice, inverse_depths: Values,
                       options: LandmarkOptions) -> 'Landmarks':
        """Return the same by a pose that may turn out wrong: being seen is enough to stay."""
        agreed = np.zeros_like(self.agreed)
        agreed[rows[agreeing]] = options.mature_frames
        return self._aged(agreed, rows, rows[agreeing], inverse_depths[agreeing], options)

    def woken(self, rows: Indices) -> 'Landmarks':
        """Return them with those in rows looked for again, which have just been seen."""
        active, missed = self.active.copy(), self.missed.copy()
        active[rows] = True
        missed[rows] = 0
        return replace(self, active=active, missed=missed)

    def adjusted(self, rows: Indices, inverse_depths: Values, information: Values) -> 'Landmarks':
        """Return them with the inverse depths (N,) of those in rows, and what is known of them."""
        inverse_depth, known = self.inverse_depth.copy(), self.information.copy()
        inverse_depth[rows], known[rows] = inverse_depths, information
        return replace(self, inverse_depth=inverse_depth, information=known)

    def _aged(self, agreed: Indices, seen: Indices, known: Indices, inverse_depths: Values,
              options: LandmarkOptions) -> 'Landmarks':
        """Return them with those deactivated that have been missed for long, or disagree."""
        inverse_depth = self.inverse_depth.copy()
        inverse_depth[known] = inverse_depths
        missed = self.missed + self.active
        missed[seen] = 0
        active = self.active & (missed < options.max_missed) & (agreed > options.min_agreed)
        return replace(self, inverse_depth=inverse_depth, agreed=agreed, missed=missed,
                       active=active)


@dataclass
class Observations(Table):
    """
    Landmarks as one camera saw them.

    Their numbers (N,), ascending, bearings y (N, 3) in the camera, ``sqrt_information`` (N, 2, 3).
    """

    number: Indices
    y: Bearings
    sqrt_information: Floats

    @classmethod
    def none(cls) -> 'Observations':
        """Return no observations at all."""
        return cls(np.empty(0, int), np.empty((0, 3)), np.empty((0, 2, 3)))


def are_among(numbers: Indices, others: Indices) -> Choice:
    """Tell which of ascending numbers (N,) are among ascending others (M,), M > 0."""
    place = np.minimum(np.searchsorted(others, numbers), len(others) - 1)
    return others[place] == numbers
