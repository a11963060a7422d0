# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""PyAV, which reads and writes videos, or what to do where there is none."""

from pathlib import Path

from sph_stab_ros.images.video.decoder import INSTALL
from sph_stab_ros.recording.base import RecordingError

try:
    import av
except ImportError:
    raise RecordingError(f'a video {INSTALL}') from None

__all__ = ['av', 'url_of']


def url_of(path: Path) -> str:
    """Return what FFmpeg takes for a file: before a colon it looks for a protocol otherwise."""
    return f'file:{path}'
