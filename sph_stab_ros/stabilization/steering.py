# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Where a view looks and how far it zooms: set at once, or changed at given rates."""

from dataclasses import dataclass
from threading import Lock
import warnings

import numpy as np
from scipy.spatial.transform import Rotation

from sph_stab_ros.geometry.warp import view_rotation

MAX_PITCH_RAD = np.pi / 2


@dataclass(frozen=True)
class Look:
    """Direction of a view in the stabilised picture, and its horizontal field of view."""

    R_virtual_view: Rotation
    hfov_rad: float


@dataclass(frozen=True)
class Rates:
    """Turning to the left and up in rad/s; zoom 1 magnifies e-fold in a second."""

    yaw_rad_s: float = 0.
    pitch_rad_s: float = 0.
    zoom_per_s: float = 0.

    def __bool__(self) -> bool:
        """Tell whether anything moves."""
        return any((self.yaw_rad_s, self.pitch_rad_s, self.zoom_per_s))


def steer(
        look: Look, rates: Rates, elapsed_s: float, hfov_limits_rad: tuple[float, float]) -> Look:
    """
    Return the Look after turning and zooming at constant Rates.

    Yaw is about the stabilised picture's vertical, whatever the pitch, which ends at straight up
    and down; roll stays. Zoom scales the focal length within the limits of the field of view.
    """
    yaw_rad, pitch_rad, roll_rad = view_angles(look.R_virtual_view)
    yaw_rad += rates.yaw_rad_s * elapsed_s
    pitch_rad = np.clip(
        pitch_rad + rates.pitch_rad_s * elapsed_s, -MAX_PITCH_RAD, MAX_PITCH_RAD)
    with np.errstate(over='ignore'):
        half_width = np.tan(look.hfov_rad / 2) * np.exp(-rates.zoom_per_s * elapsed_s)
    return Look(view_rotation(yaw_rad, pitch_rad, roll_rad),
                float(np.clip(2 * np.arctan(half_width), *hfov_limits_rad)))


def view_angles(R_virtual_view: Rotation) -> tuple[float, float, float]:
    """Return yaw, pitch, roll in radians of ``view_rotation``; no roll straight up and down."""
    with warnings.catch_warnings():
        warnings.filterwarnings('ignore', 'Gimbal lock', UserWarning)
        yaw_right_rad, pitch_rad, roll_rad = R_virtual_view.as_euler('YXZ')
    return -yaw_right_rad, pitch_rad, roll_rad


class Steering:
    """
    The Look of one view as its users want it; the last word counts.

    Its methods may be called from any thread. Times are in seconds of one clock that never goes
    back.

    Parameters
    ----------
    look : Look
        Where to begin.
    hfov_limits_rad : tuple of float
        Smallest and largest field of view when zooming.

    """

    def __init__(self, look: Look, hfov_limits_rad: tuple[float, float]) -> None:
        self._look = look
        self._hfov_limits_rad = hfov_limits_rad
        self._rates = Rates()
        self._since_s = self._until_s = -np.inf
        self._lock = Lock()

    def look(self, now_s: float, R_virtual_view: Rotation | None = None,
             hfov_rad: float | None = None) -> None:
        """Look in a direction, which ends all turning, or with a field of view; None stays."""
        with self._lock:
            self._advance(now_s)
            if R_virtual_view is not None:
                self._rates = Rates()
            self._look = Look(
                self._look.R_virtual_view if R_virtual_view is None else R_virtual_view,
                self._look.hfov_rad if hfov_rad is None else hfov_rad)

    def turn(self, now_s: float, rates: Rates, timeout_s: float) -> None:
        """Turn at Rates until told otherwise, at most for ``timeout_s``."""
        with self._lock:
            self._advance(now_s)
            self._rates, self._until_s = rates, now_s + timeout_s

    def at(self, now_s: float) -> Look:
        """Return the Look at a time."""
        with self._lock:
            self._advance(now_s)
            return self._look

    def _advance(self, now_s: float) -> None:
        elapsed_s = min(now_s, self._until_s) - self._since_s
        # A direction given as a quaternion stays exact as long as nothing moves.
        if self._rates and elapsed_s > 0:
            self._look = steer(self._look, self._rates, elapsed_s, self._hfov_limits_rad)
        self._since_s = now_s
