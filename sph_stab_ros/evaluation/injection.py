# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""
Evaluation without ground truth: real footage turned by known rotations.

Frame i of a clip is rendered as a camera turned by ``R_camera_shaken[i]`` would have seen it. Of
whatever orientation an estimator finds for the clip itself, that of the shaken clip must be the
same composed with what was injected::

    R_world_shaken = R_world_camera R_camera_shaken

Both are estimated by the same estimator, so that only what the injection changes counts: an error
that both make alike, such as a slow drift, does not show. Neither does locking onto the robot's
own body, which is part of the picture and turned with it; unless it is named: then only the world
is turned, and the body stays where it is, as that of a real robot does.
"""

from dataclasses import replace

import cv2
import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from sph_stab_ros.geometry.arrays import Image, Mask, Raster
from sph_stab_ros.geometry.equirect import bearing_grid, pad_sphere, pixels_from_bearings
from sph_stab_ros.geometry.masks import common, load_mask
from sph_stab_ros.geometry.warp import view_rotation
from sph_stab_ros.images.frame import Frame
from sph_stab_ros.stabilization.imu import ImuSample
from sph_stab_ros.stabilization.recording_loop import FrameProcessor
from sph_stab_ros.stabilization.stabilized_frame import StabilizedFrame

# Yaw, pitch, roll.
PEAKS_DEG = (25., 12., 15.)
SIGMAS_FRAMES = (12., 8., 8.)
# Lanczos over 8×8 pixels reads up to four pixels beyond the image.
MARGIN_PX = 4
FILL_WIDTH = 128
FILL_SIGMA_PX = 4


def injected_rotations(seed: int, frames: int) -> Rotation:
    """
    Return the rotations R_camera_shaken to inject, one for each of ``frames`` ≥ 2 frames.

    Yaw, pitch and roll are Gaussian-smoothed noise that starts at zero and peaks at PEAKS_DEG.
    """
    rng = np.random.default_rng(seed)
    angles = []
    for peak_deg, sigma in zip(PEAKS_DEG, SIGMAS_FRAMES):
        noise = gaussian_filter1d(rng.standard_normal(frames), sigma)
        noise -= noise[0]
        angles.append(np.deg2rad(peak_deg) * noise / np.abs(noise).max())
    return Rotation.concatenate([view_rotation(*one) for one in zip(*angles)])


def turned(image: Image, R_source_target: Rotation) -> Image:
    """
    Return the sphere ``image`` as a camera turned by ``R_source_target`` sees it.

    Slower than ``rotate_equirect`` and as exact as can be: no interpolation of the map, Lanczos'
    of the picture.
    """
    width = image.shape[1]
    uv = pixels_from_bearings(
        bearing_grid(width) @ R_source_target.as_matrix().astype(np.float32).T, width) + MARGIN_PX
    return cv2.remap(pad_sphere(image, MARGIN_PX), uv[..., 0], uv[..., 1], cv2.INTER_LANCZOS4)


def turned_world(image: Image, R_source_target: Rotation, world: Mask) -> Image:
    """
    Return ``turned`` where the ``world`` is seen; other pixels stay as they are.

    What they hide of the world is filled in with the blurred colours around it.
    """
    filled = np.where(_like(world, image), image, _blurred(image, world))
    return np.where(_like(world, image), turned(filled, R_source_target), image)


def _blurred(image: Image, world: Mask) -> Image:
    """Return an image of the world's blurred colours, spread over all of it."""
    size_wh = image.shape[1::-1]

    def spread(values: Raster) -> Raster:
        small = cv2.resize(values.astype(np.float32), (FILL_WIDTH, FILL_WIDTH // 2),
                           interpolation=cv2.INTER_AREA)
        # A little of everything, for where the blur does not reach.
        blurred = cv2.GaussianBlur(small, (0, 0), FILL_SIGMA_PX) + 1e-6 * small.mean(axis=(0, 1))
        return cv2.resize(blurred, size_wh)
    weights = spread(world)
    return np.rint(spread(image * _like(world, image)) / _like(weights, image)).astype(np.uint8)


def _like(mask: Raster, image: Image) -> Raster:
    return mask[..., None] if image.ndim == 3 else mask


class ShakenStabilizer:
    """
    Two Stabilizers side by side, one for a clip, one for the clip with rotations injected.

    Parameters
    ----------
    clip, shaken
        Fresh Stabilizers, or what stands in for them.
    R_camera_shaken
        What to inject, one for each frame to come.
    body
        What is fixed to the camera and does not turn with the world, as ``load_mask`` takes it.

    """

    def __init__(self, clip: FrameProcessor, shaken: FrameProcessor, R_camera_shaken: Rotation,
                 body: str = '') -> None:
        self._clip = clip
        self._shaken = shaken
        self._R_camera_shaken = R_camera_shaken
        self._body = body
        self._R_world_camera: list[Rotation] = []

    def add_imu(self, sample: ImuSample) -> None:
        """Pass an ImuSample on to the clip's Stabilizer: what is injected no IMU has felt."""
        self._clip.add_imu(sample)

    def process(self, frame: Frame) -> StabilizedFrame:
        """Process a Frame twice; return the StabilizedFrame of the shaken one."""
        R_camera_shaken, image = self._R_camera_shaken[len(self._R_world_camera)], frame.image
        # Both are made grey of the same colours: a video's own luma may be another.
        clip = self._clip.process(replace(frame, source=image))
        self._R_world_camera.append(clip.R_world_camera)
        width = image.shape[1]
        # What is not seen stays black, too.
        world = common(load_mask(self._body, width),
                       None if frame.layout is None else frame.layout.seen(width))
        image = (turned(image, R_camera_shaken) if world is None else
                 turned_world(image, R_camera_shaken, world))
        return self._shaken.process(replace(frame, source=image))

    def clip_rotations(self) -> Rotation:
        """Return R_world_camera, as found in the clip itself, of the frames so far."""
        return Rotation.concatenate(self._R_world_camera)

    def true_rotations(self) -> Rotation:
        """Return R_world_shaken, as it should be found, of the frames so far."""
        return self.clip_rotations() * self._R_camera_shaken[:len(self._R_world_camera)]
