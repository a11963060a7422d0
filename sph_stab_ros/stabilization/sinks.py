# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What takes in stabilised frames and writes them down: into a trajectory, a video or a bag."""

from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from functools import cache
from itertools import count
import logging
from pathlib import Path
from typing import Any, TypeAlias

from sph_stab_ros.config import EncoderConfig, H264, Settings
from sph_stab_ros.geometry.arrays import Image
from sph_stab_ros.geometry.conventions import NS_PER_S
from sph_stab_ros.geometry.trajectory import tum_line
from sph_stab_ros.images.codec import encode_jpeg
from sph_stab_ros.recording import Recording
from sph_stab_ros.recording.partial_output import partial_output
from sph_stab_ros.stabilization.outputs import (
    configured_camera, fits_into_tree, orientation_outputs, picture_outputs)
from sph_stab_ros.stabilization.stabilized_frame import StabilizedFrame

logger = logging.getLogger(__name__)

STILL_QUALITY = 95
ROUNDING_S = 0.0005
# Writes a frame down.
Sink: TypeAlias = Callable[[StabilizedFrame], Any]


def trajectory_sink(path: Path, force: bool, stack: ExitStack) -> Sink:
    """Return a sink that writes ``R_world_camera`` into a TUM file."""
    file = stack.enter_context(open(stack.enter_context(partial_output(path, force)), 'w'))
    return lambda s: file.write(tum_line(s.stamp_ns, s.R_world_camera))


def video_sink(path: Path, force: bool, stack: ExitStack, recording: Recording, is_all: bool,
               picture: Callable[[StabilizedFrame], Image], spheres: bool,
               encoder: EncoderConfig = EncoderConfig(), speed: int = 1) -> Sink:
    """
    Return a sink that writes ``picture(stabilized)`` into a video file, with the sound.

    Of every ``speed`` frames one is shown, so many times as fast; then there is no sound. Pictures
    of more than eight bits are drawn with all of them, but for H.264.
    """
    from sph_stab_ros.recording.video import VideoRecording
    from sph_stab_ros.recording.video_writer import VideoWriter
    sound = (recording.sound_path if isinstance(recording, VideoRecording) and speed == 1
             else None)
    writer = stack.enter_context(VideoWriter(
        stack.enter_context(partial_output(path, force)), spheres, sound, is_all, encoder))
    numbers = count()
    keeps_depth = encoder.codec_for(True) != H264

    def write(s: StabilizedFrame) -> None:
        number = next(numbers)
        if number % speed:
            return
        deep = s.frame.deep_image if keeps_depth or not number else None
        if deep is not None and not keeps_depth:
            logger.warning("%s: H.264 is written with eight bits of the recording's; --codec h265 "
                           'or av1 keeps ten', path.name)
            deep = None
        shown = s if deep is None else replace(s, frame=replace(s.frame, source=deep))
        writer.write(picture(shown), s.frame.time_ns // speed, s.frame.colour)
    return write


def stills_sink(folder: Path, force: bool, stack: ExitStack, every_s: float,
                picture: Callable[[StabilizedFrame], Image]) -> Sink:
    """Return a sink that writes a picture now and then, by the seconds from the first frame on."""
    path = stack.enter_context(partial_output(folder, force, holds=('*.jpg',)))
    path.mkdir()
    first_ns: int | None = None
    written = 0

    def write(s: StabilizedFrame) -> None:
        nonlocal first_ns, written
        first_ns = s.frame.time_ns if first_ns is None else first_ns
        elapsed_s = (s.frame.time_ns - first_ns) / NS_PER_S
        # Times that were rounded are not too early.
        due = 1 + int((elapsed_s + ROUNDING_S) // every_s)
        if written < due:
            written = due
            data = encode_jpeg(picture(s), STILL_QUALITY)
            (path / f'{elapsed_s:010.3f}.jpg').write_bytes(data.tobytes())
    return write


def bag_sink(path: Path, force: bool, stack: ExitStack, settings: Settings) -> Sink:
    """Return a sink that writes what the node publishes, but raw images, into a rosbag2 folder."""
    from sph_stab_ros.recording.bag_writer import BagWriter, FILES
    writer = stack.enter_context(BagWriter(stack.enter_context(
        partial_output(path, force, FILES))))
    config = settings.config
    cameras = [configured_camera(name, view) for name, view in settings.views.items()]

    @cache
    def say_that_tree_is_missing(frame_id: str) -> None:
        logger.warning("no /tf in %s: the pictures have the frame_id '%s'", path, frame_id)

    def write(s: StabilizedFrame) -> None:
        if config.publish_tf and not fits_into_tree(s.frame.frame_id, config, cameras):
            say_that_tree_is_missing(s.frame.frame_id)
        for output in (*orientation_outputs(s, config, cameras),
                       *picture_outputs(s, config, cameras, raw=False)):
            writer.write(output.topic, output.message(writer.make), s.frame.time_ns)
    return write
