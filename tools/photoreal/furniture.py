# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""
Furniture from coloured primitives.

Every piece takes the kit (a dict of `Shapes` by material name), a place (x, y, yaw) and builds in
the local frame x along the wall, y into the room, z up.
"""

import numpy as np
from scipy.spatial.transform import Rotation

WHITE, BLACK, STEEL = (0.8, 0.8, 0.78), (0.02, 0.02, 0.02), (0.45, 0.46, 0.48)
OAK, WALNUT, CARD = (0.42, 0.25, 0.12), (0.16, 0.08, 0.04), (0.42, 0.28, 0.15)


def _at(kit, place, *names):
    return [kit[name].at(*place) for name in names]


def shelf(kit, place, rng, width=1.2, height=2.0, depth=0.32, colour=OAK):
    """Build a bookcase with four to six boards full of books and boxes."""
    wood, matte = _at(kit, place, 'wood', 'matte')
    for x in (-width / 2, width / 2):
        wood.box((x, depth / 2, height / 2), (0.025, depth, height), colour)
    wood.box((0, 0.01, height / 2), (width, 0.012, height), colour)
    boards = np.linspace(0.08, height - 0.02, int(height / 0.36) + 1)
    for z in boards:
        wood.box((0, depth / 2, z), (width, depth, 0.025), colour)
    for z, space in zip(boards[:-1], np.diff(boards)):
        x = -width / 2 + 0.04
        while x < width / 2 - 0.1:
            if rng.random() < 0.1:
                w, h = rng.uniform(0.15, 0.25), rng.uniform(0.15, 0.25)
                if x + w < width / 2:
                    matte.box((x + w / 2, depth / 2, z + 0.013 + h / 2), (w, 0.22, h), CARD)
                x += w + 0.03
                continue
            w, h = rng.uniform(0.018, 0.055), space * rng.uniform(0.55, 0.88)
            hue = rng.uniform(0.02, 0.55, 3) * rng.uniform(0.2, 1.0)
            d = rng.uniform(0.16, 0.24)
            matte.box((x + w / 2, d / 2 + 0.03, z + 0.013 + h / 2), (w, d, h), tuple(hue))
            if rng.random() < 0.6:
                matte.box((x + w / 2, d + 0.031, z + h * rng.uniform(0.4, 0.8)),
                          (w * 0.7, 0.003, 0.035), (0.75, 0.7, 0.55))
            x += w + (0.002 if rng.random() < 0.9 else rng.uniform(0.05, 0.2))


def table(kit, place, rng, width=1.6, depth=0.8, colour=OAK):
    """Build a table with a laptop, papers and a mug on it."""
    wood, metal, matte = _at(kit, place, 'wood', 'metal', 'matte')
    wood.box((0, 0, 0.73), (width, depth, 0.035), colour)
    for x in (-width / 2 + 0.06, width / 2 - 0.06):
        for y in (-depth / 2 + 0.06, depth / 2 - 0.06):
            metal.cylinder((x, y, 0), (x, y, 0.72), 0.025, STEEL)
    for _ in range(6):
        turn = Rotation.from_euler('z', rng.uniform(-1, 1))
        x, y = rng.uniform(-0.42, 0.42) * width, rng.uniform(-0.35, 0.35) * depth
        matte.box((x, y, 0.751), (0.21, 0.297, 0.003 + 0.02 * rng.random()), WHITE, turn)
    x = rng.uniform(-0.3, 0.3) * width
    metal.box((x, 0, 0.757), (0.34, 0.24, 0.015), (0.3, 0.3, 0.32))
    metal.box((x, 0.15, 0.86), (0.34, 0.012, 0.22), (0.08, 0.1, 0.16),
              Rotation.from_euler('x', -0.3))
    matte.cylinder((x + 0.32, 0.1, 0.748), (x + 0.32, 0.1, 0.85), 0.04,
                   tuple(rng.uniform(0.05, 0.7, 3)))


def chair(kit, place, colour):
    """Build a chair with four legs, a padded seat and a back at negative y."""
    metal, fabric = _at(kit, place, 'metal', 'fabric')
    fabric.box((0, 0, 0.46), (0.44, 0.44, 0.06), colour)
    fabric.box((0, -0.22, 0.78), (0.42, 0.04, 0.36), colour, Rotation.from_euler('x', 0.15))
    for x in (-0.19, 0.19):
        metal.cylinder((x, -0.2, 0), (x, -0.22, 0.62), 0.013, BLACK)
        metal.cylinder((x, 0.2, 0), (x, 0.19, 0.44), 0.013, BLACK)


def sofa(kit, place, colour):
    """Build a two-seat sofa with cushions, its back at y = 0."""
    fabric, = _at(kit, place, 'fabric')
    fabric.box((0, 0.45, 0.22), (1.9, 0.85, 0.3), colour)
    fabric.box((0, 0.1, 0.55), (1.9, 0.2, 0.5), colour)
    for x in (-0.88, 0.88):
        fabric.box((x, 0.45, 0.42), (0.16, 0.85, 0.36), colour)
    for x, tint in ((-0.45, (0.6, 0.42, 0.1)), (0.4, (0.08, 0.25, 0.3))):
        fabric.ellipsoid((x, 0.33, 0.55), (0.23, 0.09, 0.2), tint,
                         Rotation.from_euler('x', 0.35))


def cartons(kit, place, rng, count=5):
    """Build a pile of cardboard boxes with tape and labels."""
    matte, = _at(kit, place, 'matte')
    z, x = 0.0, 0.0
    for i in range(count):
        size = rng.uniform((0.3, 0.25, 0.2), (0.55, 0.45, 0.4))
        if i % 3 == 0 and i:
            z, x = 0.0, x + 0.65
        turn = Rotation.from_euler('z', rng.uniform(-0.25, 0.25))
        centre = np.array((x, 0.32, z + size[2] / 2))
        shade = rng.uniform(0.8, 1.2)
        matte.box(centre, size, tuple(np.array(CARD) * shade), turn)
        matte.box(centre, size * (1.003, 0.12, 1.003), (0.62, 0.5, 0.32), turn)
        label = centre + turn.apply((0.1, size[1] / 2, 0.02))
        matte.box(label, (0.12, 0.004, 0.08), WHITE, turn)
        z += size[2]


def plant(kit, place, rng, height=1.3):
    """Build a potted plant with some sixty leaves."""
    matte, leaf = _at(kit, place, 'matte', 'leaf')
    matte.cylinder((0, 0, 0), (0, 0, 0.32), 0.13, (0.5, 0.2, 0.1), 0.18)
    matte.cylinder((0, 0, 0.3), (0, 0, height * 0.8), 0.015, (0.12, 0.07, 0.03))
    for _ in range(60):
        angle, z = rng.uniform(0, 2 * np.pi), rng.uniform(0.4, 1.0) * height
        turn = Rotation.from_euler('zyx', (angle, rng.uniform(-0.7, 0.9), rng.uniform(-0.5, 0.5)))
        tip = turn.apply((rng.uniform(0.12, 0.3), 0, 0)) + (0, 0, z)
        green = rng.uniform(0.5, 1.0) * np.array((0.05, 0.22, 0.04))
        leaf.ellipsoid(tip, (0.13, 0.045, 0.006), tuple(green), turn, sides=8)


def radiator(kit, place, width=1.2):
    """Build a ribbed radiator under a window."""
    gloss, = _at(kit, place, 'gloss')
    for x in np.arange(-width / 2, width / 2, 0.07):
        gloss.box((x, 0.09, 0.42), (0.05, 0.08, 0.56), WHITE)
    for z in (0.18, 0.66):
        gloss.cylinder((-width / 2, 0.09, z), (width / 2, 0.09, z), 0.02, WHITE)


def door(kit, place, colour, width=0.92, height=2.05):
    """Build a door with frame, panels, handle and a sign."""
    gloss, wood, metal, matte = _at(kit, place, 'gloss', 'wood', 'metal', 'matte')
    for x in (-width / 2 - 0.04, width / 2 + 0.04):
        gloss.box((x, 0.02, height / 2), (0.08, 0.07, height), WHITE)
    gloss.box((0, 0.02, height + 0.04), (width + 0.16, 0.07, 0.08), WHITE)
    wood.box((0, 0.01, height / 2), (width, 0.035, height), colour)
    for z, h in ((0.55, 0.7), (1.45, 0.85)):
        wood.box((0, 0.03, z), (width * 0.68, 0.012, h), tuple(np.array(colour) * 0.8))
    metal.cylinder((0.36, 0.03, 1.02), (0.36, 0.09, 1.02), 0.012, STEEL)
    metal.cylinder((0.36, 0.085, 1.02), (0.24, 0.085, 1.02), 0.011, STEEL)
    metal.box((0.36, 0.031, 1.0), (0.05, 0.006, 0.2), STEEL)
    matte.box((0.0, 0.04, 1.62), (0.24, 0.006, 0.09), (0.05, 0.12, 0.3))


def window_frame(kit, place, width, height, sill):
    """Build the frame, bars and sill around a pane whose lower edge is at `sill`."""
    gloss, = _at(kit, place, 'gloss')
    for x in (-width / 2, 0.0, width / 2):
        gloss.box((x, 0.03, sill + height / 2), (0.06, 0.06, height), WHITE)
    for z in (sill, sill + height * 0.72, sill + height):
        gloss.box((0, 0.03, z), (width + 0.06, 0.06, 0.06), WHITE)
    gloss.box((0, 0.1, sill - 0.04), (width + 0.2, 0.22, 0.035), WHITE)


def fittings(kit, place):
    """Build light switch, socket, smoke-detector-like bell and a wall clock's rim."""
    gloss, = _at(kit, place, 'gloss')
    gloss.box((0, 0.008, 1.1), (0.085, 0.014, 0.085), (0.7, 0.7, 0.68))
    gloss.box((0, 0.018, 1.1), (0.05, 0.01, 0.055), WHITE)
    gloss.box((0.0, 0.008, 0.3), (0.16, 0.014, 0.085), (0.7, 0.7, 0.68))
    for x in (-0.04, 0.04):
        gloss.cylinder((x, 0.014, 0.3), (x, 0.018, 0.3), 0.022, (0.2, 0.2, 0.2))


def clock(kit, place, z=2.2):
    """Build a wall clock."""
    gloss, = _at(kit, place, 'gloss')
    gloss.cylinder((0, 0.0, z), (0, 0.035, z), 0.17, BLACK, sides=32)
    gloss.cylinder((0, 0.03, z), (0, 0.037, z), 0.15, WHITE, sides=32)
    for hour in range(12):
        turn = Rotation.from_euler('y', hour * 30, degrees=True)
        gloss.box(turn.apply((0, 0, 0.125)) + (0, 0.038, z), (0.012, 0.004, 0.03), BLACK, turn)
    for angle, length in ((50, 0.1), (-70, 0.07)):
        turn = Rotation.from_euler('y', angle, degrees=True)
        gloss.box(turn.apply((0, 0, length / 2)) + (0, 0.039, z), (0.012, 0.004, length),
                  BLACK, turn)
