# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""
Calibrate two fisheye lenses by what both of them see.

Corners in the ring where the lenses overlap are followed from one lens' circle into the other's.
Each gives two pixels that look along one bearing; the parameters are those that make these
bearings agree (robust least squares). The ring cannot tell everything: not how the camera as a
whole is turned, so that the front lens' mount stays as it is, nor which of the two radii is
wrong, only their sum, and little of the lenses' inner parts. There the parameters stay near those
one starts from, as the priors say. Things so near that the lenses, a few centimetres apart, see
them in different directions, change the radii.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from scipy.optimize import least_squares

from sph_stab_ros.config import FisheyeConfig
from sph_stab_ros.geometry.arrays import Bearings, Choice, Grey, Pixels, Values
from sph_stab_ros.geometry.fisheye import dual_fisheye, DualFisheye
from sph_stab_ros.geometry.lens import Lens, lens_of

# One standard deviation of what is fitted: lengths in radii, angles in degrees.
LENS_PRIORS = {'center_u_px': 0.015, 'center_v_px': 0.015, 'radius_px': 0.015, 'k1': 0.004}
MOUNT_PRIORS = {'yaw_deg': 1., 'pitch_deg': 1., 'roll_deg': 2.}
LENGTHS = ('center_u_px', 'center_v_px', 'radius_px')
# Of a corner followed into the other circle; what is more than a few of these apart is wrong.
CORNER_SIGMA_RAD = np.deg2rad(0.1)
MAX_DISAGREEMENT_RAD = np.deg2rad(0.5)
ROUNDS = 3
# In pictures of the ring, which are this much finer than the circles.
FINENESS = 2.
WINDOW_PX = 15
MARGIN_PX = 64
CORNERS_PER_PICTURE = 200
MIN_CORNER_DISTANCE_PX = 10
MAX_RETURN_PX = 0.5
# Contrast is made alike, but noise is not made texture.
CONTRAST_WINDOW_PX = 31
MIN_CONTRAST = 6.
# Enough to tell thirteen parameters from corners all around.
MIN_CORNERS = 150
SECTORS, MIN_SECTORS, MIN_CORNERS_PER_SECTOR = 12, 8, 4


class CalibrationError(Exception):
    """A calibration that cannot be made from these pictures, with the reason in one line."""


@dataclass(frozen=True)
class Calibration:
    """
    A refined FisheyeConfig, and how well the lenses agree.

    ``before_rad`` and ``after_rad`` (N,) are the angles between where the two lenses see each of
    the N corners that were followed.
    """

    config: FisheyeConfig
    before_rad: Values
    after_rad: Values


class Ring:
    """The border between the lenses as a picture: azimuth about the axis by angle towards it."""

    def __init__(self, fisheye: DualFisheye, overlap_rad: float) -> None:
        self._px_per_rad = FINENESS * fisheye.sphere_width / (2 * np.pi)
        self.width = round(2 * np.pi * self._px_per_rad)
        self.height = round(overlap_rad * self._px_per_rad)
        uv = np.meshgrid(np.arange(-MARGIN_PX, self.width + MARGIN_PX), np.arange(self.height))
        self._bearings = self.bearings(
            np.stack(uv, axis=-1).astype(float) + (MARGIN_PX, 0)).astype(np.float32)

    def bearings(self, uv: Pixels) -> Bearings:
        """Return where pixels (..., 2) look, unit vectors (..., 3)."""
        azimuth = (uv[..., 0] - MARGIN_PX) * (2 * np.pi / self.width)
        towards = ((self.height - 1) / 2 - uv[..., 1]) / self._px_per_rad
        return np.stack((np.cos(towards) * np.cos(azimuth), np.cos(towards) * np.sin(azimuth),
                         np.sin(towards)), axis=-1)

    def seen_by(self, lens: Lens, grey: Grey) -> Grey:
        """Return what a lens of the grey picture sees of the ring, its contrast made even."""
        u, v, _ = lens.pixels(self._bearings)
        seen = cv2.remap(grey, u, v, cv2.INTER_LINEAR).astype(np.float32)
        window = (CONTRAST_WINDOW_PX, CONTRAST_WINDOW_PX)
        mean = cv2.blur(seen, window)
        contrast = np.sqrt(np.maximum(cv2.blur(seen * seen, window) - mean * mean, 0))
        return np.clip(128 + 40 * (seen - mean) / np.maximum(contrast, MIN_CONTRAST),
                       0, 255).astype(np.uint8)

    def contains(self, uv: Pixels) -> Choice:
        """Tell which pixels (N, 2) lie a window within the ring, and once around."""
        reach = WINDOW_PX / 2
        return ((uv[:, 1] >= reach) & (uv[:, 1] < self.height - reach)
                & (uv[:, 0] >= MARGIN_PX) & (uv[:, 0] < MARGIN_PX + self.width))


def for_size(config: FisheyeConfig, size_wh: tuple[int, int]) -> FisheyeConfig:
    """Return the FisheyeConfig for pictures (width, height) that it fits."""
    scale = size_wh[0] / config.width
    width, height = size_wh
    lenses = {}
    for name in ('front', 'rear'):
        lens = getattr(config, name)
        scaled = lens_of(lens).scaled(scale)
        lenses[name] = replace(
            lens, center_u_px=scaled.center_px[0], center_v_px=scaled.center_px[1],
            radius_px=scaled.radius_px)
    return replace(config, width=width, height=height, **lenses)


def calibrate(greys: Sequence[Grey], config: FisheyeConfig) -> Calibration:
    """
    Return the Calibration that grey pictures (H, W), of a FisheyeConfig's size, give from it.

    Raises CalibrationError where they show too little in the overlap, or do not agree.
    """
    if config.fov_deg - 180 < 4:
        raise CalibrationError('the lenses overlap by less than 4 degrees (fov_deg)')
    refined = config
    for _ in range(ROUNDS):
        front_uv, rear_uv, azimuth = corners_in_both(greys, refined)
        check_texture(azimuth)
        refined = fitted(front_uv, rear_uv, config, refined)
    before_rad, after_rad = (
        disagreement_rad(front_uv, rear_uv, one) for one in (config, refined))
    good = after_rad < MAX_DISAGREEMENT_RAD
    check_texture(azimuth[good])
    if good.mean() < 0.5:
        raise CalibrationError(
            f'the lenses do not agree: of {len(good)} corners {good.sum()} come within '
            f'{np.rad2deg(MAX_DISAGREEMENT_RAD):g} degrees')
    return Calibration(refined, before_rad[good], after_rad[good])


def corners_in_both(
        greys: Sequence[Grey], config: FisheyeConfig) -> tuple[Pixels, Pixels, Values]:
    """
    Return the pixels (N, 2) of corners in the front circles and in the rear ones of pictures.

    And their azimuths (N,) in radians.
    """
    fisheye = dual_fisheye(config, (config.width, config.height))
    ring = Ring(fisheye, np.deg2rad(config.fov_deg - 180))
    found = [np.empty((0, 2, 2))]
    for grey in greys:
        front, rear = (ring.seen_by(lens, grey) for lens in fisheye.lenses)
        corners = cv2.goodFeaturesToTrack(
            front, CORNERS_PER_PICTURE, 0.02, MIN_CORNER_DISTANCE_PX, blockSize=7)
        if corners is None:
            continue
        there = followed(front, rear, corners)
        back = followed(rear, front, there)
        uv = np.stack((corners, there), axis=1)[:, :, 0]
        returned = np.linalg.norm(back - corners, axis=-1)[:, 0] < MAX_RETURN_PX
        found.append(uv[returned & ring.contains(uv[:, 0]) & ring.contains(uv[:, 1])])
    x = ring.bearings(np.concatenate(found).astype(float))
    front_uv, rear_uv = (
        np.stack(lens.pixels(x[None, :, i])[:2], axis=-1)[0] if len(x) else np.empty((0, 2))
        for i, lens in enumerate(fisheye.lenses))
    return front_uv, rear_uv, np.arctan2(x[:, 0, 1], x[:, 0, 0])


def followed(before: Grey, now: Grey, corners: Pixels) -> Pixels:
    """Return where corners (N, 1, 2) of one picture are in another."""
    return cv2.calcOpticalFlowPyrLK(
        before, now, corners, None, winSize=(WINDOW_PX, WINDOW_PX), maxLevel=2)[0]


def check_texture(azimuth: Values) -> None:
    """Raise CalibrationError where corners at azimuths (N,) do not suffice."""
    sectors = np.floor(azimuth / (2 * np.pi) * SECTORS).astype(int) % SECTORS
    filled = np.bincount(sectors, minlength=SECTORS) >= MIN_CORNERS_PER_SECTOR
    if len(azimuth) < MIN_CORNERS or filled.sum() < MIN_SECTORS:
        raise CalibrationError(
            f'too little texture where both lenses see: {len(azimuth)} corners in '
            f'{filled.sum()} of {SECTORS} directions, at least {MIN_CORNERS} in {MIN_SECTORS} '
            'are needed')


def fitted(front_uv: Pixels, rear_uv: Pixels, config: FisheyeConfig,
           start: FisheyeConfig) -> FisheyeConfig:
    """Return the FisheyeConfig near ``config`` that makes pixels (N, 2) agree, from a start."""
    names = [(lens, name) for lens in ('front', 'rear') for name in LENS_PRIORS]
    names += [('rear', name) for name in MOUNT_PRIORS]
    priors = LENS_PRIORS | MOUNT_PRIORS
    sigmas = np.array([priors[name] * (getattr(config, lens).radius_px if name in LENGTHS else 1)
                       for lens, name in names])

    def values(one: FisheyeConfig) -> Values:
        return np.array([getattr(getattr(one, lens), name) for lens, name in names])

    def with_values(parameters: Values) -> FisheyeConfig:
        lenses: dict[str, Any] = {'front': {}, 'rear': {}}
        for (lens, name), value in zip(names, (values(config) + sigmas * parameters).tolist()):
            lenses[lens][name] = value
        return replace(config, **{
            lens: replace(getattr(config, lens), **changed) for lens, changed in lenses.items()})

    def residuals(parameters: Values) -> Values:
        front, rear = bearings_of(front_uv, rear_uv, with_values(parameters))
        off = (front - rear) / CORNER_SIGMA_RAD
        # Pseudo-Huber's cost of the corners, the plain square of the priors.
        square = np.sum(off * off, axis=1, keepdims=True)
        off *= np.sqrt(2 / (1 + np.sqrt(1 + square)))
        return np.append(off, parameters)

    found = least_squares(
        residuals, np.clip((values(start) - values(config)) / sigmas, -4, 4), bounds=(-5, 5))
    return with_values(found.x)


def disagreement_rad(front_uv: Pixels, rear_uv: Pixels, config: FisheyeConfig) -> Values:
    """Return the angles (N,) between where the lenses see pixels (N, 2) of theirs."""
    front, rear = bearings_of(front_uv, rear_uv, config)
    return 2 * np.arcsin(np.minimum(np.linalg.norm(front - rear, axis=1) / 2, 1))


def bearings_of(front_uv: Pixels, rear_uv: Pixels,
                config: FisheyeConfig) -> tuple[Bearings, Bearings]:
    """Return the bearings (N, 3) of pixels (N, 2) in the front circle and in the rear one."""
    return lens_of(config.front).bearings(front_uv), lens_of(config.rear).bearings(rear_uv)
