# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Cycles materials: plain paint, procedural floors, and images drawn on the spot."""

import bpy
import cv2
import numpy as np


def _principled(name, roughness, metallic=0.0):
    material = bpy.data.materials.new(name)
    material.use_nodes = True
    shader = material.node_tree.nodes['Principled BSDF']
    shader.inputs['Roughness'].default_value = roughness
    shader.inputs['Metallic'].default_value = metallic
    return material, material.node_tree, shader


def _mix(tree, blend, factor, a, b):
    node = tree.nodes.new('ShaderNodeMixRGB')
    node.blend_type = blend
    node.inputs['Fac'].default_value = factor
    for socket, value in (('Color1', a), ('Color2', b)):
        if isinstance(value, tuple):
            node.inputs[socket].default_value = (*value, 1.0)
        else:
            tree.links.new(value, node.inputs[socket])
    return node.outputs['Color']


def _coordinates(tree, scale, turn_rad=0.0):
    source = tree.nodes.new('ShaderNodeTexCoord')
    mapping = tree.nodes.new('ShaderNodeMapping')
    mapping.inputs['Scale'].default_value = scale
    mapping.inputs['Rotation'].default_value = (0.0, 0.0, turn_rad)
    tree.links.new(source.outputs['Object'], mapping.inputs['Vector'])
    return mapping.outputs['Vector']


def _noise(tree, scale, detail=3.0):
    node = tree.nodes.new('ShaderNodeTexNoise')
    node.inputs['Scale'].default_value = 1.0
    node.inputs['Detail'].default_value = detail
    tree.links.new(_coordinates(tree, scale), node.inputs['Vector'])
    return node.outputs['Fac']


def plain(name, rgb, roughness=0.9):
    """Return one colour without any texture: a painted wall."""
    material, _, shader = _principled(name, roughness)
    shader.inputs['Base Color'].default_value = (*rgb, 1.0)
    return material


def painted(name, roughness, grain=0.0, grain_scale=(30.0, 30.0, 30.0), metallic=0.0):
    """Return the shapes' own colours, multiplied by noise of strength `grain`."""
    material, tree, shader = _principled(name, roughness, metallic)
    attribute = tree.nodes.new('ShaderNodeAttribute')
    attribute.attribute_name = 'paint'
    colour = attribute.outputs['Color']
    if grain:
        colour = _mix(tree, 'MULTIPLY', grain, colour, _noise(tree, grain_scale))
    tree.links.new(colour, shader.inputs['Base Color'])
    return material


def striped(name, rgb_a, rgb_b, bands_per_m):
    """Return cloth with horizontal stripes."""
    material, tree, shader = _principled(name, 0.9)
    wave = tree.nodes.new('ShaderNodeTexWave')
    wave.bands_direction = 'Z'
    wave.inputs['Scale'].default_value = 1.0
    wave.inputs['Distortion'].default_value = 0.6
    tree.links.new(_coordinates(tree, (bands_per_m,) * 3), wave.inputs['Vector'])
    mix = tree.nodes.new('ShaderNodeMixRGB')
    mix.inputs['Color1'].default_value = (*rgb_a, 1.0)
    mix.inputs['Color2'].default_value = (*rgb_b, 1.0)
    tree.links.new(wave.outputs['Fac'], mix.inputs['Fac'])
    tree.links.new(mix.outputs['Color'], shader.inputs['Base Color'])
    return material


def floor(name, kind, roughness=0.14):
    """Return a glossy floor, `kind` 'planks', 'tiles' or 'lino'."""
    material, tree, shader = _principled(name, roughness)
    bricks = tree.nodes.new('ShaderNodeTexBrick')
    width, height, offset, joint, a, b, dark = {
        'planks': (1.4, 0.16, 0.37, 0.004, (0.30, 0.15, 0.065), (0.42, 0.24, 0.12), 0.06),
        'tiles': (0.6, 0.6, 0.0, 0.006, (0.46, 0.44, 0.40), (0.52, 0.50, 0.47), 0.18),
        'lino': (4.0, 2.0, 0.0, 0.004, (0.22, 0.27, 0.30), (0.23, 0.28, 0.31), 0.15),
    }[kind]
    bricks.offset = offset
    for key, value in (('Scale', 1.0), ('Brick Width', width), ('Row Height', height),
                       ('Mortar Size', joint), ('Mortar Smooth', 0.1), ('Color1', (*a, 1.0)),
                       ('Color2', (*b, 1.0)), ('Mortar', (dark, dark, dark, 1.0))):
        bricks.inputs[key].default_value = value
    tree.links.new(_coordinates(tree, (1.0, 1.0, 1.0)), bricks.inputs['Vector'])
    grain = _noise(tree, (1.5, 22.0, 1.0) if kind == 'planks' else (9.0, 9.0, 9.0), 5.0)
    colour = _mix(tree, 'OVERLAY', 0.55 if kind == 'planks' else 0.2,
                  bricks.outputs['Color'], grain)
    tree.links.new(colour, shader.inputs['Base Color'])
    return material


def image(name, bgr, emission=0.0, roughness=0.6):
    """Make a material of an image, (H, W, 3) uint8, glowing when `emission` > 0."""
    height, width = bgr.shape[:2]
    texture = bpy.data.images.new(name, width, height)
    rgba = np.ones((height, width, 4), np.float32)
    rgba[..., :3] = bgr[::-1, :, ::-1] / 255.0
    texture.pixels.foreach_set(rgba.ravel())
    texture.pack()
    material, tree, shader = _principled(name, roughness)
    node = tree.nodes.new('ShaderNodeTexImage')
    node.image = texture
    tree.links.new(node.outputs['Color'], shader.inputs['Base Color'])
    if emission:
        material.cycles.emission_sampling = 'NONE'  # the room's own lamps light it
        shader.inputs['Base Color'].default_value = (0.0, 0.0, 0.0, 1.0)
        tree.links.remove(shader.inputs['Base Color'].links[0])
        tree.links.new(node.outputs['Color'], shader.inputs['Emission Color'])
        shader.inputs['Emission Strength'].default_value = emission
    return material


def glow(name, rgb, strength):
    """Return a lamp's surface."""
    material, _, shader = _principled(name, 1.0)
    material.cycles.emission_sampling = 'NONE'  # the room's own lamps light it
    shader.inputs['Base Color'].default_value = (0.0, 0.0, 0.0, 1.0)
    shader.inputs['Emission Color'].default_value = (*rgb, 1.0)
    shader.inputs['Emission Strength'].default_value = strength
    return material


def draw_poster(rng, width=360, height=500):
    """Draw a poster: a tinted ground, a few bold figures, a headline and lines of text."""
    ground = rng.integers(150, 250, 3)
    fade = np.linspace(1.0, 0.75, height)[:, None, None]
    poster = np.broadcast_to(ground * fade, (height, width, 3)).astype(np.uint8).copy()
    for _ in range(rng.integers(3, 7)):
        colour = tuple(int(c) for c in rng.integers(10, 235, 3))
        x, y = int(rng.integers(30, width - 30)), int(rng.integers(90, height - 150))
        size = int(rng.integers(20, 80))
        if rng.random() < 0.5:
            cv2.circle(poster, (x, y), size, colour, -1, cv2.LINE_AA)
        else:
            points = (rng.normal(0, size, (4, 2)) + (x, y)).astype(np.int32)
            cv2.fillConvexPoly(poster, cv2.convexHull(points), colour, cv2.LINE_AA)
    letters = 'ABCDEFGHIKLMNOPRSTUVW'
    word = ''.join(rng.choice(list(letters), rng.integers(5, 8)))
    cv2.putText(poster, word, (22, 66), cv2.FONT_HERSHEY_DUPLEX, 1.9, (20, 20, 40), 4, cv2.LINE_AA)
    for row in range(height - 130, height - 20, 18):
        end = int(rng.integers(width // 2, width - 20))
        cv2.line(poster, (22, row), (end, row), (60, 60, 60), 4)
    return poster


def draw_outdoors(rng, width=512, height=384):
    """Draw what a window shows: sky, far houses, trees; soft, as if behind bright glass."""
    sky = np.linspace(0.0, 1.0, height)[:, None, None]
    view = ((1 - sky) * (250, 215, 180) + sky * (255, 250, 245)) * np.ones((1, width, 1))
    view = view.astype(np.uint8)
    x = 0
    while x < width:
        w, top = int(rng.integers(40, 110)), int(rng.integers(height * 0.35, height * 0.65))
        shade = int(rng.integers(140, 210))
        cv2.rectangle(view, (x, top), (x + w, height), (shade, shade, shade + 10), -1)
        for wy in range(top + 14, height, 30):
            for wx in range(x + 8, x + w - 14, 24):
                cv2.rectangle(view, (wx, wy), (wx + 12, wy + 16), (shade - 60,) * 3, -1)
        x += w
    for _ in range(60):
        centre = (int(rng.integers(0, width)), int(height - rng.exponential(45)))
        green = (40, int(rng.integers(90, 150)), int(rng.integers(50, 90)))
        cv2.circle(view, centre, int(rng.integers(12, 34)), green, -1, cv2.LINE_AA)
    return cv2.GaussianBlur(view, (0, 0), 1.5)
