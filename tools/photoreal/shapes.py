# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""
Coloured primitives gathered into one Blender mesh per material.

Few large meshes synchronise much faster with Cycles than hundreds of small objects, and a colour
attribute per corner gives every book and every chair its own paint nevertheless.
"""

import bpy
import numpy as np


class Shapes:
    """
    Boxes, cylinders and ellipsoids of one material, in metres, z up.

    `at` places the local frame in which the following shapes are given.
    """

    def __init__(self, material):
        """Start with no shapes; all will wear the Blender `material`."""
        self._material = material
        self._vertices, self._faces, self._colours, self._smooth = [], [], [], []
        self.count = 0
        self.at(0.0, 0.0)

    def at(self, x, y, yaw_rad=0.0, z=0.0):
        """Move the local frame to (x, y, z), turned by `yaw_rad` about z; return self."""
        c, s = np.cos(yaw_rad), np.sin(yaw_rad)
        self._turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        self._offset = np.array([x, y, z])
        return self

    def _add(self, vertices, faces, colour, smooth):
        self._vertices.append(np.asarray(vertices) @ self._turn.T + self._offset)
        self._faces += [[i + self.count for i in face] for face in faces]
        self._colours += [colour] * len(faces)
        self._smooth += [smooth] * len(faces)
        self.count += len(vertices)

    def box(self, centre, size, colour, tilt=None):
        """Add a box; `tilt` is a SciPy Rotation about its centre."""
        corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
        corners = corners * np.asarray(size) / 2.0
        if tilt is not None:
            corners = tilt.apply(corners)
        faces = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4),
                 (1, 5, 7, 3)]
        self._add(corners + np.asarray(centre), faces, colour, False)

    def cylinder(self, bottom, top, radius, colour, radius_top=None, sides=20):
        """Add a capped cylinder or cone stump between two points."""
        bottom, top = np.asarray(bottom, float), np.asarray(top, float)
        axis = (top - bottom) / np.linalg.norm(top - bottom)
        u = np.cross(axis, [1.0, 0.0, 0.0] if abs(axis[0]) < 0.7 else [0.0, 1.0, 0.0])
        u /= np.linalg.norm(u)
        angle = np.arange(sides) * 2.0 * np.pi / sides
        ring = np.cos(angle)[:, None] * u + np.sin(angle)[:, None] * np.cross(axis, u)
        radius_top = radius if radius_top is None else radius_top
        vertices = np.concatenate([bottom + radius * ring, top + radius_top * ring])
        n = sides
        self._add(vertices, [(i, (i + 1) % n, n + (i + 1) % n, n + i) for i in range(n)],
                  colour, True)
        self._add(vertices, [tuple(range(n))[::-1], tuple(range(n, 2 * n))], colour, False)

    def ellipsoid(self, centre, radii, colour, tilt=None, sides=18):
        """Add an ellipsoid with semi-axes `radii`; `tilt` is a SciPy Rotation."""
        rings = sides // 2
        lat = np.linspace(-np.pi / 2, np.pi / 2, rings + 1)
        lon = np.arange(sides) * 2.0 * np.pi / sides
        lat, lon = (g.ravel() for g in np.meshgrid(lat, lon, indexing='ij'))
        vertices = np.asarray(radii) * np.stack(
            [np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)], axis=-1)
        if tilt is not None:
            vertices = tilt.apply(vertices)
        faces = [(r * sides + i, r * sides + (i + 1) % sides,
                  (r + 1) * sides + (i + 1) % sides, (r + 1) * sides + i)
                 for r in range(rings) for i in range(sides)]
        self._add(vertices + np.asarray(centre), faces, colour, True)

    def link(self, name):
        """Make the Blender object of everything added so far and return it."""
        mesh = bpy.data.meshes.new(name)
        mesh.from_pydata(np.concatenate(self._vertices).tolist(), [], self._faces)
        mesh.polygons.foreach_set('use_smooth', self._smooth)
        corners = [len(face) for face in self._faces]
        rgba = np.repeat([(*colour, 1.0) for colour in self._colours], corners, axis=0)
        attribute = mesh.color_attributes.new('paint', 'FLOAT_COLOR', 'CORNER')
        attribute.data.foreach_set('color', rgba.astype(np.float32).ravel())
        mesh.materials.append(self._material)
        thing = bpy.data.objects.new(name, mesh)
        bpy.context.scene.collection.objects.link(thing)
        return thing


def picture(name, material, corners):
    """
    Make a quadrilateral showing the material's image.

    `corners` (4, 3): lower left, lower right, upper right, upper left, as the viewer sees it.
    """
    mesh = bpy.data.meshes.new(name)
    mesh.from_pydata(np.asarray(corners, float).tolist(), [], [(0, 1, 2, 3)])
    uv = mesh.uv_layers.new(name='uv')
    uv.data.foreach_set('uv', [0, 0, 1, 0, 1, 1, 0, 1])
    mesh.materials.append(material)
    thing = bpy.data.objects.new(name, mesh)
    bpy.context.scene.collection.objects.link(thing)
    return thing
