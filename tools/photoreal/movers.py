# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What moves through the room: walking people, and what is carried with the camera."""

from collections.abc import Callable
from dataclasses import dataclass

import bpy
from furniture import BLACK
from furniture import STEEL
from furniture import WHITE
import materials
from mathutils import Matrix
import numpy as np
from scipy.spatial.transform import Rotation
from shapes import Shapes

SKIN = ((0.55, 0.33, 0.22), (0.28, 0.15, 0.09), (0.62, 0.4, 0.3), (0.45, 0.27, 0.18))
HAIR = ((0.02, 0.015, 0.01), (0.12, 0.06, 0.02), (0.35, 0.22, 0.08), (0.25, 0.24, 0.23))
SHIRTS = (((0.5, 0.04, 0.04), (0.7, 0.68, 0.62)), ((0.03, 0.1, 0.35), (0.5, 0.55, 0.6)),
          ((0.05, 0.25, 0.12), (0.03, 0.06, 0.05)), ((0.6, 0.45, 0.06), (0.1, 0.08, 0.2)))
TROUSERS = ((0.03, 0.05, 0.12), (0.12, 0.1, 0.07), (0.02, 0.02, 0.025), (0.2, 0.2, 0.2))
STEP_M = 0.7


@dataclass(frozen=True)
class Mover:
    """An object whose pose in the room is a function of time: `pose(t_s)` -> 4x4 Matrix."""

    thing: bpy.types.Object
    pose: Callable[[float], Matrix]


def pose_matrix(rotation, position):
    """Return the 4x4 Matrix of a SciPy Rotation and a position (3,)."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation.as_matrix(), position
    return Matrix(matrix.tolist())


def ellipse_walk(flight, centre, radii, speed_m_s):
    """
    Walk around an ellipse: `t_s` -> (x, y, yaw, metres walked).

    It starts where the way leads past the camera at a distance of about 1.1 m.
    """
    centre, radii = np.array(centre), np.array(radii)
    rate = speed_m_s / radii.mean()

    def places(angles):
        return centre + radii * np.stack([np.cos(angles), np.sin(angles)], axis=-1)

    times = np.arange(0.0, flight.duration_s, 0.1)
    camera_xy = flight.p_mocap_camera(times)[:, :2]
    starts = np.linspace(0.0, 2.0 * np.pi, 48, endpoint=False)
    nearest = [np.linalg.norm(places(start + rate * times) - camera_xy, axis=1).min()
               for start in starts]
    start = starts[np.argmin(np.abs(np.array(nearest) - 1.1))]

    def walk(t_s):
        angle = start + rate * t_s
        dx, dy = rate * radii * np.array([-np.sin(angle), np.cos(angle)])
        return *places(angle), np.arctan2(dy, dx), abs(speed_m_s) * t_s
    return walk


def standing(x, y, yaw):
    """Stand and shift the weight a little."""
    return lambda t_s: (x + 0.02 * np.sin(1.1 * t_s), y, yaw + 0.25 * np.sin(0.7 * t_s),
                        0.04 * np.sin(0.9 * t_s))


def person(look, walk):
    """Make a person of one of four looks on a walk; return the movers."""
    skin, hair, trousers = SKIN[look % 4], HAIR[look % 4], TROUSERS[look % 4]
    cloth = materials.striped(f'shirt {look}', *SHIRTS[look % 4], (14, 7, 30, 8)[look % 4])
    matte = materials.painted(f'person {look}', 0.6, 0.1, (50.0,) * 3)

    def root(t_s):
        x, y, yaw, walked = walk(t_s)
        bob = 0.02 * np.cos(2 * np.pi * walked / STEP_M)
        return pose_matrix(Rotation.from_euler('z', yaw), (x, y, bob))

    def limb(thing, pivot, swing_rad):
        def pose(t_s):
            angle = swing_rad * np.sin(np.pi * walk(t_s)[3] / STEP_M)
            return root(t_s) @ pose_matrix(Rotation.from_euler('y', angle), pivot)
        return Mover(thing, pose)

    movers = [Mover(thing, root) for thing in _torso(Shapes(cloth), Shapes(matte), skin, hair)]
    for side in (-1, 1):
        movers.append(limb(_leg(Shapes(matte), trousers), (0, 0.09 * side, 0.93), 0.45 * side))
        for thing in _arm(Shapes(cloth), Shapes(matte), skin):
            movers.append(limb(thing, (0, 0.25 * side, 1.42), -0.4 * side))
    return movers


def _torso(shirt, matte, skin, hair):
    shirt.ellipsoid((0, 0, 1.22), (0.14, 0.21, 0.34), WHITE)
    shirt.ellipsoid((0, 0, 1.42), (0.11, 0.23, 0.11), WHITE)
    matte.ellipsoid((0, 0, 0.95), (0.14, 0.18, 0.14), (0.05, 0.06, 0.1))
    matte.cylinder((0, 0, 1.45), (0, 0, 1.58), 0.055, skin)
    matte.ellipsoid((0.015, 0, 1.67), (0.1, 0.078, 0.125), skin)
    matte.ellipsoid((-0.02, 0, 1.72), (0.105, 0.088, 0.1), hair)
    matte.ellipsoid((0.115, 0, 1.655), (0.018, 0.013, 0.022), skin, sides=8)
    for y in (-0.03, 0.03):
        matte.ellipsoid((0.105, y, 1.69), (0.012, 0.014, 0.01), BLACK, sides=8)
    return shirt.link('torso'), matte.link('head')


def _leg(matte, trousers):
    matte.cylinder((0, 0, 0), (0.01, 0, -0.45), 0.085, trousers, 0.062)
    matte.cylinder((0.01, 0, -0.45), (-0.01, 0, -0.86), 0.062, trousers, 0.05)
    matte.ellipsoid((0.05, 0, -0.89), (0.14, 0.05, 0.045), BLACK)
    return matte.link('leg')


def _arm(shirt, matte, skin):
    shirt.cylinder((0, 0, 0.03), (0, 0, -0.3), 0.055, WHITE, 0.045)
    matte.cylinder((0, 0, -0.28), (0.05, 0, -0.56), 0.036, skin, 0.03)
    matte.ellipsoid((0.06, 0, -0.62), (0.035, 0.02, 0.07), skin)
    return shirt.link('sleeve'), matte.link('forearm')


def carried(flight, build):
    """Fix shapes to the camera: `build(matte, metal)` in a frame x forward, y left, z up."""
    matte = Shapes(materials.painted('carried matte', 0.5, 0.2, (50.0,) * 3))
    metal = Shapes(materials.painted('carried metal', 0.35, metallic=0.8))
    build(matte, metal)
    optical_body = Rotation.from_matrix([[0, -1, 0], [0, 0, -1], [1, 0, 0]])

    def pose(t_s):
        return pose_matrix(flight.R_mocap_camera(t_s) * optical_body, flight.p_mocap_camera(t_s))
    return [Mover(shapes.link('carried'), pose) for shapes in (matte, metal)]


def quadrotor(matte, metal):
    """Build a small drone below the camera: mast, four arms, motors, battery."""
    metal.cylinder((0, 0, -0.03), (0, 0, -0.22), 0.009, STEEL)
    matte.box((0, 0, -0.25), (0.15, 0.085, 0.045), (0.03, 0.03, 0.035))
    matte.box((0, 0, -0.222), (0.09, 0.04, 0.015), (0.5, 0.35, 0.02))
    for x in (-1, 1):
        for y in (-1, 1):
            matte.cylinder((0.05 * x, 0.03 * y, -0.25), (0.14 * x, 0.13 * y, -0.25), 0.008, BLACK)
            metal.cylinder((0.14 * x, 0.13 * y, -0.265), (0.14 * x, 0.13 * y, -0.23), 0.013, STEEL)


def pioneer_robot(matte, metal):
    """Build a Pioneer-like robot with deck and laptop, camera on a mast 1 m above the floor."""
    metal.cylinder((0, 0, -0.1), (0, 0, -0.48), 0.009, STEEL)
    matte.box((0, 0, -0.5), (0.48, 0.4, 0.015), (0.03, 0.03, 0.035))
    matte.box((0, 0, -0.75), (0.42, 0.28, 0.22), (0.35, 0.02, 0.02))
    metal.box((-0.12, 0, -0.485), (0.2, 0.3, 0.015), (0.3, 0.3, 0.32))
    matte.box((-0.25, 0, -0.39), (0.012, 0.3, 0.2), (0.05, 0.09, 0.2),
              Rotation.from_euler('y', -0.35))
    matte.box((0.16, 0.05, -0.45), (0.09, 0.09, 0.09), (0.02, 0.05, 0.16))
    matte.box((0.12, -0.13, -0.485), (0.14, 0.05, 0.012), (0.6, 0.5, 0.05))
    for x in (-0.2, 0.2):
        for y in (-0.17, 0.17):
            metal.cylinder((x, y, -0.64), (x, y, -0.47), 0.01, STEEL)
    for x in (-0.13, 0.13):
        for y in (-0.18, 0.18):
            matte.cylinder((x, y * 0.8, -0.89), (x, y * 1.2, -0.89), 0.11, BLACK)


def hand(matte, metal):
    """Build the grip and the hand and forearm of the operator holding it."""
    metal.cylinder((0, 0, -0.06), (0, 0, -0.24), 0.009, (0.05, 0.05, 0.05))
    skin = SKIN[1]
    matte.ellipsoid((-0.012, 0, -0.15), (0.042, 0.04, 0.05), skin)
    for z in (-0.115, -0.135, -0.155, -0.175):
        matte.ellipsoid((0.02, 0.01, z), (0.018, 0.034, 0.0105), skin, sides=10)
    matte.ellipsoid((0.0, -0.03, -0.105), (0.03, 0.012, 0.012), skin, sides=10)
    matte.cylinder((-0.04, -0.015, -0.16), (-0.2, -0.1, -0.32), 0.031, skin, 0.042)
    matte.cylinder((-0.17, -0.085, -0.29), (-0.36, -0.24, -0.42), 0.055, (0.08, 0.2, 0.55), 0.065)


def operator(flight, look=1):
    """Make the operator, half a metre behind the camera, following it smoothly upright."""
    mean_times = np.linspace(-0.2, 0.2, 9)

    def walk(t_s):
        near = np.clip(t_s + mean_times, -0.24, flight.duration_s + 0.24)
        forward = flight.R_mocap_camera(near).apply([0.0, 0.0, 1.0]).mean(axis=0)
        yaw = np.arctan2(forward[1], forward[0])
        x, y = flight.p_mocap_camera(near).mean(axis=0)[:2]
        return x - 0.5 * np.cos(yaw), y - 0.5 * np.sin(yaw), yaw, 0.5 * t_s
    return person(look, walk)
