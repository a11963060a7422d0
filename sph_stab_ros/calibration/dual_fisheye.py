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
wrong, only their sum, and little of the lenses' inner parts; nor does a recording show something
in every direction. There the parameters stay near those one starts from, as the priors say, and
by how much the corners narrow each of them down says whether they could tell it. Things so near
that the lenses, a few centimetres apart, see them in different directions, change the radii.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares

from sph_stab_ros.calibration.ring import corners_in_both
from sph_stab_ros.config import FisheyeConfig
from sph_stab_ros.geometry.arrays import Bearings, Grey, Pixels, Values
from sph_stab_ros.geometry.lens_model import lens_of


class Parameter(NamedTuple):
    """
    What is fitted: options of the lenses that change together, by so much times their ``signs``.

    ``sigma`` is one standard deviation of the prior: lengths in radii, angles in degrees.
    """

    name: str
    option: str
    sigma: float
    signs: tuple[int, int]

    @property
    def is_length(self) -> bool:
        """Tell whether it is counted in radii."""
        return self.option.endswith('_px')


BOTH, APART, FRONT, REAR = (1, 1), (1, -1), (1, 0), (0, 1)
# Lenses of one camera are of one kind: what both have is known less well than how they differ.
PARAMETERS = (
    Parameter('radius of both', 'radius_px', 0.03, BOTH),
    Parameter('difference of the radii', 'radius_px', 0.01, APART),
    Parameter('k1 of both', 'k1', 0.003, BOTH),
    Parameter('difference of k1', 'k1', 0.003, APART),
    # How they bend at the rim; of all terms this one says least about what lies further in.
    Parameter('k4 of both', 'k4', 0.0002, BOTH),
    Parameter('front centre across', 'center_u_px', 0.015, FRONT),
    Parameter('front centre down', 'center_v_px', 0.015, FRONT),
    Parameter('rear centre across', 'center_u_px', 0.015, REAR),
    Parameter('rear centre down', 'center_v_px', 0.015, REAR),
    Parameter('rear yaw', 'yaw_deg', 1., REAR),
    Parameter('rear pitch', 'pitch_deg', 1., REAR),
    Parameter('rear roll', 'roll_deg', 2., REAR))
# Corners tell a parameter where they leave so much of its prior's deviation, or less.
TOLD = 0.5
# Of a corner followed into the other circle; what is more than a few of these apart is wrong.
CORNER_SIGMA_RAD = np.deg2rad(0.1)
MAX_DISAGREEMENT_RAD = np.deg2rad(0.5)
# So many of them tell as much as one: between halves of a real recording parameters differed by
# three of the deviations that would follow if each was a witness of its own.
ERRING_ALIKE = 8
ROUNDS = 4
# Fewer may be chance; where lenses are degrees off few are found at first.
MIN_CORNERS, MIN_TO_START = 100, 25


class CalibrationError(Exception):
    """A calibration that cannot be made from these pictures, with the reason in one line."""


@dataclass(frozen=True)
class Calibration:
    """
    A refined FisheyeConfig, and how well the lenses agree.

    ``before_rad`` and ``after_rad`` (N,) are the angles between where the two lenses see each of
    the N corners that were followed. ``told`` and ``untold`` name the parameters that the corners
    could tell, and those that stay near where they were.
    """

    config: FisheyeConfig
    before_rad: Values
    after_rad: Values
    told: tuple[str, ...]
    untold: tuple[str, ...]


def for_size(config: FisheyeConfig, size_wh: tuple[int, int]) -> FisheyeConfig:
    """Return the FisheyeConfig for pictures (width, height) that it fits."""
    width, height = size_wh
    lenses = {}
    for name in ('front', 'rear'):
        lens = getattr(config, name)
        scaled = lens_of(lens).scaled(width / config.width, height / config.height)
        lenses[name] = replace(
            lens, center_u_px=scaled.center_px[0], center_v_px=scaled.center_px[1],
            radius_px=scaled.radius_px, aspect=scaled.aspect)
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
        front_uv, rear_uv = corners_in_both(greys, refined)
        check_texture(len(front_uv), MIN_TO_START)
        refined, left = fitted(front_uv, rear_uv, config)
    before_rad, after_rad = (
        disagreement_rad(front_uv, rear_uv, one) for one in (config, refined))
    good = after_rad < MAX_DISAGREEMENT_RAD
    if good.mean() < 0.5 or not all(
            lens_of(lens, refined.model).tells_apart(np.deg2rad(refined.fov_deg / 2))
            for lens in (refined.front, refined.rear)):
        raise CalibrationError(
            f'the lenses do not agree: of {len(good)} corners {good.sum()} come within '
            f'{np.rad2deg(MAX_DISAGREEMENT_RAD):g} degrees')
    check_texture(int(good.sum()), MIN_CORNERS)
    told, untold = (tuple(one.name for one, share in zip(PARAMETERS, left)
                          if (share < TOLD) == wanted) for wanted in (True, False))
    return Calibration(refined, before_rad[good], after_rad[good], told, untold)


def check_texture(corners: int, needed: int) -> None:
    """Raise CalibrationError where there are too few corners."""
    if corners < needed:
        raise CalibrationError(f'too little texture where both lenses see: {corners} corners, at '
                               f'least {MIN_CORNERS} are needed')


def fitted(front_uv: Pixels, rear_uv: Pixels,
           config: FisheyeConfig) -> tuple[FisheyeConfig, Values]:
    """
    Return the FisheyeConfig near ``config`` that makes pixels (N, 2) agree.

    And how much of each parameter's prior deviation is left (P,).
    """
    radius_px = config.front.radius_px
    sigmas = np.array([one.sigma * (radius_px if one.is_length else 1) for one in PARAMETERS])

    def with_values(parameters: Values) -> FisheyeConfig:
        lenses = [config.front, config.rear]
        for one, change in zip(PARAMETERS, (sigmas * parameters).tolist()):
            for number, sign in enumerate(one.signs):
                lens = lenses[number]
                # Down and up pixels may be smaller.
                step = change * (lens.aspect if one.option == 'center_v_px' else 1)
                lenses[number] = replace(
                    lens, **{one.option: getattr(lens, one.option) + sign * step})
        return replace(config, front=lenses[0], rear=lenses[1])

    def residuals(parameters: Values) -> Values:
        off = misses_px(front_uv, rear_uv, with_values(parameters)) / (
            CORNER_SIGMA_RAD * radius_px / (np.pi / 2))
        # Pseudo-Huber's cost of the corners, the plain square of the priors.
        square = np.sum(off * off, axis=1, keepdims=True)
        off *= np.sqrt(2 / (1 + np.sqrt(1 + square)))
        return np.append(off / np.sqrt(ERRING_ALIKE), parameters)

    found = least_squares(residuals, np.zeros(len(PARAMETERS)), bounds=(-5, 5))
    return with_values(found.x), np.sqrt(np.diag(np.linalg.inv(found.jac.T @ found.jac)))


def misses_px(front_uv: Pixels, rear_uv: Pixels, config: FisheyeConfig) -> Pixels:
    """
    Return by how much (N, 4) pixels (N, 2) miss those that the other lens says look there.

    In pixels, not in angles: these would shrink for lenses that bend more where it ends.
    """
    front, rear = lens_of(config.front, config.model), lens_of(config.rear, config.model)
    misses = []
    for one, other, uv, other_uv in ((front, rear, front_uv, rear_uv),
                                     (rear, front, rear_uv, front_uv)):
        u, v, _ = other.pixels(one.bearings(uv)[None])
        misses.append((u[0] - other_uv[:, 0], (v[0] - other_uv[:, 1]) / other.aspect))
    # Either way tells the same.
    return np.stack([*misses[0], *misses[1]], axis=-1) / np.sqrt(2)


def disagreement_rad(front_uv: Pixels, rear_uv: Pixels, config: FisheyeConfig) -> Values:
    """Return the angles (N,) between where the lenses see pixels (N, 2) of theirs."""
    front, rear = bearings_of(front_uv, rear_uv, config)
    return 2 * np.arcsin(np.minimum(np.linalg.norm(front - rear, axis=1) / 2, 1))


def bearings_of(front_uv: Pixels, rear_uv: Pixels,
                config: FisheyeConfig) -> tuple[Bearings, Bearings]:
    """Return the bearings (N, 3) of pixels (N, 2) in the front circle and in the rear one."""
    return (lens_of(config.front, config.model).bearings(front_uv),
            lens_of(config.rear, config.model).bearings(rear_uv))
