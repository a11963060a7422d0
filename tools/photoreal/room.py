# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""
A room to furnish: plain walls, glossy floor, windows, ceiling panels.

Its box is that of the flight: x, y around zero, floor at z = 0. Walls are named by the side on
which they stand; a place on a wall is given by the distance along it from its middle.
"""

import bpy
import furniture
import materials
import numpy as np
from scipy.spatial.transform import Rotation
from shapes import picture
from shapes import Shapes

WALLS = {'south': 0.0, 'east': np.pi / 2, 'north': np.pi, 'west': -np.pi / 2}


class Room:
    """The box of a flight with bare walls; the methods furnish it."""

    def __init__(self, size_m, floor, wall_rgb, seed, bare=False):
        """Build the shell: `size_m` (x, y, z), a kind of floor, the colour of the walls."""
        self.size, self.bare, self.rng = np.array(size_m), bare, np.random.default_rng(seed)
        self.kit = {
            'matte': Shapes(materials.painted('matte', 0.7, 0.15, (60.0,) * 3)),
            'gloss': Shapes(materials.painted('gloss', 0.3)),
            'wood': Shapes(materials.painted('wood', 0.4, 0.6, (6.0, 6.0, 60.0))),
            'fabric': Shapes(materials.painted('fabric', 0.95, 0.6, (90.0,) * 3)),
            'metal': Shapes(materials.painted('metal', 0.3, metallic=0.9)),
            'leaf': Shapes(materials.painted('leaf', 0.45, 0.4, (25.0,) * 3))}
        self.paint = materials.plain('paint', wall_rgb)
        x, y, z = self.size / (2.0, 2.0, 1.0)
        picture('floor', materials.floor('floor', floor),
                [(-x, -y, 0), (x, -y, 0), (x, y, 0), (-x, y, 0)])
        picture('ceiling', materials.plain('ceiling', (0.8, 0.8, 0.79)),
                [(-x, -y, z), (-x, y, z), (x, y, z), (x, -y, z)])
        for wall in WALLS:
            length = self.length(wall)
            self.quad(wall, 0.0, z / 2, length, z, self.paint, 0.0)
            self.kit['gloss'].at(*self.place(wall, 0.0)).box(
                (0, 0.01, 0.05), (length, 0.018, 0.1), (0.62, 0.61, 0.58))

    def length(self, wall):
        """Return the length of a wall in metres."""
        return self.size[0 if wall in ('south', 'north') else 1]

    def place(self, wall, along_m, off_m=0.0):
        """Return (x, y, yaw) of a place on a wall: x along it, y into the room."""
        yaw = WALLS[wall]
        distance = (self.size[1] if wall in ('south', 'north') else self.size[0]) / 2 - off_m
        x, y = (Rotation.from_euler('z', yaw).apply((along_m, -distance, 0.0)))[:2]
        return x, y, yaw

    def quad(self, wall, along_m, height_m, width_m, tall_m, material, off_m):
        """Hang a flat picture on a wall, its centre at `height_m`."""
        x, y, yaw = self.place(wall, along_m, off_m)
        corners = np.array([(1, 0, -1), (-1, 0, -1), (-1, 0, 1), (1, 0, 1)]) / 2.0
        corners = corners * (width_m, 0.0, tall_m)
        turned = Rotation.from_euler('z', yaw).apply(corners) + (x, y, height_m)
        return picture(f'{wall} {along_m:.2f}', material, turned)

    def poster(self, wall, along_m, width_m=0.6, height_m=1.55, off_m=0.0):
        """Hang a framed poster; a bare room has none."""
        if self.bare:
            return
        tall = width_m * 1.39
        self.kit['gloss'].at(*self.place(wall, along_m, off_m)).box(
            (0, 0.008, height_m), (width_m + 0.05, 0.016, tall + 0.05), furniture.BLACK)
        name = f'poster {wall} {along_m}'
        self.quad(wall, along_m, height_m, width_m, tall,
                  materials.image(name, materials.draw_poster(self.rng)), off_m + 0.018)

    def window(self, wall, along_m, width_m=1.5, tall_m=1.4, sill_m=0.95, watt=90.0):
        """Put a bright window on a wall, a radiator below and a daylight lamp into it."""
        middle = sill_m + tall_m / 2
        view = materials.image(f'outdoors {wall} {along_m}', materials.draw_outdoors(self.rng),
                               emission=2.2)
        pane = self.quad(wall, along_m, middle, width_m, tall_m, view, 0.012)
        pane.visible_diffuse = False
        furniture.window_frame(self.kit, self.place(wall, along_m), width_m, tall_m, sill_m)
        furniture.radiator(self.kit, self.place(wall, along_m), width_m * 0.8)
        x, y, yaw = self.place(wall, along_m, 0.08)
        self.lamp(f'daylight {wall} {along_m}', (x, y, middle), (np.pi / 2, 0.0, yaw),
                  (width_m, tall_m), watt, (0.85, 0.93, 1.0))

    def ceiling_panels(self, columns, rows, watt=38.0):
        """Hang a grid of glowing panels 1.2 x 0.3 m under the ceiling."""
        shade = materials.glow('panel', (1.0, 0.96, 0.9), 6.0)
        z = self.size[2]
        for x in (np.arange(columns) + 0.5) / columns * self.size[0] - self.size[0] / 2:
            for y in (np.arange(rows) + 0.5) / rows * self.size[1] - self.size[1] / 2:
                w, d = 0.6, 0.15
                corners = [(x - w, y - d), (x - w, y + d), (x + w, y + d), (x + w, y - d)]
                quad = picture('panel', shade, [(*corner, z - 0.05) for corner in corners])
                quad.visible_diffuse = False
                self.kit['gloss'].at(x, y, z=z - 0.025).box(
                    (0, 0, 0), (2 * w + 0.06, 2 * d + 0.06, 0.045), furniture.WHITE)
                self.lamp('panel lamp', (x, y, z - 0.06), (0.0, 0.0, 0.0), (2 * w, 2 * d), watt,
                          (1.0, 0.95, 0.88))

    def lamp(self, name, position, euler, size, watt, rgb):
        """Add a rectangular lamp shining along its own -z, itself unseen."""
        data = bpy.data.lights.new(name, 'AREA')
        data.shape, (data.size, data.size_y) = 'RECTANGLE', size
        data.energy, data.color = watt, rgb
        thing = bpy.data.objects.new(name, data)
        thing.location, thing.rotation_euler = position, euler
        thing.visible_camera = thing.visible_glossy = False
        bpy.context.scene.collection.objects.link(thing)

    def block(self, centre_xy, size_xy):
        """Put up a pillar or partition to the ceiling in the walls' paint, with skirting."""
        wall = Shapes(self.paint).at(*centre_xy)
        wall.box((0, 0, self.size[2] / 2), (*size_xy, self.size[2]), furniture.WHITE)
        wall.link('block')
        self.kit['gloss'].at(*centre_xy).box(
            (0, 0, 0.05), (size_xy[0] + 0.03, size_xy[1] + 0.03, 0.1), (0.62, 0.61, 0.58))

    def finish(self):
        """Link what the kit has gathered."""
        for name, shapes in self.kit.items():
            if shapes.count:
                shapes.link(name)
