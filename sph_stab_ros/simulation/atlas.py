# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Many textures at all their resolutions in one picture, so that one remap reads them all."""

from collections.abc import Sequence

import cv2
import numpy as np

from sph_stab_ros.geometry.arrays import Bgr, Plane, Raster

_WIDTH = 4096  # cv2.remap addresses less than 32768 in either direction
_LEVELS = 7


class Atlas:
    """
    Mip-mapped textures, read with trilinear interpolation.

    `textures` all have `texels_per_m` texels per metre.
    """

    def __init__(self, textures: Sequence[Bgr], texels_per_m: float) -> None:
        self._texels_per_m = texels_per_m
        pyramids = [_pyramid(texture) for texture in textures]
        levels = [level for pyramid in pyramids for level in pyramid]
        corners, height = _pack([level.shape[:2] for level in levels])
        self._image = np.zeros((height, _WIDTH, 3), np.uint8)
        for level, (x, y) in zip(levels, corners):
            h, w = level.shape[:2]
            # A border of one texel, or neighbours in the atlas would bleed in.
            self._image[y:y + h + 2, x:x + w + 2] = cv2.copyMakeBorder(
                level, 1, 1, 1, 1, cv2.BORDER_REPLICATE)
        sizes = np.array([level.shape[1::-1] for level in levels], np.float32)
        full = np.repeat([pyramid[0].shape[1::-1] for pyramid in pyramids], _LEVELS, axis=0)
        self._offset = (np.array(corners, np.float32) + 0.5).T.copy()
        self._scale = (sizes / full * texels_per_m).astype(np.float32).T.copy()
        self._limit = (np.array(corners, np.float32) + 0.5 + sizes).T.copy()

    def sample(self, texture: Raster, x_m: Plane, y_m: Plane, footprint_m: Plane) -> Bgr:
        """
        Colours (h, w, 3) of pixels that look at `x_m`, `y_m` from a texture's top left corner.

        All arguments are (h, w); `footprint_m` is the width of what the pixel covers.
        """
        detail = np.log2(np.maximum(footprint_m * np.float32(self._texels_per_m), 1))
        detail = np.minimum(detail, np.float32(_LEVELS - 1.001))
        level = detail.astype(np.int32)
        coarser = detail - level.astype(np.float32)
        index = texture * _LEVELS + level
        return cv2.blendLinear(self._read(index, x_m, y_m), self._read(index + 1, x_m, y_m),
                               1 - coarser, coarser)

    def _read(self, index: Raster, x_m: Plane, y_m: Plane) -> Bgr:
        u, v = (np.minimum(offset.take(index) + m * scale.take(index), limit.take(index))
                for offset, scale, limit, m in zip(self._offset, self._scale, self._limit,
                                                   (x_m, y_m)))
        return cv2.remap(self._image, u, v, cv2.INTER_LINEAR)


def _pyramid(texture: Bgr) -> list[Bgr]:
    h, w = texture.shape[:2]
    return [cv2.resize(texture, (max(1, w >> level), max(1, h >> level)),
                       interpolation=cv2.INTER_AREA) for level in range(_LEVELS)]


def _pack(shapes: Sequence[tuple[int, ...]]) -> tuple[list[tuple[int, int]], int]:
    """Top left corners (x, y) of rectangles (h, w) with a border of one, and the height used."""
    corners = [(0, 0)] * len(shapes)
    x = y = shelf = 0
    for i in sorted(range(len(shapes)), key=lambda i: -shapes[i][0]):
        h, w = (side + 2 for side in shapes[i])
        if x + w > _WIDTH:
            x, y, shelf = 0, y + shelf, 0
        corners[i] = (x, y)
        x, shelf = x + w, max(shelf, h)
    return corners, y + shelf
