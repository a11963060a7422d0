# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""
What a camera's own sensors measured, out of the metadata of its video.

Read are GoPro's (GPMF), those of Google's Camera Motion Metadata (CAMM), and the trailer of
Insta360's files. Times are those of the video's pictures; axes are those of a body at the camera
(x forward through the image centre, y left, z up), as far as the format or the model tells.
"""

from pathlib import Path

from sph_stab_ros.recording.telemetry import gpmf, insta360
from sph_stab_ros.recording.telemetry.base import Series, Telemetry

__all__ = ['read_telemetry', 'Series', 'stabilized_by', 'Telemetry', 'TELEMETRY']

# What stands for it where a bag has the name of a topic.
TELEMETRY = 'telemetry'


def read_telemetry(path: Path) -> Telemetry | None:
    """
    Return the Telemetry in a video file, None where there is none.

    RecordingError where what is there is damaged beyond use, or more than can be held.
    """
    if insta360.is_trailed(path):
        return insta360.read(path)
    # PyAV is imported for videos only.
    from sph_stab_ros.recording.telemetry import tracks
    return tracks.read(path)


def stabilized_by(path: Path) -> str:
    """Return what in a video's metadata says that the camera stabilised it, else nothing."""
    return insta360.stabilized_by(path) if insta360.is_trailed(path) else gpmf.stabilized_by(path)
