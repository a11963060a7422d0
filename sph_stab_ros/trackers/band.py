# Copyright 2026 The sph_stab_ros developers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""The stabilised sphere between two latitudes, as a picture to follow corners in."""

import cv2
import numpy as np

from sph_stab_ros.equirect import bearings_from_pixels, pixels_from_bearings
from sph_stab_ros.warp import InverseWarp

# Nearer to the poles the picture is too distorted for a square window.
MAX_LATITUDE_RAD = np.deg2rad(65)
# Continued across the seam by the reach of a window on the coarsest level.
MARGIN_PX = 48
WINDOW_PX = 21
PYRAMID_LEVELS = 1
MIN_CORNER_DISTANCE_PX = 10
MAX_CORNERS = 400
# Of the strongest corner; weaker ones follow the noise of plain walls.
MIN_CORNER_QUALITY = 5e-3
# Smallest eigenvalue of a window's structure tensor, per pixel, that can be followed.
MIN_EIGENVALUE = 5e-4
# Mean grey difference of a window that has been followed to the wrong place.
MAX_DIFFERENCE = 25
# A corner is found to within this where it is strong; the mean squared gradient (grey values per
# pixel) at which noise adds as much again.
CORNER_SIGMA_PX = 0.1
NOISE_GRADIENT = 50.0


class Band:
    """Latitudes up to 65° of a sphere ``width`` wide: where pixels and bearings of it are."""

    def __init__(self, width):
        self.width = width
        self.px_per_rad = width / (2 * np.pi)
        first_row = round(width / 2 * (0.5 - MAX_LATITUDE_RAD / np.pi))
        self.size_wh = width + 2 * MARGIN_PX, width // 2 - 2 * first_row
        self._offset_px = np.float32((MARGIN_PX, -first_row))
        self._warp = InverseWarp(self.bearings, self.size_wh)

    def look(self, grey, R_world_camera, bearings=None):
        """
        Return the band's picture of the grey sphere (H, W) in the world's orientation.

        ``bearings``, a function of pixels (..., 2), is where each pixel looks instead.
        """
        warp = self._warp if bearings is None else InverseWarp(bearings, self.size_wh)
        return warp(grey, R_world_camera.inv())

    def bearings(self, uv):
        """Return where the band's pixels (..., 2) look, unit vectors (..., 3)."""
        return bearings_from_pixels(uv - self._offset_px, self.width)

    def pixels(self, bearings):
        """Return where in the band, (..., 2), vectors (..., 3) of any length are seen."""
        return np.float32(pixels_from_bearings(bearings, self.width) + self._offset_px)

    def contains(self, uv):
        """Tell which pixels (N, 2) lie far enough within the band to be followed."""
        reach = WINDOW_PX / 2
        return (uv[:, 1] > reach) & (uv[:, 1] < self.size_wh[1] - reach)

    def corners(self, image, taken):
        """Return new corners of a picture, (N, 2), away from those already ``taken`` (M, 2)."""
        free = np.zeros(self.size_wh[::-1], np.uint8)
        reach = WINDOW_PX // 2
        free[reach:-reach, MARGIN_PX:-MARGIN_PX] = 255
        for u, v in np.rint(taken).astype(int).tolist():
            cv2.circle(free, (u, v), MIN_CORNER_DISTANCE_PX, 0, -1)
        wanted = MAX_CORNERS - len(taken)
        found = None if wanted <= 0 else cv2.goodFeaturesToTrack(
            image, wanted, MIN_CORNER_QUALITY, MIN_CORNER_DISTANCE_PX, mask=free, blockSize=7)
        return np.empty((0, 2), np.float32) if found is None else found[:, 0]

    def root_information(self, image, uv):
        """
        Return how exactly windows around pixels (N, 2) can be followed, (N, 2, 2) per pixel.

        The symmetric root of ``G (G + G0)⁻¹ / σ²``, G the windows' mean structure tensor.
        """
        gradients = [cv2.Scharr(image, cv2.CV_32F, *order) / 32 for order in ((1, 0), (0, 1))]
        columns, rows = np.rint(uv).astype(int).T
        G = np.empty((len(uv), 2, 2))
        for i, j in ((0, 0), (0, 1), (1, 1)):
            mean = cv2.blur(gradients[i] * gradients[j], (WINDOW_PX, WINDOW_PX))
            G[:, i, j] = G[:, j, i] = mean[rows, columns]
        values, vectors = np.linalg.eigh(G)
        values = np.maximum(values, 1e-3)
        roots = np.sqrt(values / (values + NOISE_GRADIENT)) / CORNER_SIGMA_PX
        return (vectors * roots[:, None, :]) @ np.swapaxes(vectors, 1, 2)

    def whitening(self, bearings, root_information):
        """Return the derivatives (2, N, 3) of pixels times their root information (N, 2, 2)."""
        cos_lat = np.maximum(np.hypot(bearings[:, 0], bearings[:, 2]), 0.1)[:, None]
        east = np.stack(
            (bearings[:, 2], np.zeros(len(bearings)), -bearings[:, 0]), axis=1) / cos_lat
        derivatives = np.stack((east / cos_lat, np.cross(bearings, east))) * self.px_per_rad
        return np.einsum('nij,jnk->ink', root_information, derivatives)


def follow(before, now, uv_before, uv_now):
    """
    Return where corners (N, 2) of one picture are in another, and which were found (N,).

    Pyramidal Lucas–Kanade from the guesses ``uv_now`` (N, 2).
    """
    uv, found, difference = cv2.calcOpticalFlowPyrLK(
        before, now, uv_before, uv_now.copy(), winSize=(WINDOW_PX, WINDOW_PX),
        maxLevel=PYRAMID_LEVELS, flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
        criteria=(cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 15, 0.01),
        minEigThreshold=MIN_EIGENVALUE)
    return uv, (found[:, 0] > 0) & (difference[:, 0] < MAX_DIFFERENCE)
