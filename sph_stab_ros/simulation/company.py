# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""
Flights in company: two to four people walk near a ground robot, or near who holds the camera.

From the first frame on they are the nearest things of the world and the richest in texture. Some
move along with the camera, some stand still for a while and catch up, and two cross in front of
each other. All of it follows from a seed alone; the walls are bare with every other pair of seeds.
"""

from collections.abc import Callable, Sequence

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation, RotationSpline

from sph_stab_ros.geometry.arrays import Floats, Values, Vectors
from sph_stab_ros.geometry.conventions import R_BODY_CAMERA
from sph_stab_ros.recording import RecordingError
from sph_stab_ros.simulation.flights import fit_in_room, Flight, frame_stamps_ns, harmonics, PAD_S
from sph_stab_ros.simulation.renderer import RenderOptions
from sph_stab_ros.simulation.room import BEARER, ROBOT, Room, Walk

KINDS = ('company_pioneer', 'company_handheld')
ROOM_SIZE_M = (14.0, 11.0, 3.2)
FRAMES, FRAME_RATE_HZ = 240, 30.0
NEAREST_M, FARTHEST_M = 0.7, 2.0  # from the camera to somebody who moves along with it
APART_M = 0.6  # between two people, axis to axis
FASTEST_M_S = 2.2  # walking briskly

_RATE_HZ = 200.0
_STEP_LENGTH_M, _STEP_HEIGHT_M = 0.7, 0.02
_TRIES = 2000


def pioneer(seed: int) -> Flight:
    """Ground robot, camera 0.9 m high: constant speed, turns by up to 35°/s, shakes by 0.7°."""
    rng = np.random.default_rng([seed, 0])
    times = _times_s()
    yaw = _integral(np.deg2rad(35.0) * harmonics(rng, 1, 1 / 60, 0.25)(times)[:, 0])
    shake = harmonics(rng, 3, 3.0, 9.0)(times)
    positions = _path(yaw, rng.uniform(0.3, 0.6))
    positions[:, 2] = 0.9 + 0.002 * shake[:, 2]
    return _flight(KINDS[0], times, np.column_stack((yaw, np.deg2rad(0.7) * shake[:, :2])),
                   positions)


def handheld(seed: int) -> Flight:
    """Camera held at 1.6 m by somebody who walks, looks around and bobs with every step."""
    rng = np.random.default_rng([seed, 1])
    times = _times_s()
    heading = _integral(np.deg2rad(35.0) * harmonics(rng, 1, 1 / 60, 0.25)(times)[:, 0])
    look = harmonics(rng, 3, 1 / 60, 0.7)(times) * np.deg2rad((25.0, 7.0, 6.0))
    look += harmonics(rng, 3, 1.5, 5.0)(times) * np.deg2rad(0.8)
    speed_m_s = rng.uniform(0.5, 1.0)
    positions = _path(heading, speed_m_s)
    step = 2 * np.pi * times * speed_m_s / _STEP_LENGTH_M
    positions[:, 2] = 1.6 + 0.02 * np.sin(step)
    positions[:, 0] -= 0.02 * np.sin(heading) * np.sin(step / 2)
    positions[:, 1] += 0.02 * np.cos(heading) * np.sin(step / 2)
    look[:, 0] += heading
    return _flight(KINDS[1], times, look, positions)


def room(flight: Flight, seed: int, plain_walls: bool = False,
         texels_per_m: float = 150.0) -> Room:
    """Return the Room of a flight, with everybody in it."""
    carrier = ROBOT if flight.name == KINDS[0] else BEARER
    return Room(flight, seed, furniture=24, people=0, plain_walls=plain_walls or bare(seed),
                texels_per_m=texels_per_m, companions=walks(flight, seed), carrier=carrier)


def bare(seed: int) -> bool:
    """Tell whether the walls are bare; not by even and odd, which one may want to set apart."""
    return seed // 2 % 2 == 1


def render_options(seed: int) -> RenderOptions:
    """Return what the camera does to the pictures: blur, exposure, stitch error, its carrier."""
    return RenderOptions(exposure_step=0.2, exposure_s=1 / 50, blur_samples=4, jitter=True,
                         stitch_error_deg=0.3, robot=True, seed=seed)


def walks(flight: Flight, seed: int) -> list[Walk]:
    """
    Return the paths of 2 to 4 people, from times in seconds (...,) to where the feet are (..., 3).

    The first moves along with the camera, the second pauses; they cross, as seen by the camera.
    Each further one moves along or pauses.
    """
    rng = np.random.default_rng([seed, 2 + KINDS.index(flight.name)])
    company = _Company(flight, rng)
    count = rng.integers(2, 5)
    company.add_pair()
    for _ in range(count - 2):
        company.add_other()
    return [CubicSpline(company.times, path) for path in company.paths]


class _Company:
    """
    People whose paths are made one after the other, each clear of the camera and the others.

    A path is ``camera + distance · (cos bearing, sin bearing)``, where the bearing is one in the
    room and all three are taken at a time of the walker's own, which stops during a pause.
    """

    def __init__(self, flight: Flight, rng: np.random.Generator) -> None:
        self._rng = rng
        self.times = np.arange(-PAD_S, flight.duration_s + PAD_S, 1 / _RATE_HZ)
        self._camera = flight.p_mocap_camera(self.times)[:, :2]
        self._leader = gaussian_filter1d(self._camera, 0.3 * _RATE_HZ, axis=0, mode='nearest')
        self._limit = np.array(flight.room_size_m[:2]) / 2 - 0.4
        self.paths: list[Vectors] = []

    def add_pair(self) -> None:
        """Add one who moves along and one who pauses; they change sides."""
        def pair() -> list[Vectors]:
            middle, swing, when_s = self._crossing()
            first = self._path(middle, -0.5 * swing, when_s, self._rng.uniform(0.8, 1.0))
            second = self._path(middle, swing, when_s, self._rng.uniform(1.5, 1.8), pauses=True)
            return [first, second]

        self.paths += self._first(pair, lambda paths: min(
            self._clearance(paths[0], []), self._clearance(paths[1], paths[:1]),
            np.inf if self._cross(*paths) else 0.0))

    def add_other(self) -> None:
        """Add somebody who moves along or pauses."""
        def other() -> list[Vectors]:
            return [self._path(self._rng.uniform(-np.pi, np.pi), 0.0, 0.0,
                               self._rng.uniform(0.8, 1.6), pauses=self._rng.random() < 0.5)]

        self.paths += self._first(other, lambda paths: self._clearance(paths[0], self.paths))

    def _first(self, propose: Callable[[], list[Vectors]],
               clearance: Callable[[list[Vectors]], float]) -> list[Vectors]:
        """Return the first proposal that leaves enough space."""
        for _ in range(_TRIES):
            paths = propose()
            if clearance(paths) >= 1.0:
                return paths
        raise RecordingError('nobody finds a way to walk along; choose another seed')

    def _crossing(self) -> tuple[float, float, float]:
        rng, end_s = self._rng, self.times[-1]
        return (rng.uniform(-np.pi, np.pi), rng.choice((-1, 1)) * np.deg2rad(rng.uniform(70, 110)),
                rng.uniform(0.3, 0.6) * end_s)

    def _path(self, bearing_rad: float, swing_rad: float, when_s: float, distance_m: float,
              pauses: bool = False) -> Vectors:
        """Feet (N, 3) of somebody who swings from one side of a bearing to the other."""
        wander = harmonics(self._rng, 2, 1 / 60, 0.25)(self.times)
        bearing = (bearing_rad + 0.25 * wander[:, 0]
                   + swing_rad / 2 * np.tanh((self.times - when_s) / 0.9))
        distance = distance_m * (1 + 0.12 * wander[:, 1])
        beside = distance[:, None] * np.column_stack((np.cos(bearing), np.sin(bearing)))
        path = CubicSpline(self.times, self._leader + beside)(
            self._clock_with_pause() if pauses else self.times)
        walked_m = np.cumsum(np.linalg.norm(np.diff(path, axis=0, prepend=path[:1]), axis=1))
        return np.column_stack(
            (path, _STEP_HEIGHT_M * np.sin(2 * np.pi * walked_m / _STEP_LENGTH_M)))

    def _clock_with_pause(self) -> Values:
        """Return times (N,) of one who stands still from some moment on, and catches up later."""
        start_s = self._rng.uniform(-PAD_S, 0.5 * self.times[-1])
        pause_s, catch_up_s = self._rng.uniform(1.0, 1.8), self._rng.uniform(1.5, 2.5)
        pace = np.ones_like(self.times)
        after_s = self.times - start_s
        pace[(after_s >= 0) & (after_s < pause_s)] = 0
        pace[(after_s >= pause_s) & (after_s < pause_s + catch_up_s)] += pause_s / catch_up_s
        pace = gaussian_filter1d(pace, 0.1 * _RATE_HZ, mode='nearest')
        clock = self.times[0] + np.cumsum(pace) / _RATE_HZ
        return np.minimum(clock, self.times[-1])

    def _clearance(self, path: Vectors, others: Sequence[Vectors]) -> float:
        """Return the least of what a path leaves of each limit; 1 or more is all right."""
        feet = path[:, :2]
        room = (self._limit - np.abs(feet)).min() + 1
        camera = np.linalg.norm(feet - self._camera, axis=1).min() / NEAREST_M
        speed = FASTEST_M_S / _RATE_HZ / np.linalg.norm(np.diff(feet, axis=0), axis=1).max()
        return min([room, camera, speed]
                   + [np.linalg.norm(feet - other[:, :2], axis=1).min() / APART_M
                      for other in others])

    def _cross(self, first: Vectors, second: Vectors) -> bool:
        """Tell whether the camera sees the one pass before the other."""
        a, b = (path[:, 0] - self._camera[:, 0] + 1j * (path[:, 1] - self._camera[:, 1])
                for path in (first, second))
        angle = np.angle(a / b)
        passes = (np.sign(angle[:-1]) != np.sign(angle[1:])) & (np.abs(angle[1:]) < 1)
        return bool(passes.any())


def _times_s() -> Values:
    end_s = (FRAMES - 1) / FRAME_RATE_HZ + PAD_S
    return np.arange(-PAD_S, end_s + 2 / _RATE_HZ, 1 / _RATE_HZ)


def _integral(rate: Floats) -> Floats:
    return np.cumsum(rate, axis=0) / _RATE_HZ


def _path(heading: Values, speed_m_s: float) -> Vectors:
    """Positions (N, 3) of somebody who goes where he heads, around the middle of the room."""
    way = np.column_stack((np.cos(heading), np.sin(heading), np.zeros_like(heading)))
    # Whoever walks beside has to fit in, too.
    return fit_in_room(speed_m_s * _integral(way), ROOM_SIZE_M, FARTHEST_M + 0.6)


def _flight(name: str, times: Values, angles: Vectors, positions: Vectors) -> Flight:
    return Flight(name, FRAME_RATE_HZ, frame_stamps_ns(FRAMES, FRAME_RATE_HZ), ROOM_SIZE_M,
                  RotationSpline(times, Rotation.from_euler('ZYX', angles) * R_BODY_CAMERA),
                  CubicSpline(times, positions))
