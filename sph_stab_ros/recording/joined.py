# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The Frames of two lenses, as two tracks or topics of a recording, joined into one picture."""

from collections.abc import Iterable, Iterator
from dataclasses import replace
from heapq import merge

from sph_stab_ros.images.frame import Frame
from sph_stab_ros.images.joined import JoinedPicture, Pairing
from sph_stab_ros.recording.base import SkipLog


def joined(first: Iterable[Frame], second: Iterable[Frame], join: str, skip_log: SkipLog
           ) -> Iterator[Frame]:
    """
    Yield the Frames of two lenses' Frames of the same moments, with all else of the first lens'.

    Those that have none of the other lens with them are left out, and counted.
    """
    pairing: Pairing[Frame] = Pairing()
    both = merge(_numbered(0, first), _numbered(1, second), key=lambda one: one[1].stamp_ns)
    for which, frame in both:
        pair = pairing.add(which, frame.stamp_ns, frame)
        if pair is not None:
            source = JoinedPicture(pair[0].source, pair[1].source, join)
            yield replace(pair[0], source=source)
    for _ in range(pairing.left_out):
        skip_log.add('one lens only', 'no picture of the other lens is of the same time')


def _numbered(which: int, frames: Iterable[Frame]) -> Iterator[tuple[int, Frame]]:
    for frame in frames:
        yield which, frame
