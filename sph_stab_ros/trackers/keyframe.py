# Copyright 2026 The sph_stab_ros developers
# SPDX-License-Identifier: Apache-2.0
"""A keyframe: a stabilised picture, its corners and how far away they are."""

import numpy as np

from sph_stab_ros.trackers.band import follow

MEMORY = 0.8
SIGMA_DEPTH_PX = 0.5
MAX_INFORMATION = 1e4
MAX_STRIKES = 3
MAX_PARALLAX_RAD = 0.15


class Keyframe:

    def __init__(self, image, uv, band, position, typical):
        self.image = image
        self.uv = uv
        self.uv_now = uv.copy()
        self.x = band.bearings(uv)
        self.rho = np.full(len(uv), typical)
        self.information = np.full(len(uv), 1 / typical ** 2)
        self.scale = typical
        self.position = position
        self.strikes = np.zeros(len(uv), int)
        self.alive = np.ones(len(uv), bool)

    def follow_into(self, image, band):
        index = np.flatnonzero(self.alive)
        if not len(index):
            return index, np.empty((0, 2), np.float32)
        uv, found = follow(self.image, image, self.uv[index], self.uv_now[index])
        found &= band.contains(uv)
        self.strikes[index] += 1
        return index[found], uv[found]

    def update(self, index, inliers, rho, information, uv, fit, noise_px, band):
        good = index[inliers]
        self.strikes[good] = 0
        self.rho[good] = rho[inliers]
        gain = information[inliers] * min(1, noise_px / SIGMA_DEPTH_PX) ** 2
        self.information[good] = np.minimum(
            np.maximum(MEMORY * self.information[good], 1 / self.scale ** 2) + gain, MAX_INFORMATION / self.scale ** 2)
        z = self.x + self.rho[:, None] * (self.position - fit.position)
        z /= np.linalg.norm(z, axis=1, keepdims=True)
        parallax = np.linalg.norm(z - self.x, axis=1)
        self.alive &= (self.strikes < MAX_STRIKES) & (parallax < MAX_PARALLAX_RAD)
        now = band.pixels(z)
        measured = band.pixels(fit.R.inv().apply(band.bearings(uv[inliers])))
        now[good] = measured
        turns = np.rint((self.uv_now[:, 0] - now[:, 0]) / band.width)
        now[:, 0] += turns * band.width
        self.uv_now = now
