# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What a report tells of a replay, noted frame by frame."""

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from sph_stab_ros.geometry.arrays import Image, Values
from sph_stab_ros.geometry.conventions import NS_PER_S
from sph_stab_ros.stabilization.stabilized_frame import StabilizedFrame

# Of these there are between the half and all, spread evenly.
MOST_THUMBNAILS = 8
THUMBNAIL_WIDTH_PX = 640


class ReplayLog:
    """
    Takes in StabilizedFrames; keeps 150 bytes of each, and a few small pictures of all.

    ``thumbnails`` are times in seconds, with the sphere as recorded and as stabilised.
    """

    def __init__(self) -> None:
        self.thumbnails: list[tuple[float, Image, Image]] = []
        self.statuses: list[str] = []
        self._every = 1
        self._times_ns: list[int] = []
        self._uncertainties_rad: list[float] = []
        self._camera: list[np.ndarray] = []
        self._virtual: list[np.ndarray] = []

    def __call__(self, stabilized: StabilizedFrame) -> None:
        """Take in the next one."""
        number = len(self._times_ns)
        self._times_ns.append(stabilized.frame.time_ns)
        self.statuses.append(stabilized.status.value)
        uncertainty_rad = stabilized.uncertainty_rad
        self._uncertainties_rad.append(np.nan if uncertainty_rad is None else uncertainty_rad)
        self._camera.append(stabilized.R_world_camera.as_quat())
        self._virtual.append(stabilized.R_world_virtual.as_quat())
        if number % self._every == 0:
            recorded, shown = stabilized.seen_along(Rotation.identity()), stabilized.sphere()
            elapsed_s = (self._times_ns[-1] - self._times_ns[0]) / NS_PER_S
            self.thumbnails.append((elapsed_s, _reduced(recorded), _reduced(shown)))
            if len(self.thumbnails) > MOST_THUMBNAILS:
                del self.thumbnails[1::2]
                self._every *= 2

    @property
    def time_s(self) -> Values:
        """Return the times of the frames (N,) from the first one on."""
        return (np.array(self._times_ns) - self._times_ns[0]) / NS_PER_S

    @property
    def uncertainty_deg(self) -> Values:
        """Return one standard deviation (N,), NaN where it is not known."""
        return np.rad2deg(self._uncertainties_rad)

    @property
    def R_world_camera(self) -> Rotation:
        """Return how the camera was turned, N times."""
        return Rotation.from_quat(self._camera)

    @property
    def R_world_virtual(self) -> Rotation:
        """Return how the virtual camera was turned, N times."""
        return Rotation.from_quat(self._virtual)


def _reduced(picture: Image) -> Image:
    width = min(THUMBNAIL_WIDTH_PX, picture.shape[1])
    return cv2.resize(picture, (width, width // 2), interpolation=cv2.INTER_AREA)
