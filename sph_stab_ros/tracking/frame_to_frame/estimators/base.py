# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What estimators take and give."""

from dataclasses import dataclass
from enum import Enum
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from sph_stab_ros.geometry.arrays import Bearings, Values, Vector


@dataclass(frozen=True)
class BearingPairs:
    """The same points seen twice: unit bearings (N, 3) each, and weights (N,) ≥ 0."""

    previous: Bearings
    current: Bearings
    weights: Values

    def __len__(self) -> int:
        return len(self.weights)

    def __getitem__(self, index: Any) -> 'BearingPairs':
        return BearingPairs(self.previous[index], self.current[index], self.weights[index])

    @classmethod
    def empty(cls) -> 'BearingPairs':
        """Return no pairs at all."""
        return cls(np.empty((0, 3)), np.empty((0, 3)), np.empty(0))


class FitStatus(Enum):
    """How a fit ended."""

    OK = 'ok'
    # Rotation only: the flow left after derotation does not rise above its noise.
    NO_PARALLAX = 'no_parallax'


@dataclass(frozen=True)
class RotationEstimate:
    """
    The rotation between two frames, with what is needed to distrust it.

    ``t_current`` is the unit epipole (3,), or None for methods without translation;
    ``residual_rad`` the weighted median of what the model leaves unexplained: the derotated
    flow for rotations alone, the distance to the epipolar plane where there is a ``t_current``.
    ``support`` is the number of pairs the fit stands on.
    """

    R_current_previous: Rotation
    residual_rad: float
    support: int
    t_current: Vector | None = None
    status: FitStatus = FitStatus.OK


def weighted_median(values: Values, weights: Values) -> float:
    """Return the value (of values (N,)) below which half of the weights (N,) lie."""
    order = np.argsort(values)
    cumulated = np.cumsum(weights[order])
    return float(values[order[np.searchsorted(cumulated, cumulated[-1] / 2)]])
