# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What every tracker takes and returns."""

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from typing import Protocol, TypeAlias

import numpy as np
from scipy.spatial.transform import Rotation

from sph_stab_ros.geometry.arrays import Covariance, Grey
from sph_stab_ros.geometry.rotations import standard_deviation_rad

# Three of these are a degree, which no orientation may be off with the status ok.
MAX_OK_SIGMA_RAD = np.deg2rad(1 / 3)

# Returns the turn ``R_from_to`` that a gyro has seen between two stamps in ns, or None.
GyroRotation: TypeAlias = Callable[[int, int], Rotation | None]


class TrackingStatus(Enum):
    """How much an orientation is worth."""

    OK = 'ok'
    # Told from this frame, but what has added up since the beginning may be too much to rely on.
    UNCERTAIN = 'uncertain'
    # No rotation could be told from this frame; extrapolated from the last ones.
    PREDICTED = 'predicted'
    # The same for too long: the last orientation is held, and tracking starts anew from here.
    LOST = 'lost'


@dataclass(frozen=True)
class TrackedOrientation:
    """
    The camera's orientation, and how it was come by.

    ``covariance`` in rad² is that of the error's rotation vector in the world,
    ``exp(error) R_true``; None where the tracker does not know it.
    """

    R_world_camera: Rotation
    status: TrackingStatus
    covariance: Covariance | None = None


def status_of(covariance: Covariance) -> TrackingStatus:
    """Return what an orientation told from its frame is worth, by the covariance of its error."""
    return (TrackingStatus.OK if standard_deviation_rad(covariance) < MAX_OK_SIGMA_RAD
            else TrackingStatus.UNCERTAIN)


def no_gyro(from_ns: int, to_ns: int) -> None:
    """Return None for the turn ``R_from_to`` between two stamps: there is no gyro to tell."""


class Tracker(Protocol):
    """What every tracker does."""

    def track(self, grey: Grey, stamp_ns: int) -> TrackedOrientation:
        """Take in the next grey sphere, return the camera's orientation."""

    def settle(self) -> None:
        """Do what was put off; the next frame will do it otherwise."""

    def reset(self) -> None:
        """Forget everything: the next frame's orientation is the new world."""
