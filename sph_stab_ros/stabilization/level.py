# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""
A level horizon: the world's y axis along gravity, its z axis in the camera's first heading.

The tracker's orientations count from an *origin*, the camera at the first picture. In it the
camera does not turn, so that the mean of the specific forces over a time T is gravity but for
``Δv / T``, Δv being the change of velocity: 0.4° for 2 m/s in 30 s. No acceleration has to be
recognised for that, and no gyro is needed.
"""

from threading import Lock

import numpy as np
from scipy.spatial.transform import Rotation

from sph_stab_ros.geometry.arrays import Stamps, Vector, Vectors
from sph_stab_ros.geometry.conventions import NS_PER_S
from sph_stab_ros.stabilization.imu_history import ImuHistory

UP = np.array((0., -1., 0.))
FORWARD = np.array((0., 0., 1.))
# Nearer to the vertical than this a direction has no heading.
STEEP_RAD = np.deg2rad(15)
GRAVITY_M_S2 = 9.80665
# Forces beyond are no measurements. A narrower gate would bias the mean: shaking with 1.5 g, the
# level is wrong by 4° with 0.5 to 1.5 g, by 0.5° with these.
USABLE_M_S2 = (0.2 * GRAVITY_M_S2, 5 * GRAVITY_M_S2)
AVERAGING_S = 30.
# A force stands for no more time than this before it.
MAX_PERIOD_NS = NS_PER_S // 50
# How long before a picture forces are of use, and how much of them is needed to begin with.
MAX_AGE_NS = 3 * NS_PER_S // 10
MIN_START_S = 0.1
# The world approaches its level with this time constant, and no faster than that.
APPROACH_S = 1.
MAX_RATE_RAD_S = np.deg2rad(10.)

# What a force of gravity looks like in g.
IN_G = (0.7, 1.3)


class LevelError(ValueError):
    """A level cannot be set now, with the reason in one line for the user."""


def heading(R_world_camera: Rotation) -> Rotation | None:
    """
    Return the level orientation that looks the same way, or None where the camera has no heading.

    That is a turn about the vertical. A camera that looks straight up or down, within 15°, has
    no heading.
    """
    x, _, z = R_world_camera.as_matrix() @ FORWARD
    if np.hypot(x, z) < np.sin(STEEP_RAD):
        return None
    return Rotation.from_rotvec((0., np.arctan2(x, z), 0.))


def level_rotation(up: Vector) -> Rotation:
    """
    Return the orientation of a camera, of heading zero, that has ``up`` (3,) upwards.

    A camera without heading is levelled by the smallest turn.
    """
    axis = np.cross(up, UP)
    sine = np.linalg.norm(axis)
    axis = axis / sine if sine > 1e-9 * np.linalg.norm(up) else FORWARD
    R = Rotation.from_rotvec(axis * np.arctan2(sine, up @ UP))
    R_world_heading = heading(R)
    return R if R_world_heading is None else R_world_heading.inv() * R


def why_no_force(stamp_ns: int, imu: ImuHistory) -> str:
    """Return why nothing that an IMU has felt is of use for the picture of this time."""
    stamps_ns, forces_m_s2 = imu.all_forces()
    if not len(stamps_ns):
        return 'none is heard'
    behind_s = (stamp_ns - int(stamps_ns[-1])) / NS_PER_S
    if not ((stamp_ns - MAX_AGE_NS < stamps_ns) & (stamps_ns <= stamp_ns)).any():
        return (f"the IMU's stamps are {abs(behind_s):.1f} s "
                f"{'behind' if behind_s > 0 else 'ahead of'} the pictures'")
    size_m_s2 = float(np.median(np.linalg.norm(forces_m_s2, axis=1)))
    if IN_G[0] < size_m_s2 < IN_G[1]:
        return f'they are of {size_m_s2:.2f} m/s², as if they were in g'
    if size_m_s2 < USABLE_M_S2[0]:
        return f'they are of {size_m_s2:.2f} m/s², as if gravity had been taken out'
    return f'they are of {size_m_s2:.0f} m/s², beyond what a camera at rest or in flight feels'


class Gravity:
    """The mean of the specific forces in the origin's frame, over half a minute."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Start anew, because orientations count from elsewhere or the IMU sits otherwise."""
        self._force_m_s2: Vector = np.zeros(3)
        self._averaged_s = 0.
        self._last_picture: tuple[int, Rotation] | None = None
        # Of the last force.
        self._last_ns: int | None = None

    @property
    def up(self) -> Vector | None:
        """Return what points upwards in the origin's frame, of any length; None if not known."""
        return self._force_m_s2 if self._averaged_s >= MIN_START_S else None

    def age_s(self, stamp_ns: int) -> float:
        """Return for how long before a picture there has been no force to use."""
        return 0. if self._last_ns is None else (stamp_ns - self._last_ns) / NS_PER_S

    def weigh(self, stamp_ns: int, R_origin_camera: Rotation, imu: ImuHistory) -> None:
        """Take in what an IMU has felt until the picture of this time and orientation."""
        # At first, and where the clock was set back.
        last_ns = self._last_ns
        if last_ns is None or last_ns > stamp_ns:
            last_ns = stamp_ns - MAX_AGE_NS
        stamps_ns, forces_m_s2 = imu.forces(max(stamp_ns - MAX_AGE_NS, last_ns), stamp_ns)
        sizes_m_s2 = np.linalg.norm(forces_m_s2, axis=1)
        usable = (USABLE_M_S2[0] < sizes_m_s2) & (sizes_m_s2 < USABLE_M_S2[1])
        if usable.any():
            stamps_ns = stamps_ns[usable]
            R_origin_then = self._orientations(stamps_ns, stamp_ns, R_origin_camera, imu)
            self._average(stamps_ns, R_origin_then.apply(forces_m_s2[usable]), last_ns)
            last_ns = int(stamps_ns[-1])
        self._last_ns = last_ns
        self._last_picture = stamp_ns, R_origin_camera

    def _orientations(self, stamps_ns: Stamps, stamp_ns: int, R_origin_camera: Rotation,
                      imu: ImuHistory) -> Rotation:
        """Return those of the camera at times (N,) before this picture, after the last one."""
        if self._last_picture is None or self._last_picture[0] >= stamp_ns:
            turns = [imu.gyro_rotation(stamp_ns, int(then_ns)) for then_ns in stamps_ns]
            return R_origin_camera * Rotation.concatenate(
                [Rotation.identity() if turn is None else turn for turn in turns])
        last_ns, R_origin_last = self._last_picture
        shares = np.clip((stamps_ns - last_ns) / (stamp_ns - last_ns), 0, 1)
        turn_rad = (R_origin_last.inv() * R_origin_camera).as_rotvec()
        return R_origin_last * Rotation.from_rotvec(shares[:, None] * turn_rad)

    def _average(self, stamps_ns: Stamps, forces_m_s2: Vectors, since_ns: int) -> None:
        """Let forces (N, 3) draw the mean to themselves, one after the other."""
        stand_for_s = np.diff(stamps_ns, prepend=since_ns).clip(max=MAX_PERIOD_NS) / NS_PER_S
        averaged_s = np.minimum(self._averaged_s + np.cumsum(stand_for_s), AVERAGING_S)
        shares = stand_for_s / averaged_s
        # What is left of the mean before each force, when all have drawn.
        left = np.cumprod((1 - shares)[::-1])[::-1]
        weights = shares * np.append(left[1:], 1)
        self._force_m_s2 = left[0] * self._force_m_s2 + weights @ forces_m_s2
        self._averaged_s = float(averaged_s[-1])


class Leveler:
    """
    The level world's orientation: of the first picture, of gravity, or as told.

    A level known at the first picture holds at once. One that comes or changes later is
    approached within seconds, at no more than 10°/s, so that the picture never jumps. Methods may
    be called from any thread.
    """

    def __init__(self) -> None:
        self._lock = Lock()
        self.reset()

    def reset(self) -> None:
        """Start anew, with the next orientation as the world's."""
        with self._lock:
            self._R_world_origin = self._R_level_origin = Rotation.identity()
            self._stamp_ns: int | None = None
            self._R_origin_camera: Rotation | None = None

    def level_here(self) -> None:
        """Make the present orientation level, but for its heading; LevelError if it has none."""
        with self._lock:
            if self._R_origin_camera is None:
                raise LevelError('there is no picture yet')
            R_world_heading = heading(self._R_world_origin * self._R_origin_camera)
            if R_world_heading is None:
                raise LevelError(
                    'the camera looks straight up or down and has no heading to keep')
            self._R_level_origin = R_world_heading * self._R_origin_camera.inv()

    def update(self, stamp_ns: int, R_origin_camera: Rotation,
               up: Vector | None = None) -> Rotation:
        """Return ``R_world_origin`` at a picture; ``up`` (3,) in the origin's frame, if known."""
        with self._lock:
            if up is not None:
                self._R_level_origin = level_rotation(up)
            self._R_world_origin = self._approached(stamp_ns)
            self._stamp_ns, self._R_origin_camera = stamp_ns, R_origin_camera
            return self._R_world_origin

    def _approached(self, stamp_ns: int) -> Rotation:
        """Return R_world_origin on its way to R_level_origin."""
        if self._R_world_origin is self._R_level_origin:
            return self._R_world_origin
        correction_rad = (self._R_level_origin * self._R_world_origin.inv()).as_rotvec()
        share = 1.
        if self._stamp_ns is not None:
            elapsed_s = max(0, stamp_ns - self._stamp_ns) / NS_PER_S
            share = min(1 - np.exp(-elapsed_s / APPROACH_S),
                        MAX_RATE_RAD_S * elapsed_s / max(np.linalg.norm(correction_rad), 1e-9))
        return Rotation.from_rotvec(share * correction_rad) * self._R_world_origin
