# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""How far the camera turns while its pictures are read row by row, as its orientations tell."""

import numpy as np
from scipy.spatial.transform import Rotation

from sph_stab_ros.geometry.arrays import Vector
from sph_stab_ros.geometry.conventions import NS_PER_S
from sph_stab_ros.geometry.rolling_shutter import rate_at_end

# Orientations that are farther apart do not tell how fast it turns now.
MAX_INTERVAL_S = 0.5


class ReadoutTurn:
    """The angular velocity of a camera at the last of its orientations."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Forget all orientations."""
        self._last: tuple[int, Rotation] | None = None
        self._mean_rate_rad_s: Vector | None = None

    def update(self, time_ns: int, R_world_camera: Rotation, readout_s: float) -> Vector:
        """
        Return the turn during a read-out in the middle of which the camera has an orientation.

        A rotation vector (3,) in its own frame; zero where it is not known.
        """
        last, before = self._last, self._mean_rate_rad_s
        self._last, self._mean_rate_rad_s = (time_ns, R_world_camera), None
        if last is None:
            return np.zeros(3)
        elapsed_s = (time_ns - last[0]) / NS_PER_S
        if not 0 < elapsed_s < MAX_INTERVAL_S:
            return np.zeros(3)
        rate = self._mean_rate_rad_s = (last[1].inv() * R_world_camera).as_rotvec() / elapsed_s
        return readout_s * (rate if before is None else rate_at_end(rate, before))
