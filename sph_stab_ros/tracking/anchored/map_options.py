# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""How much a map of the surroundings holds, and how it is adjusted."""

from dataclasses import dataclass

import numpy as np

from sph_stab_ros.tracking.anchored.bundle_adjustment import BundleOptions
from sph_stab_ros.tracking.anchored.corners import CornerOptions
from sph_stab_ros.tracking.anchored.landmarks import LandmarkOptions
from sph_stab_ros.tracking.anchored.lens_misalignment import LensOptions
from sph_stab_ros.tracking.anchored.patches import PatchOptions


@dataclass(frozen=True)
class MapOptions:
    """How much a map holds, and how it is adjusted."""

    corners: CornerOptions = CornerOptions()
    patches: PatchOptions = PatchOptions()
    landmarks: LandmarkOptions = LandmarkOptions()
    bundle: BundleOptions = BundleOptions()
    lenses: LensOptions = LensOptions()
    # That are looked for; with half of them errors grow by a tenth or so.
    max_landmarks: int = 600
    # Standard deviation in grey values of a patch that is worth it.
    min_contrast: float = 4.0
    # The unit of length is such that new landmarks are at distance 1 in the beginning; their
    # inverse depth is known by this much (an inverse variance).
    first_information: float = 0.3
    # In a window all that was seen counts again; what was guessed at first then hardly does.
    window_information: float = 0.03
    # Errors of observations are alike from keyframe to keyframe: what they tell about depths
    # counts half, and never makes them exact.
    trusted_information: float = 0.5
    max_information: float = 1e5
    # Adjusted are the last keyframes; fixed, those others that saw most of the same landmarks.
    # With fewer a narrow view drifts twice as fast.
    adjusted_keyframes: int = 20
    fixed_keyframes: int = 10
    # However long the recording is; the newest of them stay whatever is near them.
    max_keyframes: int = 48
    recent_keyframes: int = 6
    # A landmark whose observations are trusted less than this on average is none.
    min_trust: float = 0.15
    # When the lenses are known better by so much, all keyframes are adjusted anew.
    lenses_changed_rad: float = np.deg2rad(0.03)
    # The window's covariance takes observations for independent. Calibrated on simulated flights.
    covariance_inflation: float = 6.0
