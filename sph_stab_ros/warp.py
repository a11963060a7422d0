# Copyright 2026 The sph_stab_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
One inverse warp: a turned sphere, or a perspective view, out of an equirectangular image.

Each pixel of the target looks along a bearing; rotated into the source frame it says where to
read. Computing that for every pixel takes three times as long as reading (35 ms against 11 ms
at 1920×960), and it is smooth nearly everywhere: the map is computed on a grid and interpolated.
Where it bends too much for that, at the seam and around the poles, it is computed exactly.
"""

from functools import lru_cache

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from sph_stab_ros.equirect import bearings_from_pixels, pad_sphere, pixels_from_bearings

CELL_PX = 8
# Of the order of cv2.remap's own fixed-point step, 1/32 px.
TOLERANCE_PX = 0.1
# Bilinear reads reach one pixel beyond the image.
MARGIN_PX = 1
SECOND_DIFFERENCE = np.array(((1, -2, 1),), np.float32)


def rotate_equirect(image, R_source_target):
    """
    Return the sphere ``image`` (H, W[, C]) as a camera turned by ``R_source_target`` sees it.

    The picture of a camera with orientation ``R_world_camera`` is derotated by
    ``rotate_equirect(image, R_world_camera.inv())``.
    """
    return equirect_warp(image.shape[1])(image, R_source_target)


def perspective_view(image, R_source_view, hfov_rad, size_wh):
    """
    Return the pinhole view (h, w[, C]) of the sphere ``image`` along ``R_source_view``.

    ``hfov_rad`` is the horizontal field of view, below π; pixels are square and the principal
    point is the centre of the image.
    """
    return perspective_warp(float(hfov_rad), *size_wh)(image, R_source_view)


def view_rotation(yaw_rad=0., pitch_rad=0., roll_rad=0.):
    """Return ``R_world_view`` from yaw (left), pitch (up) and roll (clockwise as seen)."""
    return Rotation.from_euler('YXZ', (-yaw_rad, pitch_rad, roll_rad))


def focal_length_px(hfov_rad, width):
    """Return the focal length in pixels of a pinhole image ``width`` wide."""
    return width / (2 * np.tan(hfov_rad / 2))


class InverseWarp:
    """
    The inverse warp into one target image.

    Parameters
    ----------
    target_bearings : callable
        Maps pixels (..., 2) of the target, also some beyond its border, to bearings (..., 3).
    size_wh : tuple of int
        Width and height of the target in pixels.

    """

    def __init__(self, target_bearings, size_wh):
        self.target_bearings = target_bearings
        self.size_wh = size_wh
        # cv2.resize puts node j at pixel CELL_PX · (j + 0.5) − 0.5; one more node on each side
        # spares it the border.
        u, v = (CELL_PX * (np.arange(-1, -(-size // CELL_PX) + 1, dtype=np.float32) + 0.5) - 0.5
                for size in size_wh)
        self._node_bearings = target_bearings(np.stack(np.meshgrid(u, v), axis=-1))
        self._cell_corners_px = np.ceil(np.stack(np.meshgrid(u[:-1], v[:-1]), axis=-1)).astype(int)

    def __call__(self, image, R_source_target):
        """Return the target (h, w[, C]) read from the sphere ``image`` with bilinear weights."""
        map_u, map_v = self.source_pixels(R_source_target, image.shape[1])
        map_u += MARGIN_PX
        map_v += MARGIN_PX
        return cv2.remap(pad_sphere(image, MARGIN_PX), map_u, map_v, cv2.INTER_LINEAR)

    def source_pixels(self, R_source_target, source_width):
        """Return maps u, v, each (h, w) float32: the source pixel that each target pixel shows."""
        R = R_source_target.as_matrix().astype(np.float32)
        width, height = self.size_wh
        nodes = pixels_from_bearings(self._node_bearings @ R.T, source_width)
        map_u, map_v = (
            cv2.resize(nodes[..., i], None, fx=CELL_PX, fy=CELL_PX, interpolation=cv2.INTER_LINEAR)
            [CELL_PX:CELL_PX + height, CELL_PX:CELL_PX + width] for i in range(2))

        u, v = self._pixels_of(self._cells_missed(nodes, source_width))
        exact = pixels_from_bearings(
            self.target_bearings(np.stack((u, v), axis=-1).astype(np.float32)) @ R.T, source_width)
        map_u[v, u], map_v[v, u] = exact[:, 0], exact[:, 1]
        return map_u, map_v

    def _cells_missed(self, nodes, source_width):
        """
        Tell in which cells (rows, columns) interpolation may miss by more than the tolerance.

        Its error is an eighth of the second differences, of which each cell takes the largest
        of its corners'. Towards the poles the same arc spans more and more columns.
        """
        bent = sum(np.abs(cv2.filter2D(nodes, -1, kernel, borderType=cv2.BORDER_REPLICATE))
                   for kernel in (SECOND_DIFFERENCE, SECOND_DIFFERENCE.T)) / 8
        colatitude_rad = (nodes[..., 1] + 0.5) * (2 * np.pi / source_width)
        miss = np.maximum(bent[..., 0] * np.sin(colatitude_rad), bent[..., 1])
        return cv2.dilate(miss, np.ones((2, 2)), anchor=(0, 0))[:-1, :-1] > TOLERANCE_PX

    def _pixels_of(self, cells):
        """Return u, v of the target's pixels in the cells of a boolean mask."""
        width, height = self.size_wh
        corners = self._cell_corners_px[cells]
        offsets = np.arange(CELL_PX)
        u = corners[:, 0, None, None] + offsets[None, None, :] + 0 * offsets[None, :, None]
        v = corners[:, 1, None, None] + offsets[None, :, None] + 0 * offsets[None, None, :]
        inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
        return u[inside], v[inside]


@lru_cache(maxsize=8)
def equirect_warp(width):
    """Return the inverse warp into an equirectangular image (width / 2, width)."""
    return InverseWarp(lambda uv: bearings_from_pixels(uv, width), (width, width // 2))


@lru_cache(maxsize=16)
def perspective_warp(hfov_rad, width, height):
    """Return the inverse warp into a pinhole image (height, width)."""
    if not 0 < hfov_rad < np.pi:
        raise ValueError(
            f'a perspective view needs a field of view below 180°, not {np.rad2deg(hfov_rad):g}°')
    focal_px = focal_length_px(hfov_rad, width)
    centre = np.array(((width - 1) / 2, (height - 1) / 2), np.float32)

    def bearings(uv):
        xy = (uv - centre) / np.float32(focal_px)
        rays = np.concatenate((xy, np.ones_like(xy[..., :1])), axis=-1)
        return rays / np.linalg.norm(rays, axis=-1, keepdims=True)

    return InverseWarp(bearings, (width, height))
