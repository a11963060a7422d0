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

from sph_stab_ros.equirect import bearings_from_pixels

# Larger cells have fewer nodes but larger surroundings of the poles to compute exactly: 6 is the
# fastest, or within a sixth of it, from 960 to 3840 columns.
CELL_PX = 6
# Of the order of cv2.remap's own fixed-point step, 1/32 px.
TOLERANCE_PX = 0.1
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
        self._node_bearings = np.float32(target_bearings(np.stack(np.meshgrid(u, v), axis=-1)))
        self._cell_corners_px = np.ceil(np.stack(np.meshgrid(u[:-1], v[:-1]), axis=-1))
        self._cell_offsets_px = np.float32(np.mgrid[:CELL_PX, :CELL_PX][::-1].transpose(1, 2, 0))

    def __call__(self, image, R_source_target):
        """
        Return the target (h, w[, C]) read from the sphere ``image`` with bilinear weights.

        Reads wrap around at the seam. The last half pixel before a pole, where the sphere goes
        on half a turn away, shows the outermost row: padding would cost as much as a copy.
        """
        maps = self.source_pixels(R_source_target, image.shape[1], overhang_px=0)
        return cv2.remap(image, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)

    def source_pixels(self, R_source_target, source_width, overhang_px=0.5):
        """
        Return maps u, v, each (h, w) float32: the source pixel that each target pixel shows.

        The poles lie half a pixel beyond the centres of the outermost rows; ``overhang_px`` is
        how far beyond them v may lie.
        """
        R = np.float32(R_source_target.as_matrix())
        nodes = _pixels(self._node_bearings, R, source_width, overhang_px)
        maps = [cv2.resize(one, None, fx=CELL_PX, fy=CELL_PX, interpolation=cv2.INTER_LINEAR)
                for one in nodes]
        missed = _cells_missed(*nodes, source_width)
        if missed.any():
            uv = self._cell_corners_px[missed][:, None, None] + self._cell_offsets_px
            bearings = np.float32(self.target_bearings(uv)).reshape(-1, CELL_PX, 3)
            exact = _pixels(bearings, R, source_width, overhang_px)
            for one, values in zip(maps, exact):
                self._by_cells(one)[missed] = values.reshape(-1, CELL_PX, CELL_PX)
        width, height = self.size_wh
        return [one[CELL_PX:CELL_PX + height, CELL_PX:CELL_PX + width] for one in maps]

    def _by_cells(self, upsampled):
        """Return a view (rows, columns, CELL_PX, CELL_PX) of what lies between the nodes."""
        before = CELL_PX // 2
        rows, columns = self._cell_corners_px.shape[:2]
        between = upsampled[before:before + rows * CELL_PX, before:before + columns * CELL_PX]
        return between.reshape(rows, CELL_PX, columns, CELL_PX).swapaxes(1, 2)


def _pixels(bearings, R_source_target, source_width, overhang_px):
    """
    Return u, v, each (h, w) float32, of target bearings (h, w, 3) float32 in the source.

    ``pixels_from_bearings`` in half the time: planes instead of pairs, and no BLAS, whose
    threads cost more than they help.
    """
    x, y, z = cv2.split(cv2.transform(bearings, R_source_target))
    rad_to_px = np.float32(source_width / (2 * np.pi))
    u = np.arctan2(x, z) * rad_to_px + np.float32(source_width / 2 - 0.5)
    v = np.arctan2(y, np.hypot(x, z)) * rad_to_px + np.float32(source_width / 4 - 0.5)
    return u, np.clip(v, -overhang_px, source_width / 2 - 1 + overhang_px, out=v)


def _cells_missed(u, v, source_width):
    """
    Tell in which cells (rows, columns) interpolation may miss by more than the tolerance.

    Its error is an eighth of the second differences of the nodes' u, v (rows, columns), of which
    each cell takes the largest of its corners'. Towards the poles the same arc spans more and
    more columns.
    """
    colatitude_rad = (v + np.float32(0.5)) * np.float32(2 * np.pi / source_width)
    miss_px = np.maximum(_bend(u) * np.sin(colatitude_rad), _bend(v)) / 8
    return cv2.dilate(miss_px, np.ones((2, 2)), anchor=(0, 0))[:-1, :-1] > TOLERANCE_PX


def _bend(values):
    """Return the largest second difference (rows, columns): along u, along v, or of both added."""
    along_u, along_v = (
        cv2.filter2D(values, -1, kernel, borderType=cv2.BORDER_REPLICATE)
        for kernel in (SECOND_DIFFERENCE, SECOND_DIFFERENCE.T))
    # With opposite signs, as for longitude, the two take turns within a cell.
    return np.maximum(np.maximum(abs(along_u), abs(along_v)), abs(along_u + along_v))


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
