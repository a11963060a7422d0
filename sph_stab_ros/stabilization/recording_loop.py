# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Stabilise a recording frame by frame and hand each result to sinks, which write it."""

from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import closing
from dataclasses import dataclass, field
from itertools import islice
import logging
from typing import Any, Protocol

from scipy.spatial.transform import Rotation

from sph_stab_ros.geometry.conventions import NS_PER_S
from sph_stab_ros.geometry.projection_factory import ProjectionError
from sph_stab_ros.images.appearance_watch import PictureWatch
from sph_stab_ros.images.codec import ImageError
from sph_stab_ros.images.colour import Colour
from sph_stab_ros.images.frame import Frame
from sph_stab_ros.recording import Recording, RecordingError
from sph_stab_ros.stabilization.imu import ImuSample
from sph_stab_ros.stabilization.recorded_imu import RecordedImu
from sph_stab_ros.stabilization.stabilized_frame import StabilizedFrame
from sph_stab_ros.tracking.offline.grey_spool import SpoolError

logger = logging.getLogger(__name__)


class FrameProcessor(Protocol):
    """A Stabilizer, or what stands in for one."""

    def add_imu(self, sample: ImuSample) -> None:
        """Take in an ImuSample; there are none unless the recording's IMU is asked for."""

    def process(self, frame: Frame) -> StabilizedFrame:
        """Return the StabilizedFrame of the next Frame, or raise ProjectionError."""


@dataclass
class Summary:
    """What happened on the way through a recording."""

    frames: int = 0
    statuses: Counter[str] = field(default_factory=Counter)
    events: Counter[str] = field(default_factory=Counter)
    left_out: Counter[str] = field(default_factory=Counter)
    turned_rad: float = 0.
    R_world_camera: Rotation | None = None
    # Of the first picture.
    colour: Colour | None = None

    def add(self, stabilized: StabilizedFrame) -> None:
        """Count a StabilizedFrame; name the first event of each kind in the log."""
        self.frames += 1
        self.colour = self.colour or stabilized.frame.colour
        self.statuses[stabilized.status.value] += 1
        for event in stabilized.events:
            self.events[event.value] += 1
            if self.events[event.value] == 1:
                logger.warning('picture %d at %.3f s: %s (more of these are only counted)',
                               self.frames, stabilized.stamp_ns / NS_PER_S, event.value)
        if self.R_world_camera is not None:
            self.turned_rad += (self.R_world_camera.inv() * stabilized.R_world_camera).magnitude()
        self.R_world_camera = stabilized.R_world_camera


def stabilize_recording(
        recording: Recording, stabilizer: FrameProcessor,
        sinks: Iterable[Callable[[StabilizedFrame], Any]] = (), max_frames: int | None = None,
        progress: Callable[[Iterator[Frame]], Iterable[Frame]] = iter,
        imu: RecordedImu | None = None, pictures: bool = False,
        watch: PictureWatch | None = None) -> Summary:
    """
    Stabilise a Recording frame by frame and return the Summary.

    Parameters
    ----------
    recording
        Its frames are read to the end or to ``max_frames``.
    stabilizer
        Fresh, or in the orientation to go on from.
    sinks
        Each is called with each StabilizedFrame.
    max_frames
        How many pictures to read; all by default.
    progress
        Passes on the iterator of frames that it is given, and may tell of it.
    imu : RecordedImu, optional
        Its samples go to the stabilizer, each before the first picture that is not earlier.
    pictures
        Whether sinks ask for pictures, whose images are then decoded once, for tracking too.
    watch : PictureWatch, optional
        Looks at the pictures; its hint is logged.

    Raises
    ------
    RecordingError
        Where not one picture can be used, or a temporary file that tracking needs has no room.

    """
    summary = Summary()
    with closing(recording.frames()) as frames:
        for frame in progress(islice(frames, max_frames)):
            if imu is not None:
                for sample in imu.until(frame.clock_ns):
                    stabilizer.add_imu(sample)
            try:
                if pictures:
                    frame.load()
                if watch is not None and (hint := watch.look(frame)):
                    logger.warning('%s: %s', recording.name, hint)
                stabilized = stabilizer.process(frame)
            except (ImageError, ProjectionError) as error:
                summary.left_out[error.reason] += 1
                if summary.left_out[error.reason] == 1:
                    logger.warning('%s: picture left out, %s (more of these are only counted)',
                                   recording.name, error)
                continue
            except SpoolError as error:
                raise RecordingError(str(error)) from error.__cause__
            summary.add(stabilized)
            for sink in sinks:
                sink(stabilized)
    summary.left_out += recording.skipped
    if not summary.frames:
        reasons = ', '.join(f'{reason}: {n}' for reason, n in summary.left_out.items())
        raise RecordingError(
            f'{recording.name} has no usable picture ({reasons or "none at all"})')
    return summary
