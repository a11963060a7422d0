# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Two consecutive spheres and the paper's three methods for the rotation between them."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import TypeAlias

import numpy as np
from scipy.spatial.transform import Rotation

from sph_stab_ros.geometry.arrays import Grey, Mask
from sph_stab_ros.geometry.masks import antipodal
from sph_stab_ros.tracking.frame_to_frame.estimators import (
    BearingPairs, fit_epipolar, fit_essential, fit_moment, RotationEstimate)
from sph_stab_ros.tracking.frame_to_frame.estimators.epipolar import BOUND_RAD
from sph_stab_ros.tracking.frame_to_frame.features import detect, Features, match
from sph_stab_ros.tracking.frame_to_frame.optical_flow import dense_pairs

# Beyond these flow may not have seen the motion, and a start from features pays.
LARGE_ROTATION_RAD = np.deg2rad(6)
LARGE_RESIDUAL_RAD = np.deg2rad(3)
# No walk or flight leaves so much flow between two frames: the fit is of something else.
ABSURD_RESIDUAL_RAD = np.deg2rad(8)


@dataclass(frozen=True)
class Sphere:
    """A grey sphere and the pixels of it to use, all where None."""

    grey: Grey
    used: Mask | None = None

    @cached_property
    def features(self) -> Features:
        """Find the A-KAZE features, once."""
        return detect(self.grey, self.used)


@dataclass(frozen=True)
class ImagePair:
    """
    Two consecutive spheres.

    Their flow is computed by ``flow`` and again ``flow_updates`` times on the derotated image;
    ``epipolar_bound_rad`` is that of fit_epipolar.
    """

    previous: Sphere
    current: Sphere
    flow: str = 'farneback'
    flow_updates: int = 0
    epipolar_bound_rad: float = BOUND_RAD

    def matches(self) -> BearingPairs:
        """Return the BearingPairs of the A-KAZE features that match."""
        return match(self.previous.features, self.current.features)

    def pts(self) -> RotationEstimate | None:
        """Estimate from A-KAZE features: eight-point RANSAC for the essential matrix."""
        return fit_essential(self.matches())

    def moment(self) -> RotationEstimate | None:
        """
        Estimate from the directional moment of dense flow (3 DoF).

        Where the motion is too large for flow, ``pts`` supplies the start (§4.6 of the paper),
        by which the images are derotated before the flow; the better of the two fits counts.
        """
        estimate = self._refined(self._moment_from(None))
        if estimate is None or not self._is_too_large(estimate):
            return estimate
        start = self.pts()
        if start is not None:
            restarted = self._refined(self._moment_from(start.R_current_previous))
            if restarted is not None:
                estimate = min((estimate, restarted), key=lambda fit: fit.residual_rad)
        return estimate if estimate.residual_rad < ABSURD_RESIDUAL_RAD else None

    def pts_epipolar(self) -> RotationEstimate | None:
        """Estimate rotation and epipole from dense flow (5 DoF, Eq. 8), started from ``pts``."""
        start = self.pts()
        if start is None:
            return None
        large = start.R_current_previous.magnitude() > LARGE_ROTATION_RAD
        estimate = self._epipolar_from(start, start.R_current_previous if large else None)
        for _ in range(self.flow_updates):
            if estimate is not None:
                estimate = self._epipolar_from(estimate, estimate.R_current_previous)
        return estimate

    def _moment_from(self, start: Rotation | None) -> RotationEstimate | None:
        pairs = self._flow(start, antipodal(self.previous.used))
        return None if pairs is None else fit_moment(pairs, start)

    def _refined(self, estimate: RotationEstimate | None) -> RotationEstimate | None:
        for _ in range(self.flow_updates):
            if estimate is not None:
                estimate = self._moment_from(estimate.R_current_previous)
        return estimate

    def _epipolar_from(self, start: RotationEstimate,
                       R_guess: Rotation | None) -> RotationEstimate | None:
        """Fit to the flow of the image derotated by a guess, from the start of another fit."""
        pairs = self._flow(R_guess, self.previous.used)
        return (None if pairs is None
                else fit_epipolar(pairs, start, self.epipolar_bound_rad))

    def _flow(self, start: Rotation | None, used: Mask | None) -> BearingPairs | None:
        return dense_pairs(self.previous.grey, self.current.grey, self.flow, start, used)

    @staticmethod
    def _is_too_large(estimate: RotationEstimate) -> bool:
        return (estimate.R_current_previous.magnitude() > LARGE_ROTATION_RAD
                or estimate.residual_rad > LARGE_RESIDUAL_RAD)


# A way from a pair of pictures to a rotation; None where it cannot be told.
Method: TypeAlias = Callable[[ImagePair], RotationEstimate | None]
METHODS: dict[str, Method] = {
    'pts': ImagePair.pts,
    'moment': ImagePair.moment,
    'pts_epipolar': ImagePair.pts_epipolar,
}
