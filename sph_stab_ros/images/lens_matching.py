# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""
Two lenses made to look like one picture, by what both see.

Along the border between them it is compared, direction by direction and colour by colour, how
bright either lens shows the same; each is given half of the ratio, and less and less of it further
away from the border. So a step becomes a slope, whatever it is of: exposure, white balance, the
rims' darkness, or the sun that shines into one lens only, on a real recording the largest part.
One gain for all of a lens would be right for the first two alone, and ruin the picture far from
the border by the others. Ratios are followed slowly, since things pass the border that one lens
sees from elsewhere.
"""

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import cv2
import numpy as np

from sph_stab_ros.config import FisheyeConfig
from sph_stab_ros.geometry.arrays import Floats, Grey, Image, Indices, Pixels, Plane
from sph_stab_ros.geometry.conventions import NS_PER_S
from sph_stab_ros.geometry.fisheye import DualFisheye
from sph_stab_ros.geometry.projection import Projection
from sph_stab_ros.images.frame import Frame

# Directions along the border, and how far from it, in shares of what both lenses see, is compared.
DIRECTIONS = 360
OFFSETS = np.linspace(-0.8, 0.8, 9)
# Ratios are smoothed over so many directions (one sigma).
SMOOTHING = 6
# What is dark is compared less strictly, as noise and the sensor's black weigh there.
BLACK = 2.
# Where ratios vary by more along one direction, either lens sees another thing, a near one mostly.
UNLIKE = 0.25
# With less trust all around, ratios are taken to be smaller.
MIN_TRUST = 0.2
# Larger ratios are of different things.
MAX_LOG_RATIO = np.log(2.5)
# Smaller ones are not seen, and not worth a copy of the picture.
MIN_LOG_RATIO = 0.02
FOLLOWING_S = 2.
# The slope ends so far from the border.
REACH_RAD = np.deg2rad(60)
# Gains change slowly over the picture: so much smaller they are computed.
REDUCTION = 4


class LensMatcher:
    """Follows how much brighter the front lens is than the rear one, all along the border."""

    def __init__(self) -> None:
        self._log_ratios: Floats | None = None
        self._time_ns = 0

    def matched(self, frame: Frame, projection: Projection, config: FisheyeConfig) -> Frame:
        """Return a Frame whose image is matched, if that is wanted, when it is asked for."""
        if not config.match_lenses or not isinstance(projection, DualFisheye):
            return frame
        return replace(frame, source=_MatchedPicture(frame, projection, self))

    def match(self, image: Image, projection: DualFisheye, time_ns: int) -> Image:
        """Return the picture of a time with its lenses matched."""
        found = log_ratios(image, projection)
        last = self._log_ratios
        if last is not None and last.shape == found.shape:
            elapsed_s = abs(time_ns - self._time_ns) / NS_PER_S
            found = last + (1 - np.exp(-elapsed_s / FOLLOWING_S)) * (found - last)
        self._log_ratios, self._time_ns = found, time_ns
        return without_ratios(image, projection, found)


class _MatchedPicture:
    """The picture of a Frame with its lenses matched, made when it is asked for."""

    def __init__(self, frame: Frame, projection: DualFisheye, matcher: LensMatcher) -> None:
        self._frame = frame
        self._projection = projection
        self._matcher = matcher
        self.size_wh = frame.size_wh

    @cached_property
    def image(self) -> Image:
        """Return the whole picture."""
        return self._matcher.match(self._frame.image, self._projection, self._frame.time_ns)

    def grey(self, width: int = 0) -> Grey:
        """Return the picture in grey as it is: the tracker does not mind."""
        return self._frame.grey(width)


def log_ratios(image: Image, projection: DualFisheye) -> Floats:
    """Return the logarithms (DIRECTIONS, C) of front over rear along the border."""
    front, rear = (
        BLACK + cv2.remap(image, pixels, None, cv2.INTER_LINEAR).reshape(*pixels.shape[:2], -1)
        .astype(np.float32) for pixels in _border(projection).pixels)
    # A tenth of the time that the node takes to start, for whoever needs it.
    from scipy.ndimage import gaussian_filter1d
    ratios = np.log(front.mean(axis=1) / rear.mean(axis=1))
    unlike = np.abs(np.log(front / rear) - ratios[:, None]).mean(axis=(1, 2))
    trusted = np.exp(-(unlike / UNLIKE) ** 2)[:, None]
    weighted, weight = (gaussian_filter1d(one, SMOOTHING, axis=0, mode='wrap')
                        for one in (trusted * ratios, trusted))
    return np.clip(weighted / np.maximum(weight, MIN_TRUST), -MAX_LOG_RATIO, MAX_LOG_RATIO)


def without_ratios(image: Image, projection: DualFisheye, log_ratios: Floats) -> Image:
    """Return the picture without the ratios of its lenses along the border, (DIRECTIONS, C)."""
    if np.abs(log_ratios).max() < MIN_LOG_RATIO:
        return image
    border = _border(projection)
    gains = np.exp(border.shares[..., None] * log_ratios[border.directions], dtype=np.float32)
    gains = cv2.resize(gains, projection.size_wh, interpolation=cv2.INTER_LINEAR)
    return cv2.multiply(image, gains, dtype=cv2.CV_8U)


@dataclass(frozen=True)
class _Border:
    """
    The border of two lenses in a picture.

    ``pixels`` of either lens (DIRECTIONS, offsets, 2) show the same. Of the reduced picture's
    pixels (h, w): the ``directions`` they lie in, and which ``shares`` of the ratios they are
    given, −1/2 to 1/2.
    """

    pixels: tuple[Pixels, ...]
    directions: Indices
    shares: Plane


@lru_cache(maxsize=4)
def _border(projection: DualFisheye) -> _Border:
    """Return the border of a projection's lenses."""
    front, rear = (lens.R_camera_lens.as_matrix() for lens in projection.lenses)
    axis = front[:, 2] - rear[:, 2]
    axis /= np.linalg.norm(axis)
    right = front[:, 0] - axis * (axis @ front[:, 0])
    right /= np.linalg.norm(right)
    down = np.cross(axis, right)

    around = np.arange(DIRECTIONS)[:, None] * (2 * np.pi / DIRECTIONS)
    off = OFFSETS * (projection.max_angle_rad - np.pi / 2)
    bearings = (np.sin(off)[..., None] * axis + np.cos(off)[..., None] * (
        np.cos(around)[..., None] * right + np.sin(around)[..., None] * down))
    pixels = tuple(np.stack(lens.pixels(bearings)[:2], axis=-1).astype(np.float32)
                   for lens in projection.lenses)

    width, height = (-(-size // REDUCTION) for size in projection.size_wh)
    uv = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1)
    seen_along, _ = projection.bearings((uv + 0.5) * REDUCTION - 0.5)
    x, y, z = (seen_along @ one for one in (right, down, axis))
    directions = np.round(np.arctan2(y, x) * (DIRECTIONS / (2 * np.pi))).astype(int) % DIRECTIONS
    to_border = np.minimum(np.abs(np.arcsin(np.clip(z, -1, 1))) / REACH_RAD, 1)
    near = [np.linalg.norm(((uv + 0.5) * REDUCTION - 0.5 - lens.center_px) / (1, lens.aspect),
                           axis=-1) / lens.radius_px for lens in projection.lenses]
    shares = np.where(near[0] < near[1], -0.5, 0.5) * np.cos(np.pi / 2 * to_border) ** 2
    return _Border(pixels, directions, shares.astype(np.float32))
