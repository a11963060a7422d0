# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The paper's tracker: a chain of rotations from frame to frame."""

from typing import Any

from scipy.spatial.transform import Rotation

from sph_stab_ros.geometry.arrays import Grey, Mask, Vector
from sph_stab_ros.geometry.conventions import NS_PER_S
from sph_stab_ros.images.texture import has_texture
from sph_stab_ros.tracking.base import (
    GyroRotation, no_gyro, TrackedOrientation, TrackingStatus)
from sph_stab_ros.tracking.frame_to_frame.image_pair import (
    ImagePair, Method, METHODS, Sphere)


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
        # Of no meaning before there is a reference.
        self._reference_stamp_ns = 0
        self._R_world_reference = Rotation.identity()
        self._angular_velocity_rad_s: Vector | None = None

    def track(self, grey: Grey, stamp_ns: int) -> TrackedOrientation:
        """Return the TrackedOrientation of the next grey sphere."""
        if not has_texture(grey):
            return self._predicted(stamp_ns)
        current = Sphere(grey, self._used)
        if self._reference is None:
            self._refer_to(current, stamp_ns, self._R_world_reference)
            return TrackedOrientation(self._R_world_reference, TrackingStatus.OK)

        estimate = self._estimate(ImagePair(self._reference, current, **self._pair_options))
        if estimate is None:
            held = self._predicted(stamp_ns)
            if held.status is TrackingStatus.LOST:
                self._refer_to(current, stamp_ns, held.R_world_camera)
            return held
        R_reference_camera = estimate.R_current_previous.inv()
        elapsed_s = (stamp_ns - self._reference_stamp_ns) / NS_PER_S
        self._angular_velocity_rad_s = (
            R_reference_camera.as_rotvec() / elapsed_s if elapsed_s > 0 else None)
        self._refer_to(current, stamp_ns, self._R_world_reference * R_reference_camera)
        return TrackedOrientation(self._R_world_reference, TrackingStatus.OK)

    def settle(self) -> None:
        """Do nothing: nothing is put off."""

    def _refer_to(self, sphere: Sphere, stamp_ns: int, R_world_reference: Rotation) -> None:
        self._reference = sphere
        self._reference_stamp_ns = stamp_ns
        self._R_world_reference = R_world_reference

    def _predicted(self, stamp_ns: int) -> TrackedOrientation:
        """Turn the last orientation on, by the gyro or its angular velocity, as far as known."""
        turn = (None if self._reference is None
                else self._turn_between(self._reference_stamp_ns, stamp_ns))
        if turn is not None:
            return TrackedOrientation(self._R_world_reference * turn, TrackingStatus.PREDICTED)
        if self._angular_velocity_rad_s is None:
            return TrackedOrientation(self._R_world_reference, TrackingStatus.LOST)
        elapsed_s = (stamp_ns - self._reference_stamp_ns) / NS_PER_S
        in_time = 0 <= elapsed_s <= self._max_prediction_s
        trusted_s = min(max(elapsed_s, 0), self._max_prediction_s)
        turn = Rotation.from_rotvec(self._angular_velocity_rad_s * trusted_s)
        return TrackedOrientation(
            self._R_world_reference * turn,
            TrackingStatus.PREDICTED if in_time else TrackingStatus.LOST)
