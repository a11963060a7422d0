# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Tracks of metadata in MP4 and MOV files, whichever format they are of."""

from collections.abc import Iterator
from pathlib import Path

from sph_stab_ros.recording.base import RecordingError
from sph_stab_ros.recording.pyav import av, url_of
from sph_stab_ros.recording.telemetry import camm, gpmf
from sph_stab_ros.recording.telemetry.base import Telemetry


def read(path: Path) -> Telemetry | None:
    """Return the Telemetry of the first track that holds some; RecordingError where unreadable."""
    try:
        with av.open(url_of(path), metadata_errors='replace') as container:
            indices = [one.index for one in container.streams if one.type == 'data']
        # Opened anew for each, to be read from the beginning.
        for index in indices:
            _, _, first = next(_samples(path, index), (0., 0., b''))
            for module in (gpmf, camm):
                if module.is_sample(first):
                    return module.read(_samples(path, index))
    except OSError as error:
        raise RecordingError(f'{path} cannot be read: {error.strerror}') from None
    except av.FFmpegError as error:
        raise RecordingError(f'{path} is not a readable video: {error.strerror}') from None
    return None


def _samples(path: Path, index: int) -> Iterator[tuple[float, float, bytes]]:
    """Yield times and durations in s, and bytes, of a track's samples up to any damage."""
    with av.open(url_of(path), metadata_errors='replace') as container:
        stream = container.streams[index]
        try:
            for packet in container.demux(stream):
                if packet.size and packet.pts is not None and packet.time_base:
                    yield (float(packet.pts * packet.time_base),
                           float((packet.duration or 0) * packet.time_base), bytes(packet))
        except av.FFmpegError:
            return
