# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Pictures of two fisheye circles whose calibration is known."""

from functools import lru_cache

import numpy as np
from scipy.spatial.transform import Rotation

from sph_stab_ros.geometry.fisheye import dual_fisheye
from sph_stab_ros.geometry.projection import Equirect


@lru_cache(maxsize=4)
def fisheye_pixels(config):
    """
    Return bearings (H, W, 3), and which of them the lenses see, of a FisheyeConfig's pixels.

    Not to be written to. The left half is the front lens'.
    """
    front, rear = dual_fisheye(config, (config.width, config.height)).lenses
    uv = np.stack(np.meshgrid(np.arange(config.width), np.arange(config.height)), axis=-1)
    left = uv[..., 0] < config.width / 2
    bearings = np.where(left[..., None], front.bearings(uv), rear.bearings(uv))
    theta = np.where(left, front.pixels(bearings)[2], rear.pixels(bearings)[2])
    centers = np.where(left[..., None], front.center_px, rear.center_px)
    radius_px = np.linalg.norm(uv - centers, axis=-1)
    seen = (theta <= np.deg2rad(config.fov_deg / 2)) & (radius_px < 1.2 * front.radius_px)
    return bearings, seen


def fisheye_picture(sphere, config, R_world_camera=Rotation.identity()):
    """Return what a camera of a FisheyeConfig sees of a sphere (H, W[, C]); black around."""
    bearings, seen = fisheye_pixels(config)
    world = bearings @ R_world_camera.as_matrix().T
    picture = Equirect(sphere.shape[1]).read(sphere, *np.float32(np.moveaxis(world, -1, 0)))
    picture[~seen] = 0
    return picture
