# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""
The rooms of the recordings: a lab for the drone, a lobby for the robot, an office for walking.

All are largely plain: texture comes from what stands at the walls, as indoors it does. A bare room
has walls, windows, doors and lamps, but neither furniture nor posters.
"""

import furniture
import movers
import numpy as np
from room import Room


def laboratory(flight, bare=False):
    """Furnish the drone's room; return the movers."""
    room = Room(flight.room_size_m, 'planks', (0.74, 0.72, 0.67), seed=1, bare=bare)
    room.ceiling_panels(3, 2)
    kit, rng = room.kit, room.rng
    room.window('east', 1.2)
    room.window('east', -1.1)
    furniture.door(kit, room.place('south', -2.6), (0.5, 0.42, 0.32))
    furniture.fittings(kit, room.place('south', -1.8))
    furniture.clock(kit, room.place('south', -1.2))
    if not bare:
        furniture.shelf(kit, room.place('north', 2.9), rng, 1.4)
        furniture.shelf(kit, room.place('west', -1.9), rng, 1.2, 1.5, colour=furniture.WALNUT)
        furniture.plant(kit, room.place('north', -3.4, 0.45), rng, 1.5)
        furniture.table(kit, room.place('north', 0.2, 0.5), rng)
        furniture.chair(kit, (-0.5, 2.0, 0.3), (0.3, 0.05, 0.05))
        furniture.sofa(kit, room.place('west', 1.1), (0.12, 0.17, 0.22))
        furniture.table(kit, (-0.2, -0.2, 0.5), rng, 1.8, 0.9, furniture.WALNUT)
        for x, y, yaw in ((0.2, -0.95, 0.3), (-0.7, 0.45, 3.5), (0.6, 0.45, 3.2)):
            furniture.chair(kit, (x, y, yaw), (0.05, 0.12, 0.25))
        furniture.cartons(kit, room.place('south', 2.6), rng)
    furniture.fittings(kit, room.place('north', -1.6))
    room.poster('north', -1.1, 0.55)
    room.poster('south', 0.6, 0.7)
    room.poster('west', 1.2, 0.6, 1.65)
    room.finish()
    people = movers.person(0, movers.standing(3.1, -2.2, 2.3))
    return people + movers.carried(flight, movers.quadrotor)


def lobby(flight, bare=False):
    """Furnish the robot's hall, narrowed to corridors by partitions; return the movers."""
    room = Room(flight.room_size_m, 'lino', (0.66, 0.7, 0.7), seed=2, bare=bare)
    room.ceiling_panels(4, 2, 32.0)
    kit, rng = room.kit, room.rng
    room.block((-2.5, 1.35), (4.0, 0.14))
    room.block((2.9, -1.9), (3.2, 0.14))
    room.block((1.1, 1.3), (0.4, 0.4))
    room.window('north', -0.6)
    room.window('east', -0.2)
    for along, wall in ((0.6, 'west'), (-2.8, 'south'), (-2.6, 'north')):
        furniture.door(kit, room.place(wall, along), (0.16, 0.24, 0.34))
    furniture.door(kit, (-3.2, 1.28, np.pi), (0.16, 0.24, 0.34))
    furniture.fittings(kit, room.place('west', -0.4))
    furniture.fittings(kit, (2.6, -1.83, 0.0))
    furniture.clock(kit, room.place('south', -0.9))
    if not bare:
        furniture.sofa(kit, room.place('south', -0.6), (0.3, 0.1, 0.06))
        furniture.plant(kit, room.place('east', 2.4, 0.5), rng, 1.7)
        furniture.plant(kit, room.place('south', 0.85, 0.4), rng)
        furniture.shelf(kit, room.place('north', -3.9), rng, 1.1, 1.2)
        furniture.cartons(kit, (-1.2, 1.26, np.pi), rng, 4)
        furniture.chair(kit, (3.9, -1.4, 0.0), (0.4, 0.2, 0.02))
        furniture.chair(kit, (3.3, -1.45, 0.1), (0.4, 0.2, 0.02))
    room.poster('west', -1.7, 0.7)
    room.poster('south', -1.9, 0.6)
    room.poster('east', 1.5, 0.5)
    room.finish()
    return movers.carried(flight, movers.pioneer_robot)


def office(flight, bare=False):
    """Furnish the room of the walk, people all around the camera; return the movers."""
    room = Room(flight.room_size_m, 'tiles', (0.76, 0.74, 0.72), seed=3, bare=bare)
    room.ceiling_panels(3, 2)
    kit, rng = room.kit, room.rng
    room.window('north', -1.9, 1.8)
    room.window('north', 1.3, 1.8)
    furniture.door(kit, room.place('west', 1.6), (0.5, 0.42, 0.32))
    furniture.fittings(kit, room.place('west', 0.7))
    furniture.clock(kit, room.place('west', 0.3))
    if not bare:
        furniture.shelf(kit, room.place('east', -1.6), rng, 1.6)
        furniture.shelf(kit, room.place('west', -1.8), rng, 1.2, 1.7, colour=furniture.WALNUT)
        furniture.table(kit, room.place('south', -2.2, 0.5), rng)
        furniture.table(kit, room.place('east', 1.3, 0.5), rng)
        furniture.chair(kit, (-2.3, -2.05, 3.0), (0.05, 0.25, 0.12))
        furniture.chair(kit, (2.8, 1.2, 1.3), (0.05, 0.25, 0.12))
        furniture.plant(kit, room.place('south', 3.5, 0.45), rng, 1.6)
        furniture.cartons(kit, room.place('south', 0.9), rng)
    room.poster('south', -0.6, 0.7)
    room.poster('east', 0.2, 0.6)
    room.poster('west', -0.7, 0.5)
    room.finish()
    walks = [movers.ellipse_walk(flight, (0.3, 0.0), (2.2, 1.9), 1.1),
             movers.ellipse_walk(flight, (0.0, 0.1), (2.7, 2.1), 0.75),
             movers.ellipse_walk(flight, (-0.4, -0.6), (1.2, 1.0), 0.6),
             movers.standing(3.0, -2.1, 2.6)]
    people = [mover for look, walk in enumerate(walks)
              for mover in movers.person(look, walk)]
    return people + movers.operator(flight) + movers.carried(flight, movers.hand)


def walkers(flight, number):
    """Make up to two people who walk around in the laboratory; return the movers."""
    walks = [movers.ellipse_walk(flight, (0.2, 0.0), (2.6, 1.7), 1.1),
             movers.ellipse_walk(flight, (0.2, 0.0), (2.9, 1.5), -0.8)]
    return [mover for look, walk in enumerate(walks[:number], start=1)
            for mover in movers.person(look, walk)]


SCENES = {'laboratory': laboratory, 'lobby': lobby, 'office': office}
