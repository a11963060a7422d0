# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""
A-KAZE features on the sphere, matched to pairs of bearings.

P. F. Alcantarilla, J. Nuevo and A. Bartoli, *Fast explicit diffusion for accelerated features in
nonlinear scale spaces*, British Machine Vision Conference, 2013.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from sph_stab_ros.geometry.arrays import Bearings, Grey, Mask
from sph_stab_ros.geometry.equirect import bearings_from_pixels, pad_sphere
from sph_stab_ros.tracking.frame_to_frame.estimators.base import BearingPairs

# A-KAZE describes a feature by up to 40 px around it.
PADDING_PX = 40
# A tenth of OpenCV's: where little can be seen, many weak features hold a fit better than few.
DETECTOR_THRESHOLD = 1e-4
MAX_FEATURES = 2000
# A match must be this much nearer than the second best: the ratio test of D. G. Lowe, *Distinctive
# image features from scale-invariant keypoints*, International Journal of Computer Vision 60(2),
# 2004, with the value there.
MAX_DISTANCE_RATIO = 0.8


@dataclass(frozen=True)
class Features:
    """Bearings (N, 3) of features and their binary descriptors (N, D) uint8."""

    bearings: Bearings
    descriptors: NDArray[np.uint8]


def detect(grey: Grey, used: Mask | None = None) -> Features:
    """Return the A-KAZE Features of a grey sphere (H, W), strongest first, seam included."""
    height, width = grey.shape
    keypoints, descriptors = cv2.AKAZE_create(threshold=DETECTOR_THRESHOLD).detectAndCompute(
        pad_sphere(grey, PADDING_PX), None)
    if not keypoints:
        return Features(np.empty((0, 3)), np.empty((0, 61), np.uint8))
    uv = np.array([keypoint.pt for keypoint in keypoints]) - PADDING_PX
    pixels = np.rint(uv).astype(int)
    keep = np.all((pixels >= 0) & (pixels < (width, height)), axis=1)
    if used is not None:
        keep[keep] = used[pixels[keep, 1], pixels[keep, 0]]
    strength = np.array([keypoint.response for keypoint in keypoints])
    best = np.argsort(-np.where(keep, strength, -1), kind='stable')[:min(keep.sum(), MAX_FEATURES)]
    return Features(bearings_from_pixels(uv[best], width), descriptors[best])


def match(previous: Features, current: Features) -> BearingPairs:
    """Return the BearingPairs of two sets of Features, matched both ways, of equal weights."""
    if min(len(previous.bearings), len(current.bearings)) < 2:
        return BearingPairs.empty()
    there = _best_matches(previous.descriptors, current.descriptors)
    back = _best_matches(current.descriptors, previous.descriptors)
    mutual = [(i, j) for i, j in there.items() if back.get(j) == i]
    if not mutual:
        return BearingPairs.empty()
    i, j = np.array(mutual).T
    return BearingPairs(previous.bearings[i], current.bearings[j], np.ones(len(i)))


def _best_matches(query: NDArray[np.uint8], train: NDArray[np.uint8]) -> dict[int, int]:
    """Return {query index: train index} of the matches that pass the ratio test."""
    matches = cv2.BFMatcher(cv2.NORM_HAMMING).knnMatch(query, train, k=2)
    return {best.queryIdx: best.trainIdx for best, second in matches
            if best.distance < MAX_DISTANCE_RATIO * second.distance}
