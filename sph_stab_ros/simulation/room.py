# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""A furnished box room with people walking in it: made around a flight, never in its way."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, TypeAlias

import cv2
import numpy as np

from sph_stab_ros.geometry.arrays import Bgr, Floats, Plane, Vector
from sph_stab_ros.simulation import textures
from sph_stab_ros.simulation.atlas import Atlas
from sph_stab_ros.simulation.flights import Flight

CLEARANCE_M = 0.4  # free space between the camera and whatever stands or walks in the room

HEIGHT_M = (1.6, 1.85)  # of people

# From a time, or times (N,), in seconds to where somebody's feet are, (3,) or (N, 3).
Walk: TypeAlias = Callable[[Any], Floats]
# Centres and sizes in metres.
Parts: TypeAlias = tuple[tuple[tuple[float, float, float], tuple[float, float, float]], ...]

# What is under the camera, in body coordinates: centres and sizes in metres.
ROBOT = (((-0.04, 0.0, -0.44), (0.50, 0.44, 0.05)),
         ((-0.04, 0.0, -0.82), (0.46, 0.40, 0.26)),
         ((-0.24, 0.0, -0.28), (0.03, 0.03, 0.32)),
         ((0.10, 0.08, -0.39), (0.22, 0.26, 0.05)))
# Somebody who holds the camera before the face: hand, arm, head, shoulders.
BEARER = (((-0.01, 0.0, -0.12), (0.09, 0.10, 0.12)),
          ((-0.15, -0.12, -0.26), (0.30, 0.09, 0.10)),
          ((-0.42, 0.02, -0.02), (0.20, 0.17, 0.25)),
          ((-0.42, 0.0, -0.45), (0.26, 0.46, 0.58)))
_FLOOR_SIDE, _CEILING_SIDE = 4, 5


@dataclass(frozen=True)
class Box:
    """
    A box with edges along the axes, and the number of the first of its six textures.

    Side `2 * axis + forwards` is the one seen when looking along an axis, backwards or
    forwards. `centre_m` gives the centre (3,) at a time in seconds.
    """

    size_m: Vector
    first_side: int
    centre_m: Callable[[float], Vector]


class Room:
    """
    The world of a flight: `shell` seen from inside, `boxes` in it, `robot` on the camera.

    Two of the four walls are plain; with `plain_walls` all of them are, and the ceiling.
    `texels_per_m` trades sharpness for time and memory. Positions are in the frame `mocap`, the
    robot's in the body.

    `people` stroll by themselves; each of `companions` walks on a path of its own, from times in
    seconds (...,) to where the feet are (..., 3), in conspicuous clothes.
    """

    def __init__(self, flight: Flight, seed: int = 0, furniture: int = 14, people: int = 2,
                 plain_walls: bool = False, texels_per_m: float = 200.0,
                 companions: Iterable[Walk] = (), carrier: Parts = ROBOT) -> None:
        self._rng = np.random.default_rng(seed)
        self._scale = texels_per_m
        self._textures: list[Bgr] = []
        self._size = np.array(flight.room_size_m)
        self._times_s = np.linspace(0, flight.duration_s, 2 + round(10 * flight.duration_s))
        self._path = flight.p_mocap_camera(self._times_s)
        self._occupied: list[tuple[Vector, Vector]] = []  # centres and sizes
        self._feet = [walk(self._times_s) for walk in companions]
        self.boxes = self._furniture(furniture)
        for walk in companions:
            self.boxes += self._person(self._rng.uniform(*HEIGHT_M), walk,
                                       textures.outdoor_clothing)
        for _ in range(people):
            self.boxes += self._person(self._rng.uniform(*HEIGHT_M), self._free_walk(),
                                       textures.clothing)
        self.shell = self._shell(plain_walls)
        self.robot = [self._box(np.array(size), np.array(centre), textures.machine)
                      for centre, size in carrier]
        self.atlas = Atlas(self._textures, texels_per_m)

    def _shell(self, plain_walls: bool) -> Box:
        plain = self._rng.permutation(4) < (4 if plain_walls else 2)
        centre = np.array([0.0, 0.0, self._size[2] / 2])
        lowest = centre - self._size / 2
        first_side = len(self._textures)
        for side in range(6):
            w, h = self._texels(self._size, side)
            if side == _FLOOR_SIDE:
                image = textures.tiles(self._rng, w, h, self._scale)
                image *= self._contact_shadows(w, h)
            elif side == _CEILING_SIDE:
                image = textures.ceiling(self._rng, w, h, self._scale, plain_walls)
            else:
                image = textures.wall(self._rng, w, h, self._scale, plain[side])
            image *= _corner_shade(w, h, self._scale)
            points, normal = _side_points(side, lowest, lowest + self._size, inside=True)
            # The lamps hang in the ceiling, which gets its light from the floor.
            light = np.ones((2, 2)) if side == _CEILING_SIDE else self._light(points, normal)
            self._add_texture(image, light)
        return Box(self._size, first_side, lambda t_s: centre)

    def _furniture(self, count: int) -> list[Box]:
        """Cupboards, crates and pillars along the walls, where there is space."""
        rng = self._rng
        boxes: list[Box] = []
        for _ in range(20 * count):
            kind = rng.integers(3)
            width, depth, height, paint = (
                (rng.uniform(0.8, 1.6), 0.4, rng.uniform(0.8, 2.0), textures.cupboard),
                (rng.uniform(0.3, 0.6), 0.4, rng.uniform(0.3, 0.7), textures.crate),
                (0.3, 0.3, self._size[2], textures.pillar))[kind]
            axis, forwards = rng.integers(2, size=2)
            size = np.array([width, width, height])
            size[axis] = depth
            # Pillars stand free, a step away from the wall.
            gap = rng.uniform(0.1, 0.8) if kind == 2 else 0.0
            reach = self._size / 2 - size / 2 - gap
            centre = np.array([*rng.uniform(-reach[:2], reach[:2]), height / 2])
            centre[axis] = reach[axis] if forwards else -reach[axis]
            if self._is_free(centre, size):
                self._occupied.append((centre, size))
                boxes.append(self._box(size, centre, paint, lit=True))
            if len(boxes) == count:
                break
        return boxes

    def _person(self, height: float, walk: Walk, clothing: Any) -> list[Box]:
        """Somebody of two boxes, body and head, whose feet are at `walk(t_s)` (3,)."""
        boxes = []
        for size, z, paint in (((0.42, 0.34, height - 0.25), (height - 0.25) / 2, clothing),
                               ((0.18, 0.2, 0.25), height - 0.125, textures.skin)):
            def centre_m(t_s: float, above_feet: Vector = np.array([0.0, 0.0, z])) -> Vector:
                return walk(t_s) + above_feet
            boxes.append(self._box(np.array(size), centre_m, paint))
        return boxes

    def _free_walk(self) -> Walk:
        """Path (3,) or (N, 3) over time, an ellipse that stays clear of the camera's."""
        best: Any = None
        best_clearance = -np.inf
        for _ in range(200):
            radii = self._rng.uniform(0.3, 1.2, 2)
            reach = self._size[:2] / 2 - 0.4 - radii
            middle = self._rng.uniform(-reach, reach)
            turn_rad_s = self._rng.choice([-1, 1]) * self._rng.uniform(0.5, 0.9) / radii.max()
            phase = self._rng.uniform(0, 2 * np.pi)

            def walk(t_s: Any, middle: Any = middle, radii: Any = radii,
                     turn_rad_s: Any = turn_rad_s, phase: Any = phase) -> Floats:
                angle = np.asarray(turn_rad_s * t_s + phase)
                return np.stack([middle[0] + radii[0] * np.cos(angle),
                                 middle[1] + radii[1] * np.sin(angle), 0 * angle], axis=-1)

            places = walk(self._times_s)[:, :2]
            clearance = np.linalg.norm(places - self._path[:, :2], axis=1).min() - 0.3
            for centre, size in self._occupied:
                gap = np.abs(places - centre[:2]) - size[:2] / 2 - 0.2
                clearance = min(clearance, gap.max(axis=1).min() + CLEARANCE_M)
            if clearance > best_clearance:
                best, best_clearance = walk, clearance
            if clearance >= CLEARANCE_M:
                break
        return best

    def _is_free(self, centre: Vector, size: Vector) -> bool:
        on_path = (np.abs(self._path - centre) < size / 2 + CLEARANCE_M).all(axis=1).any()
        on_path |= any((np.abs(feet - centre)[:, :2] < size[:2] / 2 + 0.3).all(axis=1).any()
                       for feet in self._feet)
        overlaps = any((np.abs(centre - c) < (size + s) / 2 + 0.02).all()
                       for c, s in self._occupied)
        return not on_path and not overlaps

    def _box(self, size: Vector, centre: Vector | Callable[[float], Vector],
             paint: textures.Paint, lit: bool = False) -> Box:
        """
        Paint the six sides of a box and return it.

        With `lit` the light of the room at its fixed place is painted on; whatever moves gets
        the same light everywhere.
        """
        first_side = len(self._textures)
        seed = self._rng.integers(2 ** 32)
        for side in range(6):
            # Every side from the same seed, so that they match.
            image = paint(np.random.default_rng(seed), *self._texels(size, side), self._scale)
            if lit and not callable(centre):
                points, normal = _side_points(side, centre - size / 2, centre + size / 2,
                                              inside=False)
                self._add_texture(image, self._light(points, normal))
            else:
                self._add_texture(image, np.full((2, 2), (0.7, 0.8, 0.85, 0.65, 1.0, 0.4)[side]))
        return Box(size, first_side, centre if callable(centre) else lambda t_s: centre)

    def _add_texture(self, image: textures.Texture, light: Plane) -> None:
        light = cv2.resize(light.astype(np.float32), image.shape[1::-1])
        self._textures.append(np.clip(image * light[..., None], 0, 255).astype(np.uint8))

    def _texels(self, size: Vector, side: int) -> tuple[int, int]:
        """Width and height of a side's texture."""
        axis = side // 2
        w, h = size[1 if axis == 0 else 0], size[1 if axis == 2 else 2]
        return max(2, round(w * self._scale)), max(2, round(h * self._scale))

    def _light(self, points: Floats, normal: Vector) -> Plane:
        """Brightness at points (h, w, 3) under four lamps: diffuse, plus ambient light."""
        brightness = np.full(points.shape[:2], 0.62)
        for x in (-0.25, 0.25):
            for y in (-0.2, 0.2):
                to_lamp = np.array([x, y, 0.98]) * self._size - points
                distance = np.linalg.norm(to_lamp, axis=-1)
                cosine = np.maximum(to_lamp @ normal / distance, 0)
                brightness += 0.45 * cosine / (1 + 0.35 * distance ** 2)
        return brightness

    def _contact_shadows(self, w: int, h: int) -> Floats:
        """Darkening (h, w, 1) of the floor around the furniture."""
        covered = np.zeros((h, w), np.float32)
        for centre, size in self._occupied:
            x0, x1 = (self._size[0] / 2 + centre[0] + np.array([-0.5, 0.5]) * size[0])
            y0, y1 = (self._size[1] / 2 - centre[1] + np.array([-0.5, 0.5]) * size[1])
            x0, x1, y0, y1 = (max(0, round(edge * self._scale)) for edge in (x0, x1, y0, y1))
            covered[y0:y1, x0:x1] = 1
        return 1 - 0.5 * cv2.GaussianBlur(covered, (0, 0), 0.12 * self._scale)[..., None]


def _side_points(
        side: int, lowest: Vector, highest: Vector, inside: bool) -> tuple[Floats, Vector]:
    """Points (24, 24, 3) of a side, laid out as its texture is, and its normal (3,)."""
    axis, forwards = divmod(side, 2)
    across, down = np.meshgrid(*2 * [(np.arange(24) + 0.5) / 24])
    u_axis, v_axis = (1 if axis == 0 else 0), (1 if axis == 2 else 2)
    if (axis, forwards) in ((0, 1), (1, 0)):
        across = 1 - across
    points = np.empty((24, 24, 3))
    points[..., axis] = (highest if forwards == inside else lowest)[axis]
    points[..., u_axis] = lowest[u_axis] + across * (highest - lowest)[u_axis]
    points[..., v_axis] = highest[v_axis] - down * (highest - lowest)[v_axis]
    normal = np.zeros(3)
    normal[axis] = -1 if forwards else 1
    return points, normal


def _corner_shade(w: int, h: int, scale: float) -> Floats:
    """Darkening (h, w, 1) towards the edges of a room's side."""
    across, down = (np.minimum(np.arange(n), n - 1 - np.arange(n)) / scale for n in (w, h))
    shade = ((1 - 0.25 * np.exp(-across / 0.2))[None] * (1 - 0.25 * np.exp(-down / 0.2))[:, None])
    return shade[..., None].astype(np.float32)
