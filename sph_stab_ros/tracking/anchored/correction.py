# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""How what is learnt afterwards reaches the picture: smoothly, not by a jump."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation


@dataclass(frozen=True)
class CorrectionOptions:
    """How quickly a correction fades in, per frame."""

    # By a step of at least this size: what trembles by less nobody sees.
    min_step_rad: float = np.deg2rad(0.01)
    # And by this share of what is left: nine tenths of it within a third of a second at 30 Hz.
    share: float = 0.2


class SmoothCorrection:
    """``R_out_world``: what is given out, against the world as it is known by now."""

    def __init__(self, options: CorrectionOptions) -> None:
        self._options = options
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
        size = float(np.linalg.norm(left))
        if not size:
            return
        step = max(self._options.min_step_rad, self._options.share * size)
        self.R_out_world = Rotation.from_rotvec(left * (max(0., size - step) / size))
