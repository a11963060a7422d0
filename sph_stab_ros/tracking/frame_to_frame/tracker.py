# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The paper's tracker: a chain of rotations from frame to frame."""

from typing import Any

from sph_stab_ros.geometry.arrays import Grey, Mask
from sph_stab_ros.images.texture import has_texture
from sph_stab_ros.tracking.base import (
    GyroRotation, no_gyro, TrackedOrientation, TrackingStatus)
from sph_stab_ros.tracking.frame_to_frame.methods import (
    ImagePair, Method, METHODS, Sphere)
from sph_stab_ros.tracking.motion_model import MotionModel


class FrameToFrameTracker:
    """
    The paper's tracker: rotations from frame to frame, accumulated.

    A frame that shows nothing (black, blurred away) is bridged: the next good one is compared
    with the last good one. Errors add up with every frame, so that the orientation drifts.

    Parameters
    ----------
    method : str or callable
        A name in METHODS, or a function of an ImagePair that returns a RotationEstimate or None.
    used : (H, W) bool, optional
        Pixels to use.
    max_prediction_s : float
        For how long the last angular velocity is trusted.
    gyro_rotation : GyroRotation
    pair_options :
        Those of ImagePair.

    """

    def __init__(self, method: str | Method, used: Mask | None = None,
                 max_prediction_s: float = 0.5, gyro_rotation: GyroRotation = no_gyro,
                 **pair_options: Any) -> None:
        self._estimate = METHODS[method] if isinstance(method, str) else method
        self._pair_options = pair_options
        self._used = used
        self._max_prediction_s = max_prediction_s
        self._turn_between = gyro_rotation
        self.reset()

    def reset(self) -> None:
        """Forget everything: the next frame's orientation is the new world."""
        self._reference: Sphere | None = None
        self._motion = MotionModel(self._max_prediction_s, self._turn_between)

    def track(self, grey: Grey, stamp_ns: int) -> TrackedOrientation:
        """Return the TrackedOrientation of the next grey sphere."""
        if not has_texture(grey):
            return self._predicted(stamp_ns)
        motion, current = self._motion, Sphere(grey, self._used)
        if self._reference is None:
            self._reference = current
            motion.reset(stamp_ns)
            return TrackedOrientation(motion.R_world_camera, TrackingStatus.OK)

        estimate = self._estimate(ImagePair(self._reference, current, **self._pair_options))
        if estimate is None:
            held = self._predicted(stamp_ns)
            if held.status is TrackingStatus.LOST:
                self._reference, motion.R_world_camera = current, held.R_world_camera
                motion.reset(stamp_ns)
            return held
        self._reference = current
        motion.update(stamp_ns, motion.R_world_camera * estimate.R_current_previous.inv(),
                      motion.position)
        return TrackedOrientation(motion.R_world_camera, TrackingStatus.OK)

    def settle(self) -> None:
        """Do nothing: nothing is put off."""

    def _predicted(self, stamp_ns: int) -> TrackedOrientation:
        """Turn the last orientation on, by the gyro or its angular velocity, as far as known."""
        motion = self._motion
        return TrackedOrientation(
            motion.R_world_camera * motion.predicted_rotation(stamp_ns),
            TrackingStatus.PREDICTED if motion.is_predictable(stamp_ns) else TrackingStatus.LOST)
