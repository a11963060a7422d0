# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What all recordings have in common."""

from collections import Counter
from collections.abc import Generator, Iterator
import logging
import math
from typing import Any, NamedTuple, Protocol, TYPE_CHECKING

from sph_stab_ros.geometry.conventions import NS_PER_S
from sph_stab_ros.images.codec import ImageError
from sph_stab_ros.images.frame import Frame

if TYPE_CHECKING:
    from sph_stab_ros.recording.telemetry import Telemetry

logger = logging.getLogger(__name__)


class RecordingError(Exception):
    """A recording that cannot be read or written, said in one line."""


class EmptyStretch(RecordingError):
    """A recording has no picture in the stretch that was asked for."""


class Stretch(NamedTuple):
    """A part of a recording, in seconds from its first picture on, which is before the end."""

    start_s: float = 0.
    end_s: float = math.inf

    @property
    def start_ns(self) -> int:
        """Return the start in nanoseconds."""
        return round(self.start_s * NS_PER_S)

    @property
    def end_ns(self) -> float:
        """Return the end in nanoseconds, which may be infinite."""
        return self.end_s * NS_PER_S

    def share(self, count: int, duration_s: float) -> int:
        """Return how many of so many pictures, spread over a duration, it holds."""
        inside_s = min(self.end_s, duration_s) - min(self.start_s, duration_s)
        return round(count * inside_s / duration_s) if duration_s else count


class Recording(Protocol):
    """
    A recorded video or a stretch of it, read front to back with constant memory.

    ``name`` tells it from others; ``topics`` maps topics to message types (none in a video) and
    ``image_topic`` is where the images come from (None in a video);
    ``frame_count`` is what the file claims, to be taken as an estimate, or None.
    """

    name: str
    topics: dict[str, str]
    image_topic: str | None
    frame_count: int | None

    @property
    def skipped(self) -> Counter[str]:
        """Count the pictures left out by ``frames()`` so far, by reason."""

    @property
    def telemetry(self) -> 'Telemetry | None':
        """Return what the camera measured itself; None where a video has none, and of bags."""

    def frames(self) -> Generator[Frame, None, None]:
        """
        Yield the whole pictures in the recording's order, whatever their stamps.

        One that is damaged within may be found out when it is decoded only.
        """

    def messages(self, topic: str) -> Iterator[tuple[int, Any]]:
        """Yield the time of receipt in ns and the message, for each message of a topic."""


def decoded_frames(recording: Recording) -> Generator[Frame, None, None]:
    """Yield the Frames of a Recording with their images, leaving out those that have none."""
    skip_log = SkipLog(recording.name)
    for frame in recording.frames():
        try:
            frame.load()
        except ImageError as error:
            skip_log.add(error.reason, error)
        else:
            yield frame


class SkipLog:
    """Count what is left out, by reason, and name the first of each reason in the log."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.counts: Counter[str] = Counter()

    def add(self, reason: str, detail: object, is_told: bool = False) -> None:
        """Count one; ``detail`` is logged if it is the first for this reason and not told yet."""
        self.counts[reason] += 1
        if self.counts[reason] == 1 and not is_told:
            logger.warning('%s: picture left out, %s (more of these are only counted)',
                           self.name, detail)
