# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Keyframes: pictures that stay, with where they were taken and what was seen in them."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from sph_stab_ros.geometry.arrays import Covariance, Grey, Mask, Matrix, Vector
from sph_stab_ros.tracking.anchored.landmarks import Observations
from sph_stab_ros.tracking.anchored.thumbnail import Thumbnail
from sph_stab_ros.tracking.frame_to_frame.features import detect, Features


@dataclass
class Keyframe:
    """
    R_world_camera (3, 3), position (3,), covariance (3, 3) of the former, what was seen.

    ``jpeg`` is the camera's grey sphere, as a file: a fifth of the memory at most.
    """

    number: int
    R: Matrix
    position: Vector
    covariance: Covariance
    jpeg: NDArray[np.uint8]
    thumbnail: Thumbnail
    observations: Observations
    _features: Features | None = None

    @property
    def grey(self) -> Grey:
        """Return the camera's sphere (H, W) uint8."""
        return cv2.imdecode(self.jpeg, cv2.IMREAD_GRAYSCALE)

    def features(self, used: Mask) -> Features:
        """Return the A-KAZE Features in the pixels ``used``; found once, in some 50 ms."""
        if self._features is None:
            self._features = detect(self.grey, used)
        return self._features
