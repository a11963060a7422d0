# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""One picture of each projection that there is, of a size at which a sphere is 1024 px wide."""

from dataclasses import replace

import numpy as np

from sph_stab_ros.config import (
    CropConfig, CROPPED_EQUIRECT, CUBEMAP, CubemapConfig, DUAL_FISHEYE, EQUI_ANGULAR_CUBEMAP,
    EQUISOLID, FISHEYE, FisheyeConfig, GOPRO_MAX, LensConfig, StabilizerConfig, STRETCHED_EQUIRECT)
from sph_stab_ros.geometry.projection import Equirect
from sph_stab_ros.geometry.projection_factory import projection_of

PLAIN = {'k1': 0., 'k2': 0., 'roll_deg': 0.}


def _circle(size_wh, center_uv_px, radius_px, fov_deg, model='equidistant', **lens):
    return FisheyeConfig(
        *size_wh, fov_deg=fov_deg, model=model,
        front=LensConfig(*center_uv_px, radius_px, **PLAIN | lens))


def _two_circles(size_wh, *centers_px):
    front, rear = (LensConfig(*center, 256., yaw_deg=yaw_deg, **PLAIN)
                   for center, yaw_deg in zip(centers_px, (0, 180)))
    return FisheyeConfig(*size_wh, fov_deg=200., front=front, rear=rear)


def _config(projection, **options):
    return StabilizerConfig(projection=projection, **options)


# By name: the size of the picture, and the config.
PICTURES = {
    'stretched 16:9': ((1280, 720), _config(STRETCHED_EQUIRECT)),
    'around, poles cut': ((1024, 300), _config(
        CROPPED_EQUIRECT, crop=CropConfig(1024, 512, 0, 100, 1024, 300))),
    'part, over the seam': ((500, 380), _config(
        CROPPED_EQUIRECT, crop=CropConfig(1024, 512, 700, 0, 500, 380))),
    'front half (VR180)': ((512, 512), _config(
        CROPPED_EQUIRECT, crop=CropConfig(left=.25, width=.5))),
    'cube 3x2': ((768, 512), _config(CUBEMAP)),
    'cube 6x1': ((1536, 256), _config(CUBEMAP)),
    'cube 1x6': ((256, 1536), _config(CUBEMAP)),
    'cube 4x3': ((1024, 768), _config(CUBEMAP)),
    'cube, other order': ((768, 512), _config(
        CUBEMAP, cubemap=CubemapConfig('lrfbdu', '012301'))),
    'equi-angular': ((780, 520), _config(EQUI_ANGULAR_CUBEMAP)),
    'equi-angular 16:9': ((1280, 720), _config(EQUI_ANGULAR_CUBEMAP)),
    'GoPro Max 5.6K': ((780, 512), _config(GOPRO_MAX)),
    'GoPro Max 3K': ((790, 512), _config(GOPRO_MAX)),
    'fisheye 180': ((560, 540), _config(
        FISHEYE, fisheye=_circle((560, 540), (281.3, 268.9), 256., 180.))),
    'fisheye 280': ((812, 812), _config(
        FISHEYE, fisheye=_circle((812, 812), (405.5, 405.5), 256., 280., yaw_deg=30.))),
    'equisolid 200, cut': ((600, 480), _config(
        FISHEYE, fisheye=_circle((600, 480), (299.5, 239.5), 256., 200., EQUISOLID))),
    'polynomial 220': ((640, 600), _config(FISHEYE, fisheye=_circle(
        (640, 600), (318., 301.), 256., 220., k1=0.03, k2=-0.01, k3=0.004, k4=-0.0006,
        aspect=0.96))),
    'side by side': ((1140, 570), _config(DUAL_FISHEYE, fisheye=_two_circles(
        (1140, 570), (284.5, 284.5), (854.5, 284.5)))),
    'near at the border': ((1140, 570), _config(DUAL_FISHEYE, fisheye=replace(_two_circles(
        (1140, 570), (284.5, 284.5), (854.5, 284.5)), baseline_m=.06, seam_distance_m=1.))),
    'one above the other': ((570, 1140), _config(DUAL_FISHEYE, fisheye=_two_circles(
        (570, 1140), (284.5, 284.5), (284.5, 854.5)))),
}


def projection_named(name):
    """Return the Projection of a picture in PICTURES."""
    return projection_of(*PICTURES[name])


def pixel_grid(size_wh):
    """Return the pixels (h, w, 2) of a picture (width, height)."""
    return np.stack(np.meshgrid(*map(np.arange, size_wh)), axis=-1).astype(float)


def picture_of(projection, sphere, R_world_camera=None):
    """Return what a camera of a projection sees of a sphere (H, W[, C]); black around."""
    xyz, shown = projection.bearings(pixel_grid(projection.size_wh))
    if R_world_camera is not None:
        xyz = xyz @ R_world_camera.as_matrix().T
    picture = Equirect(sphere.shape[1]).read(
        sphere, *np.ascontiguousarray(np.moveaxis(xyz, -1, 0), np.float32))
    picture[~shown] = 0
    return picture
