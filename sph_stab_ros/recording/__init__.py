# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Recordings in and out: rosbags of either generation, and video files, without ROS."""

import math
from pathlib import Path

from sph_stab_ros.config import NOT_JOINED
from sph_stab_ros.recording.base import decoded_frames, Recording, RecordingError, Stretch

__all__ = ['decoded_frames', 'open_recording', 'Recording', 'RecordingError']

STANDARD_INPUT = Path('-')


def open_recording(path: str | Path, image_topic: str | None = None, start_s: float = 0.,
                   end_s: float = math.inf, join: str = NOT_JOINED) -> Recording:
    """
    Return the Recording at ``path``, or a stretch of its pictures.

    Parameters
    ----------
    path
        A rosbag2 folder, an MCAP or SQLite file, a ROS 1 bag, or else a video file; what it is
        is told by its content, not by its name. ``-`` is a video through standard input, once, as
        a pipe at a path is one.
    image_topic
        Where to find the images in a bag that has several image topics; of two lenses' pictures
        that are joined both topics, with a comma between.
    start_s, end_s
        The time of the first picture to read and that of the first one not to, in seconds from the
        recording's first picture on. Videos are decoded from the key picture before.
    join
        How to put the pictures of two lenses together that are two tracks of a video, or two
        topics of a bag: ``left_right``, ``top_bottom``, or ``none``, where there is one picture.

    """
    stretch = Stretch(start_s, end_s)
    path = Path(path)
    if path != STANDARD_INPUT and not path.exists():
        raise RecordingError(f'{path} does not exist')
    if not (path.is_file() or path.is_dir()) and image_topic is None:
        from sph_stab_ros.recording.video import PipedVideo
        if join != NOT_JOINED:
            name = 'standard input' if path == STANDARD_INPUT else path
            raise RecordingError(f'{name} can be read only once: its tracks are not joined')
        return PipedVideo(None if path == STANDARD_INPUT else path, stretch)
    # Either library is imported only for its own kind of file.
    from sph_stab_ros.recording.containers import is_bag
    if is_bag(path):
        from sph_stab_ros.recording.bag import BagRecording
        return BagRecording(path, image_topic, stretch, join)
    if image_topic is not None:
        raise RecordingError(f'{path} is not a bag and has no topic {image_topic}')
    from sph_stab_ros.recording.video import VideoRecording
    return VideoRecording(path, stretch, join)
