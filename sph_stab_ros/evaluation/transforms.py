# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Transforms between frames (tf): which there are, and the chain of them that joins two frames."""

from collections import defaultdict, deque
from collections.abc import Collection, Sequence
from typing import Any, TypeAlias

import numpy as np
from scipy.spatial.transform import Rotation

from sph_stab_ros.evaluation.alignment import has_truth
from sph_stab_ros.geometry.conventions import stamp_ns
from sph_stab_ros.geometry.trajectory import Trajectory
from sph_stab_ros.recording import Recording, RecordingError
from sph_stab_ros.recording.messages import TRANSFORMS

STATIC = 'tf_static'

# The parent and the child of a transform, which maps the child's coordinates into the parent's.
Frames: TypeAlias = tuple[str, str]
# A stamp in nanoseconds, and a quaternion as it was sent.
Sample: TypeAlias = tuple[int, tuple[float, float, float, float]]


class Transforms:
    """
    The transforms in a topic of a Recording, and those in its topics of static ones.

    ``moving`` has all samples by Frames, ``static`` the last one.
    """

    def __init__(self, recording: Recording, topic: str) -> None:
        self.moving: defaultdict[Frames, list[Sample]] = defaultdict(list)
        self.static: dict[Frames, Sample] = {}
        self._name = recording.name
        for one, msgtype in recording.topics.items():
            if msgtype == TRANSFORMS and (one == topic or is_static(one)):
                for received_ns, msg in recording.messages(one):
                    for transform in msg.transforms:
                        self._add(is_static(one), received_ns, transform)

    def _add(self, static: bool, received_ns: int, transform: Any) -> None:
        frames = same_frame(transform.header.frame_id), same_frame(transform.child_frame_id)
        q = transform.transform.rotation
        sample = stamp_ns(transform.header.stamp) or received_ns, (q.x, q.y, q.z, q.w)
        if static:
            self.static[frames] = sample
        else:
            self.moving[frames].append(sample)

    def listed(self) -> str:
        """Return all Frames in a line."""
        return ', '.join(f'{parent}:{child}' for parent, child in sorted(
            {*self.moving, *self.static})) or 'none'

    def chain(self, parent: str, child: str) -> list[tuple[Frames, bool]]:
        """
        Return the transforms that lead from a frame to another, with whether each is inverted.

        RecordingError where there are none.
        """
        links = {*self.moving, *self.static}
        for frame in (parent, child):
            if not any(frame in frames for frames in links):
                raise RecordingError(f'{self._name} has no frame {frame}; its transforms are '
                                     f'{self.listed()}')
        found = shortest_chain(links, parent, child)
        if not found:
            raise RecordingError(f'{self._name} has no chain of transforms from {parent} to '
                                 f'{child}; it has {self.listed()}')
        return found


def is_static(topic: str) -> bool:
    """Tell whether the transforms in a topic hold for all times, as its name says."""
    return topic.rpartition('/')[2] == STATIC


def same_frame(name: str) -> str:
    """Return a frame's name without the slash that ROS 1 put before it."""
    return name.removeprefix('/')


def shortest_chain(
        links: Collection[Frames], parent: str, child: str) -> list[tuple[Frames, bool]]:
    """Return the links that lead from a frame to another, each with whether it is inverted."""
    steps = defaultdict(list)
    # In an order that is the same every time.
    for link in sorted(links):
        steps[link[0]].append((link[1], (link, False)))
        steps[link[1]].append((link[0], (link, True)))
    chains: dict[str, list[tuple[Frames, bool]]] = {parent: []}
    reached = deque([parent])
    while reached and child not in chains:
        frame = reached.popleft()
        for following, step in steps[frame]:
            if following not in chains:
                chains[following] = [*chains[frame], step]
                reached.append(following)
    return chains.get(child, [])


def composed(links: Sequence[Trajectory | Rotation]) -> Trajectory:
    """
    Return the product of links, each over time or for all times.

    Its stamps are those of all links, where all of them are known; ValueError where none is.
    """
    moving = [link for link in links if isinstance(link, Trajectory)]
    if not moving:
        raise ValueError('all of it is static')
    stamps_ns = np.unique(np.concatenate([link.stamps_ns for link in moving]))
    for over_time in moving:
        stamps_ns = stamps_ns[has_truth(over_time, stamps_ns)]
    if not len(stamps_ns):
        raise ValueError('its transforms are never known at the same time')
    product = Rotation.identity(len(stamps_ns))
    for link in links:
        product = product * (link.at(stamps_ns) if isinstance(link, Trajectory) else link)
    return Trajectory(stamps_ns, product)
