# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""
Camera motions with exact truth at any time, driven by real logs or synthetic.

The frame `mocap` is the room: metric, z up, origin in the middle of the floor. The body
is REP 103 (x forward, y left, z up), the camera optical (x right, y down, z forward) and
upright on the body: `R_mocap_camera = R_mocap_body R_body_camera`. Body angles are
yaw, pitch, roll with `R_mocap_body = R_z(yaw) R_y(pitch) R_x(roll)`.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeAlias
import warnings

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation, RotationSpline

from sph_stab_ros.geometry.arrays import Floats, Stamps, Values, Vectors
from sph_stab_ros.geometry.conventions import R_BODY_CAMERA, R_CAMERA_BODY

# x, y, z in metres.
Size: TypeAlias = tuple[float, float, float]
ROOM_SIZE_M = (8.0, 6.0, 3.2)
HALL_SIZE_M = (9.0, 6.0, 2.8)
PAD_S = 0.25  # every flight is also known this long before its first and after its last frame

_EPOCH_NS = 1_700_000_000_000_000_000
_LOG_RATE_HZ = 200.0
_LOG_FRAMES = 500
_LOG_FRAME_RATE_HZ = 30.0


class LogError(ValueError):
    """A log cannot be read or is too short."""


@dataclass(frozen=True)
class Flight:
    """
    A camera motion: times `t_s` are seconds after the first frame.

    `stamps_ns` (N,) int64 are the frames' stamps, `room_size_m` the box (x, y, z) in which
    the motion stays. Poses are known for `-PAD_S <= t_s <= duration_s + PAD_S`.
    """

    name: str
    frame_rate_hz: float
    stamps_ns: Stamps
    room_size_m: Size
    rotation: Callable[[Floats], Rotation]
    position: Callable[[Floats], Floats]

    @property
    def frame_times_s(self) -> Values:
        """Return the times (N,) of the frames, the first at zero."""
        return (self.stamps_ns - self.stamps_ns[0]) * 1e-9

    @property
    def duration_s(self) -> float:
        """Time from the first to the last frame."""
        return float(self.frame_times_s[-1])

    def R_mocap_camera(self, t_s: ArrayLike) -> Rotation:
        """Orientation of the camera at the times `t_s`, a scalar or (N,)."""
        return self.rotation(self._checked(t_s))

    def p_mocap_camera(self, t_s: ArrayLike) -> Floats:
        """Position of the camera in metres at the times `t_s`: (3,) or (N, 3)."""
        return self.position(self._checked(t_s))

    def cut(self, first: int, frames: int, every: int = 1) -> 'Flight':
        """Return part of the flight: `frames` of its frames, each `every`-th from `first` on."""
        stamps_ns = self.stamps_ns[first:first + (frames - 1) * every + 1:max(every, 1)]
        if first < 0 or frames < 1 or every < 1 or len(stamps_ns) < frames:
            raise ValueError(f'{self.name} has {len(self.stamps_ns)} frames, too few for '
                             f'{frames} (every {every}) from {first} on')
        start_s = (stamps_ns[0] - self.stamps_ns[0]) * 1e-9
        return replace(self, frame_rate_hz=self.frame_rate_hz / every, stamps_ns=stamps_ns,
                       rotation=lambda t_s: self.rotation(t_s + start_s),
                       position=lambda t_s: self.position(t_s + start_s))

    def _checked(self, t_s: ArrayLike) -> Floats:
        t = np.asarray(t_s, dtype=float)
        if np.any(t < -PAD_S - 1e-9) or np.any(t > self.duration_s + PAD_S + 1e-9):
            raise ValueError(f'{self.name}: time outside of -{PAD_S} s … '
                             f'{self.duration_s + PAD_S:.3f} s')
        return t


def drone(logs: Path, frames: int = 500) -> Flight:
    """
    Indoor drone at 30 fps from EuRoC V1_02: its first `frames` of 500.

    Only what is slower than about 1 Hz is scaled and shifted, so that pitch spans ±15° and
    roll −25…+15° over the 500 frames; yaw (over 360°) and all jitter are the log's own.
    """
    t, R_log_sensor = _read_rotations(logs / 'euroc_V102_drone.csv')
    # The log's sensor has x up, y right, z forward.
    R_sensor_body = Rotation.from_matrix([[0, 0, 1], [0, -1, 0], [1, 0, 0]])
    angles = _body_angles(R_log_sensor * R_sensor_body)
    times, angles, positions = _window(
        t, angles, _read_positions(logs / 'euroc_V102_drone_pos.csv'), start_s=41.0)
    angles[:, 1] = _span(angles[:, 1], np.deg2rad(-15.0), np.deg2rad(15.0))
    angles[:, 2] = _span(angles[:, 2], np.deg2rad(-25.0), np.deg2rad(15.0))
    positions = fit_in_room(positions, ROOM_SIZE_M, clearance_m=0.9)
    return _sampled('drone', frames, ROOM_SIZE_M, times, angles, positions)


def handheld(logs: Path, frames: int = 500) -> Flight:
    """
    Camera carried on foot at 30 fps from TUM fr2/desk: its first `frames` of 500.

    The log looks down at a desk and is slow; here the camera is held upright on average and
    the log played twice as fast, at about 0.45 m/s.
    """
    t, R_log_optical = _read_rotations(logs / 'tum_fr2desk_handheld.csv')
    angles = _body_angles(R_log_optical * R_CAMERA_BODY)
    times, angles, positions = _window(
        t / 2.0, angles, _read_positions(logs / 'tum_fr2desk_handheld_pos.csv'), start_s=31.0)
    # The log is rounded to 1e-4, which would shake the camera at 200 Hz.
    angles, positions = (gaussian_filter1d(x, 0.03 * _LOG_RATE_HZ, axis=0)
                         for x in (angles, positions))
    angles[:, 1:] -= angles[:, 1:].mean(axis=0)
    positions = fit_in_room(positions, ROOM_SIZE_M, clearance_m=0.9)
    return _sampled('handheld', frames, ROOM_SIZE_M, times, angles, positions)


def pioneer(logs: Path, frames: int = 500, seed: int = 0) -> Flight:
    """
    Ground robot at 30 fps and 0.5 m/s, camera 1 m high: its first `frames` of 500.

    The heading is that of the KITTI 00 car, played 1.6 times as fast; roll and pitch vibrate
    by up to 0.4° between 3 and 9 Hz.
    """
    t, R_log_optical = _read_rotations(logs / 'kitti00_car.csv')
    angles = _body_angles(R_BODY_CAMERA * R_log_optical * R_CAMERA_BODY)
    times, angles, _ = _window(t / 1.6, angles, np.zeros((len(t), 3)), start_s=204.0)
    yaw = gaussian_filter1d(angles[:, 0], 0.15 * _LOG_RATE_HZ) + np.deg2rad(125.0)
    shake = harmonics(np.random.default_rng(seed), 3, 3.0, 9.0)(times)
    angles = np.stack([yaw, *(np.deg2rad(0.4) * shake[:, :2].T)], axis=1)
    step = 0.5 / _LOG_RATE_HZ * np.stack([np.cos(yaw), np.sin(yaw)], axis=1)
    positions = fit_in_room(np.column_stack([np.cumsum(step, axis=0), 0.002 * shake[:, 2]]),
                            HALL_SIZE_M, clearance_m=0.9)
    positions[:, 2] += 1.0 - positions[:, 2].mean()
    return _sampled('pioneer', frames, HALL_SIZE_M, times, angles, positions)


def synthetic(
        seed: int, frames: int = 60, frame_rate_hz: float = 30.0,
        rotation_amplitude_deg: float = 20.0, translation_amplitude_m: float = 0.8,
        max_frequency_hz: float = 0.5, name: str = 'synthetic') -> Flight:
    """
    Band-limited random motion around the middle of the room, closed after 60 s.

    Each component of the rotation vector and of the position stays within its amplitude.
    """
    rng = np.random.default_rng(seed)
    rotation = harmonics(rng, 3, 1 / 60.0, max_frequency_hz)
    translation = harmonics(rng, 3, 1 / 60.0, max_frequency_hz)
    middle = np.array([0.0, 0.0, ROOM_SIZE_M[2] / 2])
    return Flight(
        name, frame_rate_hz, frame_stamps_ns(frames, frame_rate_hz), ROOM_SIZE_M,
        lambda t: (Rotation.from_rotvec(np.deg2rad(rotation_amplitude_deg) * rotation(t))
                   * R_BODY_CAMERA),
        lambda t: middle + translation_amplitude_m * translation(t))


def hover(seed: int = 0, laps: int = 10, frame_rate_hz: float = 30.0) -> Flight:
    """Hovering on a closed path of 60 s, flown `laps` times."""
    return synthetic(seed, round(60 * laps * frame_rate_hz), frame_rate_hz, 8.0, 0.3,
                     name='hover')


def shake(seed: int = 0, frames: int = 150, frame_rate_hz: float = 15.0,
          fastest_deg_per_frame: float = 8.0) -> Flight:
    """Fast shaking: in the first ten seconds frames turn by at most what is stated, once."""
    def flight(amplitude_deg: float, frames: int) -> Flight:
        return synthetic(seed, frames, frame_rate_hz, amplitude_deg, 0.1, 2.0, 'shake')

    def excess(amplitude_deg: float) -> float:
        shaken = flight(amplitude_deg, round(10 * frame_rate_hz))
        R = shaken.R_mocap_camera(shaken.frame_times_s)
        return np.rad2deg((R[:-1].inv() * R[1:]).magnitude().max()) - fastest_deg_per_frame

    return flight(brentq(excess, 0.1, 90.0), frames)


def frame_stamps_ns(frames: int, frame_rate_hz: float) -> Stamps:
    return _EPOCH_NS + np.round(np.arange(frames) * (1e9 / frame_rate_hz)).astype(np.int64)


def _read_rotations(path: Path) -> tuple[Values, Rotation]:
    """Return times (N,) in seconds, strictly increasing, and the rotations of a log."""
    log = _read_log(path, columns=5)
    return log[:, 0], Rotation.from_quat(log[:, [2, 3, 4, 1]])


def _read_positions(path: Path) -> Vectors:
    """Return positions (N, 3) in metres of a log, one for each of `_read_rotations`."""
    return _read_log(path, columns=4)[:, 1:]


def _read_log(path: Path, columns: int) -> Floats:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter('error')  # an empty file is only warned about
            log = np.loadtxt(path, delimiter=',', ndmin=2)
    except (OSError, ValueError, UserWarning) as error:
        raise LogError(f'{path} cannot be read: {error}') from None
    if log.shape[1] != columns or not np.isfinite(log).all():
        raise LogError(f'{path} should have {columns} columns of numbers')
    # Stamps come twice in one of the logs.
    return log[np.append(True, np.diff(log[:, 0]) > 0)]


def _body_angles(R_log_body: Rotation) -> Vectors:
    """Yaw, pitch, roll (N, 3) in radians, without jumps."""
    return np.unwrap(R_log_body.as_euler('ZYX'), axis=0)


def _window(t: Values, angles: Vectors, positions: Vectors,
            start_s: float) -> tuple[Values, Vectors, Vectors]:
    """Return part of a log on a regular grid: times (M,), angles and positions (M, 3)."""
    end_s = _LOG_FRAMES / _LOG_FRAME_RATE_HZ + PAD_S
    times = np.arange(-PAD_S, end_s, 1 / _LOG_RATE_HZ)
    if t[-1] < start_s + end_s or len(positions) != len(t):
        raise LogError(f'a log of {len(t)} orientations and {len(positions)} positions until '
                       f'{t[-1]:.1f} s does not cover {start_s + end_s:.1f} s')
    angles, positions = (CubicSpline(t, x)(times + start_s) for x in (angles, positions))
    return times, angles, positions


def _span(angle: Values, lowest: float, highest: float) -> Values:
    """Scale and shift the slow part of a signal until the whole spans the given range."""
    slow = gaussian_filter1d(angle, 0.2 * _LOG_RATE_HZ)
    fast = angle - slow
    scale = brentq(lambda s: np.ptp(s * slow + fast) - (highest - lowest), 0.1, 10.0)
    spanned = scale * slow + fast
    return spanned + lowest - spanned.min()


def fit_in_room(positions: Vectors, room_size_m: Size, clearance_m: float) -> Vectors:
    """Centre a path in the room, shrunk where it would come too close to the walls."""
    lowest, highest = positions.min(axis=0), positions.max(axis=0)
    room = np.array(room_size_m)
    shrink = np.minimum(1.0, (room - 2 * clearance_m) / np.maximum(highest - lowest, 1e-9))
    shrink[:2] = shrink[:2].min()
    return (positions - (lowest + highest) / 2) * shrink + [0.0, 0.0, room[2] / 2]


def _sampled(name: str, frames: int, room_size_m: Size, times: Values, angles: Vectors,
             positions: Vectors) -> Flight:
    if not 1 <= frames <= _LOG_FRAMES:
        raise ValueError(f'{name} has 1 to {_LOG_FRAMES} frames, not {frames}')
    return Flight(
        name, _LOG_FRAME_RATE_HZ, frame_stamps_ns(frames, _LOG_FRAME_RATE_HZ), room_size_m,
        RotationSpline(times, Rotation.from_euler('ZYX', angles) * R_BODY_CAMERA),
        CubicSpline(times, positions))


def harmonics(rng: np.random.Generator, components: int, lowest_hz: float,
              highest_hz: float) -> Callable[[ArrayLike], Floats]:
    """Random periodic signals within ±1, period 60 s: times (...,) to (..., components)."""
    count = 12
    turns = rng.integers(max(1, round(60 * lowest_hz)), round(60 * highest_hz) + 1,
                         (components, count))
    phase = rng.uniform(0, 2 * np.pi, (components, count))
    weight = rng.uniform(0.2, 1.0, (components, count))
    grid = np.arange(0, 60, 0.005)

    def raw(t: ArrayLike) -> Floats:
        angle = 2 * np.pi / 60 * np.asarray(t)[..., None, None] * turns + phase
        return (weight * np.sin(angle)).sum(axis=-1)

    peak = 1.001 * np.abs(raw(grid)).max(axis=0)
    return lambda t: raw(t) / peak
