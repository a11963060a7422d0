# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Where a camera is, how it moves, and how it is expected to have turned and moved since."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from sph_stab_ros.geometry.arrays import Vector
from sph_stab_ros.geometry.conventions import NS_PER_S
from sph_stab_ros.geometry.rolling_shutter import rate_at_end
from sph_stab_ros.tracking.base import GyroRotation


@dataclass(frozen=True)
class MotionOptions:
    """How the camera's position is expected to change, in the unit of the map."""

    # Of the velocity, what is left of it until the next frame: it decays, as in G. Klein and
    # D. Murray, *Parallel tracking and mapping for small AR workspaces*, 2007.
    inertia: float = 0.8
    # How far the camera moves against a prediction: a standard deviation per second, and no less.
    position_sigma_per_s: float = 0.6
    min_position_sigma: float = 0.02


class MotionModel:
    """
    The pose at the last frame that showed something, with its velocities.

    ``R_world_camera`` and ``position`` (3,), in the unit of the map.

    Parameters
    ----------
    max_prediction_s : float
        For how long the velocities are trusted.
    gyro_rotation : GyroRotation
        Returns the turn ``R_from_to`` between two stamps as a gyro saw it, or None.
    options : MotionOptions

    """

    def __init__(self, max_prediction_s: float, gyro_rotation: GyroRotation,
                 options: MotionOptions = MotionOptions()) -> None:
        self._options = options
        self._max_prediction_s = max_prediction_s
        self._turn_between = gyro_rotation
        self.R_world_camera = Rotation.identity()
        self.reset(None)

    def reset(self, stamp_ns: int | None) -> None:
        """Begin at the origin, at rest, in the present orientation; at a time that may be None."""
        self._stamp_ns = stamp_ns
        self.position: Vector = np.zeros(3)
        self._velocity_per_s: Vector = np.zeros(3)
        self._angular_velocity_rad_s: Vector | None = None

    def update(self, stamp_ns: int, R_world_camera: Rotation, position: Vector) -> Rotation:
        """Be there at the next frame; return the step R_last_camera."""
        step, move = self.R_world_camera.inv() * R_world_camera, position - self.position
        self._angular_velocity_rad_s, self._velocity_per_s = None, np.zeros(3)
        if self._stamp_ns is not None and stamp_ns > self._stamp_ns:
            elapsed_s = (stamp_ns - self._stamp_ns) / NS_PER_S
            self._angular_velocity_rad_s = step.as_rotvec() / elapsed_s
            self._velocity_per_s = move / elapsed_s
        self._stamp_ns, self.R_world_camera, self.position = stamp_ns, R_world_camera, position
        return step

    def rotate_world(self, R_new_old: Rotation) -> None:
        """Count from a world that is turned against the old one."""
        self.R_world_camera = R_new_old * self.R_world_camera
        self.position = R_new_old.apply(self.position)
        self._velocity_per_s = R_new_old.apply(self._velocity_per_s)

    def trusted_s(self, stamp_ns: int) -> float:
        """Return the time since the last frame, as far as the velocities are trusted."""
        if self._stamp_ns is None:
            return 0.
        elapsed_s = (stamp_ns - self._stamp_ns) / NS_PER_S
        return min(max(elapsed_s, 0.), self._max_prediction_s)

    def position_at(self, stamp_ns: int) -> Vector:
        """Return the position (3,) expected."""
        elapsed_s = self._options.inertia * self.trusted_s(stamp_ns)
        return self.position + elapsed_s * self._velocity_per_s

    def velocities_at(self, stamp_ns: int, R_world_camera: Rotation,
                      position: Vector) -> tuple[Vector, Vector]:
        """
        Return the angular velocity in rad/s and the velocity per second at the next pose.

        Both (3,) in the camera's frame.
        """
        elapsed_s, turn_rate_rad_s = self.trusted_s(stamp_ns), self._angular_velocity_rad_s
        if not elapsed_s:
            return np.zeros(3), np.zeros(3)
        turn: Vector = (self.R_world_camera.inv() * R_world_camera).as_rotvec() / elapsed_s
        velocity: Vector = (position - self.position) / elapsed_s
        if turn_rate_rad_s is not None:
            turn = rate_at_end(turn, turn_rate_rad_s)
            velocity = rate_at_end(velocity, self._velocity_per_s)
        return turn, R_world_camera.inv().apply(velocity)

    def predicted_rotation(self, stamp_ns: int) -> Rotation:
        """Return the turn R_last_camera expected."""
        measured = self._gyro_rotation_since(stamp_ns)
        if measured is not None:
            return measured
        if self._angular_velocity_rad_s is None:
            return Rotation.identity()
        return Rotation.from_rotvec(self._angular_velocity_rad_s * self.trusted_s(stamp_ns))

    def is_predictable(self, stamp_ns: int) -> bool:
        """Tell whether the turn expected is more than a guess."""
        return self._gyro_rotation_since(stamp_ns) is not None or (
            self._angular_velocity_rad_s is not None and self._stamp_ns is not None
            and 0 <= stamp_ns - self._stamp_ns <= self._max_prediction_s * NS_PER_S)

    def _gyro_rotation_since(self, stamp_ns: int) -> Rotation | None:
        """Return the turn as the gyro saw it, None where it did not."""
        return None if self._stamp_ns is None else self._turn_between(self._stamp_ns, stamp_ns)
