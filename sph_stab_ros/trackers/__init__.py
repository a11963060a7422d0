# Copyright 2026 The sph_stab_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Trackers: frames in, the camera's orientation in the world out."""

import numpy as np

from sph_stab_ros.masks import load_mask
from sph_stab_ros.trackers.base import NS_PER_S, TrackedOrientation, Tracker, TrackingStatus
from sph_stab_ros.trackers.chain import ChainTracker

__all__ = ['ChainTracker', 'make_tracker', 'NS_PER_S', 'TrackedOrientation', 'Tracker',
           'TrackingStatus']


def make_tracker(config, width):
    """Return the Tracker that a TrackerConfig asks for, for grey spheres ``width`` wide."""
    return ChainTracker(
        config.estimator, load_mask(config.mask, width), config.max_prediction_s,
        flow=config.flow, flow_updates=config.flow_updates,
        epipolar_bound_rad=np.deg2rad(config.epipolar_bound_deg))
