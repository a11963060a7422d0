# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""
Bearings of landmarks in pictures whose rows are read one after the other (rolling shutter).

The camera turns and moves between the first row and the last. To the first order each bearing is
off by as much of that as its row is early or late, as in J. Hedborg, P.-E. Forssén, M. Felsberg
and E. Ringaby, *Rolling shutter bundle adjustment*, Computer Vision and Pattern Recognition, 2012.
"""

import numpy as np

from sph_stab_ros.geometry.arrays import Bearings, Plane, Values, Vector
from sph_stab_ros.geometry.rolling_shutter import shares_along
from sph_stab_ros.geometry.rotations import cross


class Readout:
    """
    What happens to bearings while a picture is read; nothing by default.

    Parameters
    ----------
    duration_s : float
        From the first row to the last.
    shares : (320, 640), optional
        When directions are read, as ``readout_shares`` tells; needed unless all is read at once.

    """

    def __init__(self, duration_s: float = 0., shares: Plane | None = None) -> None:
        self._duration_s, self._shares = duration_s, shares
        self.stand_still()

    @property
    def is_rolling(self) -> bool:
        """Whether rows are read one after the other."""
        return self._shares is not None

    def stand_still(self) -> None:
        """Take the camera to be at rest during the next picture."""
        self._turn: Vector = np.zeros(3)
        self._way: Vector = np.zeros(3)

    def set_motion(self, angular_velocity_rad_s: Vector, velocity_per_s: Vector) -> None:
        """Take the camera to turn and move so during the next picture, in its own frame, (3,)."""
        self._turn = self._duration_s * angular_velocity_rad_s
        self._way = self._duration_s * velocity_per_s

    def as_seen(self, bearings: Bearings, inverse_distances: Values | float) -> Bearings:
        """Return where bearings (N, 3) of the middle of the read-out are to be seen."""
        return self._later(bearings, inverse_distances, 1)

    def corrected(self, bearings: Bearings, inverse_distances: Values | float) -> Bearings:
        """Return the bearings (N, 3) in the middle of the read-out of what is seen."""
        return self._later(bearings, inverse_distances, -1)

    def _later(self, bearings: Bearings, inverse_distances: Values | float,
               sign: int) -> Bearings:
        if self._shares is None:
            return bearings
        step = cross(bearings, self._turn[None]) - np.multiply.outer(inverse_distances, self._way)
        moved = bearings + sign * shares_along(self._shares, bearings)[:, None] * step
        return moved / np.linalg.norm(moved, axis=1, keepdims=True)
