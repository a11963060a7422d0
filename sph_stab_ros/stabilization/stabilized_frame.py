# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""A frame with its orientation, the pictures that can be made of it, and what was odd about it."""

from dataclasses import dataclass, field
from enum import Enum

from scipy.spatial.transform import Rotation

from sph_stab_ros.geometry.arrays import Covariance, Image
from sph_stab_ros.geometry.projection import Projection
from sph_stab_ros.geometry.rotations import standard_deviation_rad
from sph_stab_ros.geometry.warp import equirect_warp, perspective_warp
from sph_stab_ros.images.frame import Frame
from sph_stab_ros.tracking import TrackingStatus

# Without a frame for so long, motion in between is guesswork.
LONG_GAP_S = 1.0


class StabilizationEvent(Enum):
    """Something about a frame that its user should hear of; the frame was used all the same."""

    RESIZED = 'the image size changed; tracking starts anew from the last image'
    STAMP_NOT_INCREASING = 'the stamp is not later than the one before'
    GAP = f'no frame for more than {LONG_GAP_S:g} s'
    NO_GRAVITY = f'no usable force from the IMU for more than {LONG_GAP_S:g} s to level by'


@dataclass(frozen=True)
class StabilizedFrame:
    """
    A frame with its orientation; pictures are computed when they are asked for.

    They are those of the virtual camera, of orientation ``R_world_virtual``.
    """

    frame: Frame
    R_world_camera: Rotation
    status: TrackingStatus
    events: tuple[StabilizationEvent, ...] = ()
    # As TrackedOrientation's.
    covariance: Covariance | None = None
    R_world_virtual: Rotation = field(default_factory=Rotation.identity)
    # Of the frame's image; None where it is equirectangular.
    projection: Projection | None = None
    # What is known of the cause of NO_GRAVITY.
    why_no_gravity: str = ''

    @property
    def stamp_ns(self) -> int:
        """Stamp of the input frame in nanoseconds."""
        return self.frame.stamp_ns

    @property
    def uncertainty_rad(self) -> float | None:
        """One standard deviation about the least certain axis; None where it is not known."""
        return None if self.covariance is None else standard_deviation_rad(self.covariance)

    @property
    def R_camera_virtual(self) -> Rotation:
        """Return what turns the virtual camera's bearings into the camera's."""
        return self.R_world_camera.inv() * self.R_world_virtual

    def sphere(self) -> Image:
        """Return the virtual camera's equirectangular image, as fine as the input."""
        return self.seen_along(self.R_camera_virtual)

    def view(
            self, R_virtual_view: Rotation, hfov_rad: float, size_wh: tuple[int, int]) -> Image:
        """Return a perspective image along a direction of the virtual camera's."""
        return self.seen_along(self.R_camera_virtual * R_virtual_view, hfov_rad, size_wh)

    def seen_along(self, R_camera_target: Rotation, hfov_rad: float | None = None,
                   size_wh: tuple[int, int] | None = None) -> Image:
        """Return what a camera turned against this one sees: the sphere, or a perspective view."""
        image = self.frame.image
        if hfov_rad is None:
            width = self.projection.sphere_width if self.projection else image.shape[1]
            warp = equirect_warp(width)
        else:
            assert size_wh is not None, 'a perspective view has a size'
            warp = perspective_warp(float(hfov_rad), *size_wh)
        return warp(image, R_camera_target, self.projection)
