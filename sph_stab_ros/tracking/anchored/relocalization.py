# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""
Relocalisation: how a camera that was lost is turned in the world it knew before, by features.

Landmarks are found again where the camera is near its expected place; after a long gap it is not,
and a new map begins, turned by what nobody has seen. Features are matched from farther away, and
an essential matrix tells the turn without depths, within a degree or two. That is enough to go on
in the world as it was.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from sph_stab_ros.geometry.arrays import Grey, Mask
from sph_stab_ros.tracking.anchored.keyframe import Keyframe
from sph_stab_ros.tracking.frame_to_frame.estimators.base import BearingPairs, RotationEstimate
from sph_stab_ros.tracking.frame_to_frame.estimators.essential import fit_essential
from sph_stab_ros.tracking.frame_to_frame.features import detect, Features, match


@dataclass(frozen=True)
class RelocalizationOptions:
    """How a world that was lost is looked for."""

    # Near the camera's last place, by landmarks: so many of the last keyframes are compared by
    # thumbnails, and the likeliest headings tried; each takes as long as a frame.
    nearby_keyframes: int = 6
    nearby_attempts: int = 3
    # By features, each of which takes a tenth of a second: the last keyframes before the loss
    # first, then as many of the others.
    last_tried: int = 8
    others_tried: int = 8
    # Where the new world began may never have been seen; so many of its other pictures are tried.
    max_pictures: int = 4
    # A single one may have been misled, by the robot's own body or by walkers; it is believed when
    # another keyframe says the same, within this, and then known so well.
    agreement_rad: float = np.deg2rad(3)
    sigma_rad: float = np.deg2rad(1)
    # How a camera that was lost is turned nobody knows: as good as any standard deviation.
    lost_rad: float = 1.


class Relocalizer:
    """
    Looks for the place of a picture among the keyframes of a world that was lost.

    A keyframe at a time, since each takes a tenth of a second.

    Parameters
    ----------
    keyframes : list of Keyframe
        Of that world, oldest first.
    grey : (H, W) uint8
        A sphere, as large as the keyframes' own.
    R_new_camera : Rotation
        Of the picture, in the world that has begun with it.
    used : (H, W) bool
        Pixels to use of any of the pictures.
    options : RelocalizationOptions
        How many keyframes and pictures are tried.
    pictures_before : int
        How many of the new world have been tried in vain.

    """

    def __init__(self, keyframes: Sequence[Keyframe], grey: Grey, R_new_camera: Rotation,
                 used: Mask, options: RelocalizationOptions, pictures_before: int = 0) -> None:
        self.keyframes = keyframes
        self._options, self._pictures_tried = options, pictures_before + 1
        self._grey, self._used, self._R_new_camera = grey, used, R_new_camera
        self._features: Features | None = None
        # R_old_new by each keyframe that had an answer, and on how many pairs that stands.
        self._answers: list[Rotation] = []
        self._supports: list[int] = []
        others = keyframes[:-options.last_tried]
        every = max(1, -(-len(others) // options.others_tried))
        self._untried = [*others[::every], *keyframes[-options.last_tried:]]

    @property
    def is_over(self) -> bool:
        """Whether there is no keyframe left to compare with."""
        return not self._untried

    def with_another(self, grey: Grey, R_new_camera: Rotation) -> 'Relocalizer | None':
        """Return the same for another picture of the new world, None after enough of them."""
        if self._pictures_tried >= self._options.max_pictures:
            return None
        return Relocalizer(self.keyframes, grey, R_new_camera, self._used, self._options,
                           self._pictures_tried)

    def step(self) -> Rotation | None:
        """Compare with one more keyframe; return R_old_new, of the two worlds, once it is sure."""
        keyframe = self._untried.pop()
        if self._features is None:
            self._features = detect(self._grey, self._used)
        pairs = match(keyframe.features(self._used), self._features)
        estimate = fit_essential(pairs)
        if estimate is None:
            return None
        R_camera_key = turn_with_less_parallax(estimate, pairs)
        R_old_new = (Rotation.from_matrix(keyframe.R) * R_camera_key.inv()
                     * self._R_new_camera.inv())
        self._answers.append(R_old_new)
        self._supports.append(estimate.support)
        answers = Rotation.concatenate(self._answers)
        alike = (answers * R_old_new.inv()).magnitude() < self._options.agreement_rad
        return answers[alike].mean(np.array(self._supports)[alike]) if alike.sum() > 1 else None


def turn_with_less_parallax(estimate: RotationEstimate, pairs: BearingPairs) -> Rotation:
    """Return that one of the two rotations which an essential matrix allows, of any size."""
    assert estimate.t_current is not None
    R = estimate.R_current_previous
    half_turn = Rotation.from_rotvec(np.pi * estimate.t_current)
    return max((R, half_turn * R), key=lambda one: np.median(
        np.einsum('ni,ni->n', one.apply(pairs.previous), pairs.current)))
