# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""
Two lenses whose pictures do not quite fit together: a constant of the camera, seen at the seam.

A stitched sphere shows one half through either lens. Where the two are turned against each other
by more or less than the stitching took, all bearings of one half are off against the other's, and
so is, by half of it and turning with the camera, every rotation fitted to both. What was seen
through one lens and then through the other tells.
"""

from dataclasses import dataclass

import numpy as np

from sph_stab_ros.geometry.arrays import Bearings, Covariance, Matrix, Vector
from sph_stab_ros.tracking.anchored.bundle_adjustment import Adjusted
from sph_stab_ros.tracking.anchored.bundle_window import (
    eliminated, pose_and_point_equations, Window)


@dataclass(frozen=True)
class LensOptions:
    """How the rotation between the halves of a picture is learnt, and trusted."""

    # Standard deviation of what is known beforehand: cameras are stitched so well or better.
    sigma_rad: float = np.deg2rad(0.2)
    # Windows share most of their observations, whose errors are alike from keyframe to keyframe:
    # each tells so little, and what older ones told, when less was known, is forgotten.
    share: float = 0.02
    memory: float = 0.95
    # Where this much, of about chi², speaks against nothing being wrong, it is believed that
    # something is; without a stitch error up to 3 was seen, with 0.3° up to 200.
    significant: float = 4.0
    # How much of that knowledge is trusted in the covariance, and the deviation that is taken to
    # be usual without; calibrated on simulated flights.
    trust: float = 0.05
    usual_rad: float = np.deg2rad(0.1)
    # A rotation fitted to both halves errs by half, and more where one of them shows more.
    influence: float = 0.7


class Lenses:
    """
    The rotation vector ``apart`` (3,) between the halves of a stitched picture, as learnt.

    With its covariance ``apart_covariance`` (3, 3) in rad².
    """

    def __init__(self, options: LensOptions) -> None:
        self._options = options
        self.apart: Vector = np.zeros(3)
        self._information: Matrix = np.zeros((3, 3))
        self._evidence: Vector = np.zeros(3)
        self.apart_covariance = self._apart_covariance()

    def learn(self, H: Matrix, g: Vector) -> Vector:
        """
        Take in the normal equations of a window as it is; return by how much ``apart`` grew.

        Least squares that forgets, and shrinks what it finds (W. James and C. Stein, *Estimation
        with quadratic loss*, Berkeley Symposium on Mathematical Statistics and Probability, 1961;
        the positive part).
        """
        options = self._options
        self._information = options.memory * self._information + options.share * H
        self._evidence = (options.memory * self._evidence
                          + options.share * (H @ self.apart - g))
        likely = np.linalg.solve(
            self._information + np.eye(3) / options.sigma_rad ** 2, self._evidence)
        significance = max(float(likely @ self._information @ likely), 1e-9)
        before = self.apart
        # What may as well be nothing is nothing.
        self.apart = max(0., 1 - options.significant / significance) * likely
        self.apart_covariance = self._apart_covariance()
        return self.apart - before

    def _apart_covariance(self) -> Covariance:
        options = self._options
        return np.linalg.inv(
            options.trust * self._information + np.eye(3) / options.usual_rad ** 2)

    def covariance(self, R_first_camera: Matrix) -> Covariance:
        """
        Return how uncertain an orientation is because of them: (3, 3) in rad².

        It grows with the turn since the first keyframe, in which they are part of the world:
        ``R_first_camera`` (3, 3).
        """
        D = R_first_camera - np.eye(3)
        influence = self._options.influence
        return influence ** 2 * np.trace(D @ self.apart_covariance @ D.T) / 3 * np.eye(3)

    def as_seen(self, bearings: Bearings) -> Bearings:
        """Return where in the picture bearings (N, 3) are to be seen."""
        return apart(bearings, -self.apart)

    def corrected(self, bearings: Bearings) -> Bearings:
        """Return the bearings (N, 3) of what is seen in the picture."""
        return apart(bearings, self.apart)


def apart(bearings: Bearings, rotvec: Vector) -> Bearings:
    """
    Return bearings (N, 3) of a picture whose front half (z > 0) is turned against its rear half.

    Each by half of the small rotation vector ``rotvec`` (3,).
    """
    x, y, z = rotvec
    # As cross(rotvec, bearings), in a fifth of NumPy's time.
    turned = bearings @ np.array(((0, z, -y), (-z, 0, x), (y, -x, 0)))
    turned *= np.where(bearings[:, 2:] > 0, 0.5, -0.5)
    turned += bearings
    turned /= np.sqrt(np.einsum('ni,ni->n', turned, turned))[:, None]
    return turned


def lens_equations(window: Window, adjusted: Adjusted) -> tuple[Matrix, Vector]:
    """
    Return what an Adjusted Window says about its lenses: normal equations H (3, 3) and g (3,).

    Of the rotation vector by which they should be taken apart. Keyframes and points are
    eliminated (Schur complement), so that what a turn of the camera explains is not counted.
    """
    H, g, H_rp, H_rr, g_r = pose_and_point_equations(
        window, adjusted.R, adjusted.p, adjusted.inverse_depths,
        adjusted.weights / adjusted.scale ** 2, lenses=True)
    damping = 1e-9 + 1e-6 * np.diag(H)[:-3]
    H_rr = H_rr + window.information
    H, g = H - eliminated(H_rp, H_rr), g - H_rp.T @ (g_r / H_rr)
    by_pose = np.linalg.solve(H[:-3, :-3] + np.diag(damping), H[:-3, -3:])
    return H[-3:, -3:] - by_pose.T @ H[:-3, -3:], g[-3:] - by_pose.T @ g[:-3]
