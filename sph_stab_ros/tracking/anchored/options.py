# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""All that can be chosen about the anchored tracker."""

from dataclasses import dataclass

from sph_stab_ros.tracking.anchored.body_mask import BodyMaskOptions
from sph_stab_ros.tracking.anchored.correction import CorrectionOptions
from sph_stab_ros.tracking.anchored.localization import LocalizationOptions
from sph_stab_ros.tracking.anchored.map_initialization import InitializationOptions
from sph_stab_ros.tracking.anchored.map_options import MapOptions
from sph_stab_ros.tracking.anchored.relocalization import RelocalizationOptions
from sph_stab_ros.tracking.anchored.thumbnail import ThumbnailOptions
from sph_stab_ros.tracking.anchored.wide_baseline import WideBaselineOptions
from sph_stab_ros.tracking.motion_model import MotionOptions


@dataclass(frozen=True)
class KeyframeOptions:
    """When a frame becomes a keyframe."""

    # Where fewer of the landmarks than these are seen (a share).
    min_survivors: float = 0.4
    # Where they have moved further since the last one, in the median: far enough to tell depths,
    # near enough for patches to look the same.
    max_parallax_rad: float = 0.04


@dataclass(frozen=True)
class AnchoredOptions:
    """
    What the parts of the anchored tracker are to do; each part's options stand beside it.

    Lengths are in the unit of the map: the distance at which its first landmarks are taken to be.
    Deviations without a unit are standard deviations of what is expected. Where no source is named
    a value was found by trying on the recordings in ``bags/`` and simulated flights.
    """

    landmark_map: MapOptions = MapOptions()
    localization: LocalizationOptions = LocalizationOptions()
    initialization: InitializationOptions = InitializationOptions()
    wide_baseline: WideBaselineOptions = WideBaselineOptions()
    relocalization: RelocalizationOptions = RelocalizationOptions()
    keyframes: KeyframeOptions = KeyframeOptions()
    motion: MotionOptions = MotionOptions()
    thumbnails: ThumbnailOptions = ThumbnailOptions()
    body_mask: BodyMaskOptions = BodyMaskOptions()
    correction: CorrectionOptions = CorrectionOptions()
    # After a longer time without a frame patches are searched coarsely first: one is missing.
    max_fine_s: float = 0.05
    # How quickly the usual scale of residuals follows that of each frame: within ten.
    scale_rate: float = 0.1
