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

"""A keyframe: a stabilised picture, its corners and how far away they are."""

import cv2
import numpy as np
from scipy.ndimage import map_coordinates

from sph_stab_ros.estimators.pose import fit_pose
from sph_stab_ros.trackers.band import follow

MIN_POINTS = 25
# Points trusted less than this have not been found.
MIN_WEIGHT = 0.1
# Inverse depths are in units of their median: that is all that is known of a new point's.
PRIOR_INFORMATION = 0.3
# What earlier frames told fades, as their errors are not independent of this frame's.
MEMORY = 0.5
MAX_INFORMATION = 1e4
# Share of the depths' information that survives the move to the next keyframe.
CARRIED_INFORMATION = 0.5
# Neighbouring points err alike: measured on simulated flights.
COVARIANCE_INFLATION = 3.0
# Depths are smoothed over some such cells for the parallax in between the points.
CELLS_AROUND = 40
SMOOTHING_CELLS = 0.6


class Keyframe:
    """
    A picture of the Band, and corners in it: bearings x, inverse depths ρ and their information.

    The camera was at the origin; ``position`` is where it was last seen to be.
    """

    def __init__(self, band, image, thumbnail, R_world_camera, covariance, uv,
                 inverse_depths, information):
        self._band = band
        self._image = image
        self.thumbnail = thumbnail
        self.R_world_camera = R_world_camera
        self._covariance = covariance
        self._uv = uv
        self._x = band.bearings(uv.astype(float))
        self._root_information = band.root_information(image, uv)
        self._inverse_depths = inverse_depths
        self._information = information
        self.return_to()

    def __len__(self):
        return len(self._uv)

    def return_to(self):
        """Look at the keyframe's surroundings anew, from somewhere near."""
        self.position = np.zeros(3)
        self._velocity = np.zeros(3)
        self._covariance_seen = np.zeros((3, 3))
        self.found = np.empty(0, int)
        self._seen_along = np.empty((0, 3))
        self._depth_map = self._smooth_depths()

    def measure(self, grey, R_world_camera, is_usable):
        """
        Return the PoseEstimate of a grey sphere (H, W) against this keyframe, None without.

        Its R takes the world as in ``R_world_camera`` to the world as seen; ``is_usable`` tells
        of bearings (N, 3) in the world which to use.
        """
        p = self.position + self._velocity
        expected = self._x - self._inverse_depths[:, None] * p
        look_along = self._parallax(p)
        image = self._band.look(grey, R_world_camera, look_along)
        # The picture moves with the smoothed depths, each point by its own.
        ahead = self._wrapped(self._band.pixels(expected) - self._band.pixels(
            look_along(self._uv)))
        uv, found = follow(self._image, image, self._uv, self._uv + ahead)
        y = look_along(uv.astype(float))
        y /= np.linalg.norm(y, axis=1, keepdims=True)
        index = np.flatnonzero(found & self._band.contains(uv) & is_usable(y))
        if len(index) < MIN_POINTS:
            return None
        y = y[index]
        return index, y, fit_pose(
            self._x[index], y, self._band.whitening(y, self._root_information[index]),
            self._inverse_depths[index], self._information[index], self.position)

    def update(self, index, y, fit):
        """Learn from an accepted measurement."""
        good = fit.weights > MIN_WEIGHT
        found = index[good]
        self._inverse_depths[found] = fit.inverse_depths[good]
        remembered = np.maximum(MEMORY * self._information[found], PRIOR_INFORMATION)
        self._information[found] = np.minimum(
            remembered + fit.information[good], MAX_INFORMATION)
        self._velocity = fit.position - self.position if len(self.found) else np.zeros(3)
        self.position = fit.position
        self._covariance_seen = fit.covariance[:3, :3]
        self.found = found
        self._seen_along = fit.R.inv().apply(y[good])
        self._depth_map = self._smooth_depths()

    def orientation_covariance(self):
        """Return the covariance (3, 3) of the last orientation, the keyframe's own included."""
        return self._covariance + COVARIANCE_INFLATION * self._covariance_seen

    def parallax_rad(self):
        """Return the median angle by which the points have moved."""
        return np.median(np.linalg.norm(self._seen_along - self._x[self.found], axis=1))

    def carried(self):
        """Return pixels, inverse depths and information of the points as seen last."""
        uv = self._band.pixels(self._seen_along)
        moved = (self._x[self.found]
                 - self._inverse_depths[self.found, None] * self.position)
        distance = np.linalg.norm(moved, axis=1)
        rho = self._inverse_depths[self.found] / distance
        unit = max(np.median(rho), 1e-3) if len(rho) else 1.
        information = self._information[self.found] * distance ** 2 * CARRIED_INFORMATION
        information = np.minimum(information * unit ** 2, MAX_INFORMATION)
        within = self._band.contains(uv)
        return uv[within], rho[within] / unit, information[within]

    def _wrapped(self, du_dv):
        du_dv[:, 0] -= np.rint(du_dv[:, 0] / self._band.width) * self._band.width
        return du_dv

    def _parallax(self, position):
        """Return the function from pixels to where they look from a position."""
        cell = self._band.width / CELLS_AROUND

        def look_along(uv):
            v, u = uv[..., 1] / cell + 1, uv[..., 0] / cell + 1
            rho = map_coordinates(self._depth_map, (v, u), order=1, mode='nearest')
            return self._band.bearings(uv) - rho[..., None] * np.float32(position)
        return look_along

    def _smooth_depths(self):
        """Return inverse depths on a grid of cells one cell larger than the band."""
        cell = self._band.width / CELLS_AROUND
        columns, rows = (int(np.ceil(size / cell)) + 3 for size in self._band.size_wh)
        weight = self._information / (self._information + 10 * PRIOR_INFORMATION)
        sums = np.zeros((2, rows, columns), np.float32)
        for turn in (-1, 0, 1):
            at = np.rint((self._uv + (turn * self._band.width, 0)) / cell + 1).astype(int)
            inside = (at[:, 0] >= 0) & (at[:, 0] < columns)
            where = at[inside, 1], at[inside, 0]
            np.add.at(sums[0], where, weight[inside])
            np.add.at(sums[1], where, (weight * self._inverse_depths)[inside])
        near, wide = ([cv2.GaussianBlur(s, (0, 0), sigma) for s in sums]
                      for sigma in (SMOOTHING_CELLS, 4 * SMOOTHING_CELLS))
        # Where no point is near, those further away; where there is none at all, the median.
        return ((near[1] + 0.05 * wide[1] + 1e-3) / (near[0] + 0.05 * wide[0] + 1e-3))
