# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""How what is learnt afterwards reaches the picture: smoothly, not by a jump."""

import numpy as np
from scipy.spatial.transform import Rotation

# A correction fades in by steps of this size, or by this share of what is left.
MIN_STEP_RAD = np.deg2rad(0.01)
SHARE = 0.2


class SmoothCorrection:
    """``R_out_world``: what is given out, against the world as it is known by now."""

    def __init__(self) -> None:
        self.R_out_world = Rotation.identity()

    def reset(self) -> None:
        """Give out what is known, at once."""
        self.R_out_world = Rotation.identity()

    def hide(self, R_before_camera: Rotation, R_world_camera: Rotation) -> None:
        """Give out as before, for now, though the camera's orientation is another one."""
        self.R_out_world = self.R_out_world * R_before_camera * R_world_camera.inv()

    def step(self) -> None:
        """Let a little more of it be seen."""
        left = self.R_out_world.as_rotvec()
        size = np.linalg.norm(left)
        step = max(MIN_STEP_RAD, SHARE * size)
        self.R_out_world = Rotation.from_rotvec(left * (max(0., size - step) / max(size, 1e-12)))
