# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What the benchmark of the node sends: pictures that are ready, due at known times."""

from collections import Counter
from collections.abc import Generator, Iterator
from dataclasses import dataclass
from itertools import chain, cycle, islice
from pathlib import Path
import time
from typing import Any

import cv2
from sensor_msgs.msg import CompressedImage, Image
from sph_stab_ros.geometry.conventions import NS_PER_S
from sph_stab_ros.images.codec import fill_compressed, fill_image
from sph_stab_ros.images.frame import Frame
from sph_stab_ros.recording import decoded_frames, open_recording, RecordingError

ORIENTATION = 'orientation'
# What may be subscribed to, and what that adds to a scenario's name.
OUTPUTS = {'stabilized/image': '', 'view/image': ', view', ORIENTATION: ', no pictures'}
# Of the pictures, unless told otherwise.
WIDTH = 1920
# Held in memory, 330 MB of raw pictures at 1920 columns, and played there and back.
PICTURES = 60
WARM_UP_S = 1.
# Besides, since it takes the ends a while to find each other.
SPARE_S = 4.


@dataclass(frozen=True)
class Scenario:
    """
    What is sent and how; ``profile`` is a Fast DDS profile, '' for its defaults.

    ``output`` is a topic of pictures, or ORIENTATION where nobody wants any.
    """

    recording: Path
    width: int
    rate_hz: float
    frames: int
    output: str
    transport: str
    profile: str

    @property
    def name(self) -> str:
        """Tell it from others."""
        name = f'{self.transport}, {"profile" if self.profile else "defaults"}'
        if self.width != WIDTH:
            name += f', {self.width} columns'
        return name + OUTPUTS[self.output]

    @property
    def warm_up_frames(self) -> int:
        """How many pictures are sent before those that count."""
        return round(WARM_UP_S * self.rate_hz)

    @property
    def sent_frames(self) -> int:
        """How many pictures are sent: those of warming up, those that count, and some to spare."""
        return self.warm_up_frames + self.frames + round(SPARE_S * self.rate_hz)

    @property
    def compressed(self) -> bool:
        """Whether pictures travel as JPEG."""
        return self.transport == 'compressed'

    @property
    def image_type(self) -> type[Any]:
        """Return the type of the messages that pictures travel in."""
        return CompressedImage if self.compressed else Image

    @property
    def image_topic(self) -> str | None:
        """Return the topic of pictures that is subscribed to, None where there is none."""
        return None if self.output == ORIENTATION else self.topic(self.output)

    def topic(self, name: str) -> str:
        """Return where the pictures of ``name`` are."""
        return f'{name}/compressed' if self.compressed else name

    def stamps_ns(self, start_ns: int) -> list[int]:
        """Return the stamps of all pictures, in ns."""
        return [start_ns + round(n / self.rate_hz * NS_PER_S) for n in range(self.sent_frames)]


class MemoryRecording:
    """A Recording whose messages are ready, and stamped from the first one's time on."""

    def __init__(self, scenario: Scenario) -> None:
        self._scenario = scenario
        self.name = scenario.recording.name
        self.image_topic: str | None = 'image'
        self.topics = {'image': f'sensor_msgs/msg/{scenario.image_type.__name__}'}
        self.frame_count: int | None = scenario.sent_frames
        self.skipped: Counter[str] = Counter()
        self.telemetry = None
        fill = fill_compressed if scenario.compressed else fill_image
        size = scenario.width, scenario.width // 2
        frames = decoded_frames(open_recording(scenario.recording))
        images = (cv2.resize(frame.image, size, interpolation=cv2.INTER_CUBIC)
                  for frame in islice(frames, PICTURES))
        self._messages = [fill(scenario.image_type(), image) for image in images]
        if not self._messages:
            raise RecordingError(f'{scenario.recording} has no pictures')
        # Of the first picture, once it is sent.
        self.start_ns = 0

    def frames(self) -> Generator[Frame, None, None]:
        """Raise RecordingError: the pictures are in messages already."""
        raise RecordingError(f'{self.name} is sent as it is in memory')

    def messages(self, topic: str) -> Iterator[tuple[int, Any]]:
        """Yield (stamp in ns, message); the first is due now."""
        self.start_ns = time.time_ns()
        there_and_back = cycle(chain(self._messages, self._messages[-2:0:-1]))
        for time_ns, msg in zip(self._scenario.stamps_ns(self.start_ns), there_and_back):
            msg.header.stamp.sec, msg.header.stamp.nanosec = divmod(time_ns, NS_PER_S)
            yield time_ns, msg
