# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Make the Tracker that a config asks for, and tell how wide its pictures are."""

from collections.abc import Callable
from typing import TypeAlias

import numpy as np

from sph_stab_ros.config import ANCHORED, TrackerConfig
from sph_stab_ros.geometry.arrays import Mask, Plane
from sph_stab_ros.geometry.masks import common, load_mask
from sph_stab_ros.tracking.anchored.options import AnchoredOptions
from sph_stab_ros.tracking.anchored.readout import Readout
from sph_stab_ros.tracking.anchored.tracker import AnchoredTracker
from sph_stab_ros.tracking.base import GyroRotation, no_gyro, Tracker
from sph_stab_ros.tracking.frame_to_frame.tracker import FrameToFrameTracker

# Corners gain from resolution, dense flow costs by it.
ANCHORED_WIDTH = 640
FRAME_TO_FRAME_WIDTH = 480

# From config, width of the grey spheres, gyro and perhaps what is seen of them to a Tracker.
MakeTracker: TypeAlias = Callable[..., Tracker]


def working_width(config: TrackerConfig) -> int:
    """Return the width in pixels that images are to be reduced to under a TrackerConfig."""
    if config.working_width:
        return config.working_width
    return ANCHORED_WIDTH if config.estimator == ANCHORED else FRAME_TO_FRAME_WIDTH


def check_mask(config: TrackerConfig) -> None:
    """Raise MaskError where the mask of a TrackerConfig cannot be used."""
    load_mask(config.mask, working_width(config))


def make_tracker(
        config: TrackerConfig, width: int, gyro_rotation: GyroRotation = no_gyro,
        seen: Mask | None = None, readout_shares: Plane | None = None,
        anchored: AnchoredOptions = AnchoredOptions()) -> Tracker:
    """
    Return the Tracker that a TrackerConfig asks for, for grey spheres ``width`` wide.

    ``gyro_rotation(from_ns, to_ns)`` returns the turn ``R_from_to`` that a gyro has seen between
    two stamps, or None. ``seen`` are the pixels (width / 2, width) bool that the pictures show,
    all by default; ProjectionError where the config's mask leaves none of them. ``readout_shares``
    (320, 640) tell when directions are read where the shutter rolls, which the anchored tracker
    takes into account; ``anchored`` says how that does what it does.
    """
    used = common(load_mask(config.mask, width), seen)
    if config.estimator == ANCHORED:
        return AnchoredTracker(used, config.max_prediction_s, gyro_rotation, anchored,
                               Readout(config.rolling_shutter_s, readout_shares))
    bound_deg = config.epipolar_bound_deg
    return FrameToFrameTracker(
        config.estimator, used, config.max_prediction_s, gyro_rotation,
        flow=config.flow, flow_updates=config.flow_updates,
        epipolar_bound_rad=np.deg2rad(bound_deg) if bound_deg < 180 else np.inf)
