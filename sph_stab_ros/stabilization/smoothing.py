# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""
How much of the camera's rotation the picture keeps: none, slow turns, or slow turns of heading.

The virtual camera, whose pictures are shown, is drawn towards a target: the world itself
(``lock``, the paper's rotation-less camera), the camera (``follow``), or the level camera of the
same heading (``yaw_follow``). It moves like a critically damped second-order low-pass::

    d²x/dt² = Ω² (u − x) − 2Ω dx/dt,    Ω = 2 / τ,    H(s) = 1 / (1 + s τ/2)²

and so never overshoots a step, stays behind a steady turn by the time constant τ in seconds, and
damps trembling with the square of its frequency; a first-order one, with the same lag, damps only
in proportion to it and passes every start and stop of a turn on as a jerk.
"""

import numpy as np
from scipy.spatial.transform import Rotation

from sph_stab_ros.config import FOLLOW, LOCK, SmoothingConfig, YAW_FOLLOW
from sph_stab_ros.geometry.arrays import Vector
from sph_stab_ros.geometry.conventions import NS_PER_S
from sph_stab_ros.stabilization.level import heading

WORLD = Rotation.identity()
# The axis of a smaller rotation is noise.
NO_AXIS_RAD = 1e-6


class Smoother:
    """
    The virtual camera's orientation from those of the camera.

    It starts in its target. Its orientation and angular velocity go on unchanged when mode or
    time constant change, so that no change makes the picture jump: it glides to its new target,
    to the world, too, when the mode becomes ``lock`` again.

    Between frames the target is taken to turn steadily, for which the filter is solved exactly:
    how often and how regularly frames come makes no difference, or little where the axis changes
    quickly (0.5° at 30 Hz and 380°/s).

    The target may turn by any angle: the picture goes the way that the camera went, not the
    shortest. Where the camera looks straight up or down it has no heading, and ``yaw_follow``
    keeps to the last one; tipped over the pole it looks the other way, and the picture swings
    round as slowly as it does after any other turn.
    """

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Start anew, at rest in the next target."""
        # Of no meaning before there is an orientation.
        self._stamp_ns = 0
        self._R_world_heading = Rotation.identity()
        self._R_world_virtual: Rotation | None = None
        self._velocity_rad_s: Vector = np.zeros(3)
        # The target as a rotation vector from the virtual camera, in its frame.
        self._ahead_rad: Vector = np.zeros(3)

    def update(
            self, config: SmoothingConfig, stamp_ns: int, R_world_camera: Rotation) -> Rotation:
        """Return R_world_virtual for the next R_world_camera."""
        R_world_target = self._target(config.mode, R_world_camera)
        if self._R_world_virtual is None:
            self._R_world_virtual = R_world_target
            self._stamp_ns = stamp_ns
        if R_world_target is WORLD and self._R_world_virtual is WORLD:
            # It rests, as in all frames of those who never wanted anything else.
            self._stamp_ns = stamp_ns
            return WORLD
        ahead_rad = _rotvec_near(self._R_world_virtual.inv() * R_world_target, self._ahead_rad)
        elapsed_s = (stamp_ns - self._stamp_ns) / NS_PER_S
        turn_rad: Vector = np.zeros(3)
        if elapsed_s > 0:
            turn_rad, self._velocity_rad_s = _low_pass(
                self._velocity_rad_s, self._ahead_rad, ahead_rad, elapsed_s,
                config.time_constant_s)
        self._R_world_virtual = self._R_world_virtual * Rotation.from_rotvec(turn_rad)
        # In the frame that has turned on; half, since rotation vectors bend half as much.
        self._velocity_rad_s = Rotation.from_rotvec(-turn_rad / 2).apply(self._velocity_rad_s)
        self._ahead_rad = _rotvec_near(
            self._R_world_virtual.inv() * R_world_target, ahead_rad - turn_rad)
        self._stamp_ns = stamp_ns
        return self._R_world_virtual

    def _target(self, mode: str, R_world_camera: Rotation) -> Rotation:
        """Return R_world_target."""
        R_world_heading = heading(R_world_camera)
        if R_world_heading is not None:
            self._R_world_heading = R_world_heading
        return {LOCK: WORLD, FOLLOW: R_world_camera,
                YAW_FOLLOW: self._R_world_heading}[mode]


def _low_pass(velocity: Vector, u_start: Vector, u_end: Vector, elapsed_s: float,
              time_constant_s: float) -> tuple[Vector, Vector]:
    """Return x and dx/dt after ``elapsed_s``, from x = 0, for an input on a straight line."""
    omega = 2 / time_constant_s
    slope = (u_end - u_start) / elapsed_s
    # x − u settles at −2 slope / Ω; what is left of it, and its rate, die away.
    settled = -2 * slope / omega
    left = -u_start - settled
    rate = velocity - slope
    pull = rate + omega * left
    decay = np.exp(-omega * elapsed_s)
    return (u_end + settled + (left + pull * elapsed_s) * decay,
            slope + (rate - omega * pull * elapsed_s) * decay)


def _rotvec_near(R: Rotation, rotvec_rad: Vector) -> Vector:
    """Return the rotation vector of R, whole turns added, that is next to the one given."""
    shortest_rad = R.as_rotvec()
    along = shortest_rad if np.linalg.norm(shortest_rad) > NO_AXIS_RAD else rotvec_rad
    axis = along / max(float(np.linalg.norm(along)), NO_AXIS_RAD)
    turns = np.rint(axis @ (rotvec_rad - shortest_rad) / (2 * np.pi))
    return shortest_rad + 2 * np.pi * turns * axis
