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

"""
The anchored tracker: corners followed against keyframes in the stabilised picture.

Each frame is turned into the world as predicted, and shifted by the parallax as predicted, so that
little is left to follow; and it is compared with a keyframe instead of with the frame before, so
that errors do not add up.
"""

import numpy as np
from scipy.spatial.transform import Rotation

from sph_stab_ros.equirect import pixels_from_bearings
from sph_stab_ros.flow import has_texture
from sph_stab_ros.trackers.band import Band, MARGIN_PX
from sph_stab_ros.trackers.base import no_gyro, TrackedOrientation, TrackingStatus
from sph_stab_ros.trackers.keyframe import Keyframe, MIN_POINTS, MIN_WEIGHT, PRIOR_INFORMATION
from sph_stab_ros.trackers.still_pixels import StillPixels
from sph_stab_ros.trackers.thumbnail import align, difference, Thumbnail
from sph_stab_ros.trajectory import NS_PER_S

# A keyframe is replaced when fewer of its points are found, or when they have moved further.
MIN_SURVIVORS = 0.5
MAX_PARALLAX_RAD = 0.08
# Prediction errors beyond this are taken out of the picture and the corners followed once more.
GOOD_PREDICTION_RAD = np.deg2rad(0.7)
MAX_ATTEMPTS = 3
# A fit by fewer of the points that were followed shows something else.
MIN_AGREEMENT = 0.3
POOL_SIZE = 32
# Mean difference of thumbnails of one place, in standard deviations of their grey values.
SAME_PLACE = 0.15
# After a loss the last keyframes are tried, from these headings.
MAX_CANDIDATES = 4
YAW_STARTS_RAD = np.deg2rad((0, 60, -60, 120, -120, 180))
# An old keyframe is returned to from so near.
MAX_RETURNS = 2
MAX_RETURN_PARALLAX_RAD = 0.015
MIN_RETURN_SURVIVORS = 0.75
# A correction reaches the picture at this rate.
MAX_CORRECTION_RAD = np.deg2rad(0.01)


class AnchoredTracker:
    """
    Orientation against keyframes, of which the ones at places seen before are used again.

    Parameters
    ----------
    width : int
        Of the grey spheres.
    used : (H, W) bool, optional
        Pixels to use.
    max_prediction_s : float
        For how long the last angular velocity is trusted.
    turn_between : callable
        Returns the turn ``R_from_to`` between two stamps, or None.

    """

    def __init__(self, width, used=None, max_prediction_s=0.5, turn_between=no_gyro):
        self._band = Band(width)
        self._used = used
        self._max_prediction_s = max_prediction_s
        self._turn_between = turn_between
        self.reset()

    def reset(self):
        """Forget everything: the next frame's orientation is the new world."""
        self._keyframe = None
        self._pool = []
        self._still = StillPixels()
        self._thumbnail = None
        self._stamp_ns = None
        self._R_world_camera = Rotation.identity()
        self._R_out_world = Rotation.identity()
        self._angular_velocity_rad_s = None

    @property
    def still_pixels(self):
        """Pixels (80, 160) bool of the camera that stand still while the world turns."""
        return self._still.mask

    @property
    def keyframes_kept(self):
        """Return the number of keyframes in the pool."""
        return len(self._pool)

    def track(self, grey, stamp_ns):
        """Return the TrackedOrientation of the next grey sphere (H, W) uint8."""
        if not has_texture(grey):
            return self._predicted(stamp_ns)
        thumbnail = Thumbnail(grey)
        if self._keyframe is None:
            self._accept(grey, thumbnail, stamp_ns, self._R_world_camera)
            self._add_keyframe(grey)
            return TrackedOrientation(
                self._R_world_camera, TrackingStatus.OK, self._keyframe.orientation_covariance())

        R_camera_last = self._turn_since(stamp_ns).inv()
        R_camera_last = align(self._thumbnail, thumbnail, R_camera_last)
        R_world_camera = self._measure(
            self._keyframe, grey, self._R_world_camera * R_camera_last.inv())
        if R_world_camera is None:
            R_world_camera = self._relocalise(grey, thumbnail)
        if R_world_camera is None:
            held = self._predicted(stamp_ns)
            if held.status is TrackingStatus.LOST:
                self._accept(grey, thumbnail, None, held.R_world_camera)
                self._R_out_world = Rotation.identity()
                self._keyframe = None
                self._add_keyframe(grey)
            return held
        self._accept(grey, thumbnail, stamp_ns, R_world_camera)
        if self._is_used_up():
            self._change_keyframe(grey)
        return TrackedOrientation(
            self._R_out_world * self._R_world_camera, TrackingStatus.OK,
            self._keyframe.orientation_covariance())

    def _measure(self, keyframe, grey, R_world_camera):
        """Return R_world_camera measured against a keyframe from a guess, None without."""
        for _ in range(MAX_ATTEMPTS):
            measured = keyframe.measure(
                grey, R_world_camera, lambda x: self._is_usable(x, R_world_camera))
            if measured is None:
                return None
            index, y, fit = measured
            agreeing = (fit.weights > MIN_WEIGHT).sum()
            if agreeing < max(MIN_POINTS, MIN_AGREEMENT * len(index)):
                return None
            R_world_camera = fit.R.inv() * R_world_camera
            if fit.R.magnitude() < GOOD_PREDICTION_RAD:
                break
        keyframe.update(index, y, fit)
        return R_world_camera

    def _accept(self, grey, thumbnail, stamp_ns, R_world_camera):
        """Make this frame the last one that showed something."""
        step = self._R_world_camera.inv() * R_world_camera
        self._angular_velocity_rad_s = None
        if None not in (stamp_ns, self._stamp_ns) and stamp_ns > self._stamp_ns:
            elapsed_s = (stamp_ns - self._stamp_ns) / NS_PER_S
            self._angular_velocity_rad_s = step.as_rotvec() / elapsed_s
        self._still.update(grey, None if self._thumbnail is None else step.inv())
        self._thumbnail = thumbnail
        self._stamp_ns = stamp_ns
        self._R_world_camera = R_world_camera
        left = self._R_out_world.as_rotvec()
        size = np.linalg.norm(left)
        self._R_out_world = Rotation.from_rotvec(
            left * (max(0., size - MAX_CORRECTION_RAD) / max(size, 1e-12)))

    def _is_used_up(self):
        return (len(self._keyframe.found) < MIN_SURVIVORS * len(self._keyframe)
                or self._keyframe.parallax_rad() > MAX_PARALLAX_RAD)

    def _change_keyframe(self, grey):
        """Go on with an old keyframe where there is one of this place, else with a new one."""
        others = [k for k in self._nearest(self._thumbnail, self._R_world_camera)
                  if k is not self._keyframe]
        for keyframe in others[:MAX_RETURNS]:
            keyframe.return_to()
            R_world_camera = self._measure(keyframe, grey, self._R_world_camera)
            if (R_world_camera is None
                    or len(keyframe.found) < MIN_RETURN_SURVIVORS * len(keyframe)
                    or keyframe.parallax_rad() > MAX_RETURN_PARALLAX_RAD):
                continue
            self._R_out_world = self._R_out_world * self._R_world_camera * R_world_camera.inv()
            self._R_world_camera = R_world_camera
            self._keyframe = keyframe
            return
        self._add_keyframe(grey)

    def _add_keyframe(self, grey):
        """Start a keyframe here; its neighbours' points go on in it."""
        image = self._band.look(grey, self._R_world_camera)
        uv, inverse_depths, information = (
            np.empty((0, 2), np.float32), np.empty(0), np.empty(0))
        covariance = np.zeros((3, 3))
        if self._keyframe is not None and len(self._keyframe.found):
            uv, inverse_depths, information = self._keyframe.carried()
            covariance = self._keyframe.orientation_covariance()
            uv[:, 0] = (uv[:, 0] - MARGIN_PX) % self._band.width + MARGIN_PX
        new = self._band.corners(image, uv)
        new = new[self._is_usable(self._band.bearings(new), self._R_world_camera)]
        self._keyframe = Keyframe(
            self._band, image, self._thumbnail, self._R_world_camera, covariance,
            np.concatenate((uv, new)),
            np.concatenate((inverse_depths, np.ones(len(new)))),
            np.concatenate((information, np.full(len(new), PRIOR_INFORMATION))))
        self._remember(self._keyframe)

    def _remember(self, keyframe):
        """Keep a keyframe in the pool, in place of the one that is most like its successor."""
        self._pool.append(keyframe)
        if len(self._pool) > POOL_SIZE:
            unlike = [difference(a.thumbnail, b.thumbnail, b.R_world_camera.inv()
                                 * a.R_world_camera) for a, b in zip(self._pool, self._pool[1:])]
            # The first one is the world.
            del self._pool[1 + int(np.argmin(unlike[1:]))]

    def _nearest(self, thumbnail, R_world_camera):
        """Return the pool's keyframes that look like this picture, the oldest first."""
        return [key for key in self._pool if difference(
            key.thumbnail, thumbnail, R_world_camera.inv() * key.R_world_camera) < SAME_PLACE]

    def _relocalise(self, grey, thumbnail):
        """Return R_world_camera from the last keyframes, whatever the camera has done since."""
        starts = []
        for keyframe in self._pool[-MAX_CANDIDATES:]:
            for yaw_rad in YAW_STARTS_RAD:
                R_camera_key = align(keyframe.thumbnail, thumbnail,
                                     Rotation.from_rotvec((0, yaw_rad, 0)))
                unlike = difference(keyframe.thumbnail, thumbnail, R_camera_key)
                starts.append((unlike, len(starts), keyframe, R_camera_key))
        for _, _, keyframe, R_camera_key in sorted(starts)[:MAX_ATTEMPTS]:
            keyframe.return_to()
            R_world_camera = self._measure(
                keyframe, grey, keyframe.R_world_camera * R_camera_key.inv())
            if R_world_camera is not None:
                self._keyframe = keyframe
                self._R_out_world = Rotation.identity()
                return R_world_camera
        return None

    def _is_usable(self, bearings, R_world_camera):
        """Tell which bearings (N, 3) in the world are seen where the world is to be seen."""
        in_camera = R_world_camera.inv().apply(bearings)
        usable = ~_read(self._still.mask, in_camera)
        if self._used is not None:
            usable &= _read(self._used, in_camera)
        return usable

    def _turn_since(self, stamp_ns):
        """Return the turn R_last_camera expected since the last frame that showed something."""
        measured = self._measured_turn_since(stamp_ns)
        if measured is not None:
            return measured
        if self._angular_velocity_rad_s is None:
            return Rotation.identity()
        elapsed_s = (stamp_ns - self._stamp_ns) / NS_PER_S
        trusted_s = min(max(elapsed_s, 0), self._max_prediction_s)
        return Rotation.from_rotvec(self._angular_velocity_rad_s * trusted_s)

    def _measured_turn_since(self, stamp_ns):
        """Return the same as the gyro saw it, None where it did not."""
        return None if self._stamp_ns is None else self._turn_between(self._stamp_ns, stamp_ns)

    def _predicted(self, stamp_ns):
        """Turn the last orientation on, by the gyro or its angular velocity, as far as known."""
        in_time = self._measured_turn_since(stamp_ns) is not None or (
            self._angular_velocity_rad_s is not None
            and 0 <= stamp_ns - self._stamp_ns <= self._max_prediction_s * NS_PER_S)
        return TrackedOrientation(
            self._R_out_world * self._R_world_camera * self._turn_since(stamp_ns),
            TrackingStatus.PREDICTED if in_time else TrackingStatus.LOST)


def _read(mask, bearings):
    """Return the values (N,) of a mask (H, W) along bearings (N, 3)."""
    height, width = mask.shape
    columns, rows = np.rint(pixels_from_bearings(bearings, width)).astype(int).T
    return mask[np.clip(rows, 0, height - 1), columns % width]
