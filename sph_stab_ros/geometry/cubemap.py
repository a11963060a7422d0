# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The six faces of a cube in one picture: plain, or at equal angles."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from sph_stab_ros.geometry.arrays import Bearings, Faces, Floats, Mask, Pixels, Plane
from sph_stab_ros.geometry.pixel_map import PixelMap

# Where each face's columns, rows and depths grow to, by the letters that FFmpeg's v360 has for
# them: with no turn a face stands upright, and above and below are as seen after a nod from the
# front.
FACES = {
    'r': ((0, 0, -1), (0, 1, 0), (1, 0, 0)), 'l': ((0, 0, 1), (0, 1, 0), (-1, 0, 0)),
    'u': ((1, 0, 0), (0, 0, 1), (0, -1, 0)), 'd': ((1, 0, 0), (0, 0, -1), (0, 1, 0)),
    'f': ((1, 0, 0), (0, 1, 0), (0, 0, 1)), 'b': ((-1, 0, 0), (0, 1, 0), (0, 0, -1))}
# How far a picture's aspect may be from that of six square faces.
ASPECT_TOLERANCE = 0.02


@dataclass(frozen=True)
class FaceLayout:
    """Where the faces are: columns and rows of the picture, its places in the order of faces."""

    columns: int
    rows: int
    places: tuple[tuple[int, int], ...]
    order: str = 'rludfb'
    # Of each face, in quarters clockwise.
    turns: str = '000000'


def _grid(columns: int, rows: int, order: str = 'rludfb', turns: str = '000000') -> FaceLayout:
    places = tuple((place % columns, place // columns) for place in range(6))
    return FaceLayout(columns, rows, places, order, turns)


CUBEMAPS = (
    _grid(3, 2), _grid(6, 1), _grid(1, 6),
    FaceLayout(4, 3, ((1, 0), (0, 1), (1, 1), (2, 1), (3, 1), (1, 2)), 'ulfrbd'))
# Of YouTube: a band of left, front and right, and one of below, behind and above, on their sides.
EQUI_ANGULAR = _grid(3, 2, 'lfrdbu', '000313')
# Of YouTube's, at the outer edges of the bands, as FFmpeg's v360 found them.
EQUI_ANGULAR_PADDING_PX = 2.


@dataclass(frozen=True)
class Cubemap(PixelMap):
    """
    The Projection of a picture of six faces of a cube around the camera.

    Those of an equi-angular one have equal angles between their pixels, and ``padding_uv_px`` more
    at the left and right of the picture and at the top and bottom of each row of faces.
    """

    size_wh: tuple[int, int]
    layout: FaceLayout
    equi_angular: bool = False
    padding_uv_px: tuple[float, float] = (0., 0.)

    @property
    def sphere_width(self) -> int:
        """Width of a sphere with as many pixels around, at most those of the faces' middle."""
        return 4 * round(min(self._face_wh))

    def pixels(self, x: Plane, y: Plane, z: Plane) -> tuple[Plane, Plane, Faces]:
        """Return u, v of bearings and their faces; all are on one."""
        axes, corners = faces(self.layout)
        along = np.tensordot(axes, np.stack((x, y, z)).astype(np.float32), axes=1)
        face = along[:, 2].argmax(axis=0)
        right, down, depth = (
            np.take_along_axis(along[:, i], face[None], axis=0)[0] for i in range(3))
        pixels: list[Plane] = []
        for i, offset in enumerate((right, down)):
            across = offset / depth
            if self.equi_angular:
                across = np.arctan(across) * np.float32(4 / np.pi)
            size, starts = self._face_wh[i], self._starts(i, corners)
            pixel = (across + 1) * np.float32(size / 2) + (starts - np.float32(0.5))[face]
            if self.equi_angular and i == 0:
                # The faces of a band go on in each other.
                starts, size = starts * 0 + starts.min(), size * self.layout.columns
            pixels.append(np.clip(pixel, starts[face], (starts + np.float32(size - 1))[face]))
        return pixels[0], pixels[1], face.astype(np.uint8)

    def bearings(self, uv: Pixels) -> tuple[Bearings, Mask]:
        """Return where pixels look, and which lie on a face."""
        axes, corners = faces(self.layout)
        # Of places without a face: ahead.
        xyz = np.tile((0., 0., 1.), (*uv.shape[:-1], 1))
        shown = np.zeros(uv.shape[:-1], bool)
        width, height = self._face_wh
        column = (uv[..., 0] + 0.5 - self.padding_uv_px[0]) // width
        row = (uv[..., 1] + 0.5) // (height + 2 * self.padding_uv_px[1])
        for face, place in enumerate(corners):
            # Of what is beside the bands the nearest face.
            mine = (np.clip(column, 0, self.layout.columns - 1) == place[0]) & (row == place[1])
            start = np.array([self._starts(i, corners)[face] for i in range(2)])
            across = (uv[mine] + 0.5 - start) * 2 / self._face_wh - 1
            if self.equi_angular:
                across = np.tan(across * (np.pi / 4))
            rays = np.append(across, np.ones((len(across), 1)), axis=1) @ axes[face]
            xyz[mine] = rays / np.linalg.norm(rays, axis=1, keepdims=True)
            shown |= mine
        return xyz, shown

    def resized(self, size_wh: tuple[int, int]) -> 'Cubemap':
        """Return the projection of the picture at another size."""
        padding = [one * new / old
                   for one, new, old in zip(self.padding_uv_px, size_wh, self.size_wh)]
        return Cubemap(size_wh, self.layout, self.equi_angular, (padding[0], padding[1]))

    @property
    def _face_wh(self) -> tuple[float, float]:
        width, height = self.size_wh
        return ((width - 2 * self.padding_uv_px[0]) / self.layout.columns,
                height / self.layout.rows - 2 * self.padding_uv_px[1])

    def _starts(self, axis: int, corners: Floats) -> Floats:
        """Return the left (axis 0) or top edges (axis 1) of the faces (6,) in pixels."""
        padding = self.padding_uv_px[axis]
        pitch = self._face_wh[axis] + (2 * padding if axis else 0)
        return (corners[:, axis] * pitch + padding).astype(np.float32)


@lru_cache(maxsize=8)
def faces(layout: FaceLayout) -> tuple[Floats, Floats]:
    """Return where columns, rows and depth of each face grow to (6, 3, 3), and places (6, 2)."""
    axes = []
    for letter, turns in zip(layout.order, layout.turns):
        right, down, depth = np.array(FACES[letter])
        for _ in range(int(turns)):
            right, down = -down, right
        axes.append((right, down, depth))
    return np.array(axes, np.float32), np.array(layout.places, np.float32)


def cubemap(order: str, turns: str, size_wh: tuple[int, int]) -> Cubemap | None:
    """
    Return the Cubemap of pictures (width, height), None where six square faces make none such.

    ``order`` and ``turns`` are those of the faces in the picture, where they are not empty.
    """
    width, height = size_wh
    for layout in CUBEMAPS:
        expected_width = height * layout.columns / layout.rows
        if abs(width - expected_width) < ASPECT_TOLERANCE * expected_width:
            return Cubemap(size_wh, FaceLayout(
                layout.columns, layout.rows, layout.places, order or layout.order,
                turns or layout.turns))
    return None


def equi_angular_cubemap(size_wh: tuple[int, int]) -> Cubemap:
    """Return the Cubemap of YouTube's pictures (width, height)."""
    return Cubemap(size_wh, EQUI_ANGULAR, True, (EQUI_ANGULAR_PADDING_PX,) * 2)
