# Copyright 2026 The sph_stab_ros developers
# SPDX-License-Identifier: Apache-2.0
"""From pairs of bearings to a rotation: the paper's three fits, with what they take and give."""

from sph_stab_ros.estimators.base import BearingPairs, FitStatus, RotationEstimate
from sph_stab_ros.estimators.epipolar import fit_epipolar
from sph_stab_ros.estimators.essential import fit_essential
from sph_stab_ros.estimators.moment import fit_moment

__all__ = ['BearingPairs', 'FitStatus', 'RotationEstimate', 'fit_epipolar', 'fit_essential',
           'fit_moment']
