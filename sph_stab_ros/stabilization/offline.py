# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Stabilising a recording that is there as a whole: read it several times, then show it."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, TypeAlias

from scipy.spatial.transform import Rotation

from sph_stab_ros.config import LOCK, StabilizerConfig
from sph_stab_ros.images.frame import Frame
from sph_stab_ros.stabilization.imu import ImuSample
from sph_stab_ros.stabilization.lookahead import smooth
from sph_stab_ros.stabilization.pipeline import Stabilizer
from sph_stab_ros.stabilization.recording_loop import FrameProcessor
from sph_stab_ros.stabilization.stabilized_frame import StabilizedFrame
from sph_stab_ros.tracking import MakeTracker
from sph_stab_ros.tracking.offline import TwoPasses
from sph_stab_ros.tracking.offline.two_passes import Progress

# Has all frames of the recording processed, and the IMU's samples, from the first on.
Read: TypeAlias = Callable[[FrameProcessor], Any]


def offline_stabilizer(
        config: StabilizerConfig, read: Read, progress: Progress) -> FrameProcessor:
    """Return what processes the frames of a recording with all of them known beforehand."""
    passes = TwoPasses()
    read(Stabilizer(config, passes.first_tracker))
    passes.finish(progress)
    return looking_ahead(config, read, passes.known_tracker)


def looking_ahead(
        config: StabilizerConfig, read: Read, known_tracker: MakeTracker) -> FrameProcessor:
    """Return what shows frames whose orientations a tracker tells that knows all of them."""
    stabilizer = Stabilizer(config, known_tracker)
    if config.smoothing.mode == LOCK:
        return stabilizer
    # What is smoothed is the levelled orientation.
    orientations = OrientationsOf(stabilizer)
    read(orientations)
    return Directed(Stabilizer(config, known_tracker), smooth(
        config.smoothing, orientations.times_ns, Rotation.concatenate(orientations.rotations)))


class OrientationsOf:
    """A FrameProcessor that keeps when and how the camera of another one was turned."""

    def __init__(self, processor: FrameProcessor) -> None:
        self._processor = processor
        self.times_ns: list[int] = []
        self.rotations: list[Rotation] = []

    def add_imu(self, sample: ImuSample) -> None:
        """Pass an ImuSample on."""
        self._processor.add_imu(sample)

    def process(self, frame: Frame) -> StabilizedFrame:
        """Return the StabilizedFrame of the next Frame."""
        stabilized = self._processor.process(frame)
        self.times_ns.append(frame.time_ns)
        self.rotations.append(stabilized.R_world_camera)
        return stabilized


class Directed:
    """A FrameProcessor whose virtual camera is turned as it is told, frame by frame."""

    def __init__(self, processor: FrameProcessor, R_world_virtual: Rotation) -> None:
        self._processor = processor
        self._R_world_virtual = iter(R_world_virtual)

    def add_imu(self, sample: ImuSample) -> None:
        """Pass an ImuSample on."""
        self._processor.add_imu(sample)

    def process(self, frame: Frame) -> StabilizedFrame:
        """Return the StabilizedFrame of the next Frame."""
        stabilized = self._processor.process(frame)
        return replace(stabilized, R_world_virtual=next(self._R_world_virtual))
