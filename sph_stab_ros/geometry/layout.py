# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Which part of a picture is one eye's, and which part of the sphere that shows."""

from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np

from sph_stab_ros.config import EQUIRECT, HALF_SPHERE, LEFT_RIGHT, TOP_BOTTOM, VR180
from sph_stab_ros.geometry.arrays import Image, Mask

# Edges nearer to a pixel's border than that lie on it.
ON_BORDER_PX = 0.01


class Part(NamedTuple):
    """A part of a picture: where its edges are, as shares of the whole width and height."""

    left: float
    top: float
    right: float
    bottom: float

    def edges_px(self, size_wh: tuple[int, int]) -> tuple[float, float, float, float]:
        """Return left, top, right and bottom in a picture (width, height), from its own edges."""
        width, height = size_wh
        return self.left * width, self.top * height, self.right * width, self.bottom * height


WHOLE = Part(0., 0., 1., 1.)
LEFT_HALF, TOP_HALF = Part(0., 0., .5, 1.), Part(0., 0., 1., .5)
# As a part of the sphere.
FRONT = Part(.25, 0., .75, 1.)


@dataclass(frozen=True)
class Layout:
    """
    How a picture holds the sphere, of which it may show a part, or twice, for two eyes.

    The part ``used`` of the picture shows the part ``shown`` of an equirectangular sphere; where
    ``projection`` is another one, the whole picture is what that says.
    """

    used: Part
    shown: Part = WHOLE
    projection: str = EQUIRECT

    @property
    def in_sphere(self) -> 'Layout':
        """Return the Layout of what ``sphere`` returns."""
        return Layout(self.shown, self.shown)

    def sphere_wh(self, size_wh: tuple[int, int]) -> tuple[int, int]:
        """Return the size of the sphere that has no more pixels than pictures (width, height)."""
        left, top, right, bottom = self.used.edges_px(size_wh)
        across = (right - left) / (self.shown.right - self.shown.left)
        down = (bottom - top) / (self.shown.bottom - self.shown.top)
        height = round(min(across / 2, down))
        return 2 * height, height

    def sphere(self, image: Image) -> Image:
        """Return the picture (H, W[, 3]) as an equirectangular sphere, black where it has none."""
        size_wh = image.shape[1], image.shape[0]
        if self.used == self.shown and size_wh[0] == 2 * size_wh[1]:
            return image
        left, top, right, bottom = map(round, self.used.edges_px(size_wh))
        part = image[top:bottom, left:right]
        width, height = self.sphere_wh(size_wh)
        edges = self.shown.edges_px((width, height))
        sphere = np.zeros((height, width, *image.shape[2:]), image.dtype)
        left, top, right, bottom = map(round, edges)
        if np.abs(np.subtract(edges, (left, top, right, bottom))).max() < ON_BORDER_PX:
            inside = right - left, bottom - top
            sphere[top:bottom, left:right] = (
                part if inside == part.shape[1::-1]
                else cv2.resize(part, inside, interpolation=cv2.INTER_AREA))
            return sphere
        # Where a pixel's centre comes to lie.
        scale = np.divide(np.subtract(edges[2:], edges[:2]), part.shape[1::-1])
        offset = edges[:2] + scale / 2 - 0.5
        return cv2.warpAffine(part, np.column_stack((np.diag(scale), offset)), (width, height))

    def seen(self, width: int) -> Mask:
        """Return which pixels of a sphere (width / 2, width) the picture shows."""
        left, top, right, bottom = self.shown.edges_px((width, width // 2))
        u, v = np.arange(width), np.arange(width // 2)
        # With half a pixel to spare: what is read between two pixels is half black at the edge.
        return ((v >= top) & (v + 1 <= bottom))[:, None] & ((u >= left) & (u + 1 <= right))


# By the names that users choose from.
LAYOUTS = {
    TOP_BOTTOM: Layout(TOP_HALF),
    LEFT_RIGHT: Layout(LEFT_HALF),
    VR180: Layout(LEFT_HALF, FRONT),
    HALF_SPHERE: Layout(WHOLE, FRONT),
}
