# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
"""
What the browsers see as a bag on the robot: pictures with their orientations.

On the robot, since there it is whole whatever becomes of the radio or the browser, and as the
camera took it; and as a bag, since a bag that nobody has closed is read up to its last chunk.
"""

import asyncio
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from datetime import datetime
from errno import ENOSPC
from os import strerror
from pathlib import Path
import shutil
from threading import Semaphore

import numpy as np
from rosbags.rosbag2 import WriterError
from scipy.spatial.transform import Rotation

from sph_stab_ros.images.codec import kind_of_file
from sph_stab_ros.operator.pairing import Picture
from sph_stab_ros.operator.robot_interface import RobotError
from sph_stab_ros.recording.bag_writer import BagWriter
from sph_stab_ros.recording.messages import COMPRESSED_IMAGE

IMAGE, DEROTATED_IMAGE = '/image/compressed', '/stabilized/image/compressed'
ORIENTATION, VIRTUAL_ORIENTATION = '/orientation', '/virtual_orientation'
FRAME_ID = 'camera'
# A disk that writes slowly loses pictures, not memory.
MAX_WAITING = 30
# That much the system and others need.
MIN_FREE_BYTES = 10**9


class Recorder:
    """
    Writes one bag at a time, in a thread of its own, in which alone bags are touched.

    Parameters
    ----------
    folder
        Where the bags come, each named after the time at which it begins.
    warn
        Logs a text, before which comes the kind of event.

    """

    def __init__(self, folder: Path, warn: Callable[[str, str], object]) -> None:
        self._folder, self._warn = folder, warn
        self._thread = ThreadPoolExecutor(1, 'recorder')
        self._room = Semaphore(MAX_WAITING)
        self._bag: BagWriter | None = None
        # Of the bag that is being written, else ''.
        self.name = ''
        self._failure = ''

    async def record(self, wanted: bool) -> str:
        """Begin or end a bag; return what to tell the operator, or raise RobotError."""
        return await asyncio.wrap_future(
            self._thread.submit(self._begin if wanted else self._end))

    def take(self, picture: Picture) -> None:
        """Write a picture, if a bag is being written."""
        if not self.name:
            return
        if self._room.acquire(blocking=False):
            self._thread.submit(self._write, picture)
        else:
            self._warn('slow disk', 'picture not recorded: the disk is too slow')

    def pop_failure(self) -> str:
        """Return why a bag has ended by itself, once; else ''."""
        failure, self._failure = self._failure, ''
        return failure

    def close(self) -> None:
        """Write what waits, and end."""
        if self.name:
            self._thread.submit(self._end)
        self._thread.shutdown()

    # In the thread.

    def _begin(self) -> str:
        if self._bag:
            raise RobotError(f'{self.name} is being recorded already.')
        name = f'{datetime.now():%Y-%m-%d_%H-%M-%S}'
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            refuse_full_disk(self._folder)
            bag = BagWriter(self._folder / name).__enter__()
        except (OSError, WriterError) as error:
            raise RobotError(f'Not recorded: {reason(error)}.') from None
        self._bag, self.name = bag, name
        return f'Recording {name} on the robot.'

    def _write(self, picture: Picture) -> None:
        try:
            if self._bag:
                refuse_full_disk(self._folder)
                write_picture(self._bag, picture)
        except OSError as error:
            self._failure = f'The recording has ended: {reason(error)}.'
            self._warn('disk', self._failure)
            with suppress(RobotError):
                self._end()
        finally:
            self._room.release()

    def _end(self) -> str:
        bag, name, self._bag, self.name = self._bag, self.name, None, ''
        if not bag:
            raise RobotError('Nothing is being recorded.')
        try:
            bag.__exit__()
        except OSError as error:
            raise RobotError(f'{name} has no end: {reason(error)}.') from None
        return f'Recorded: {self._folder.resolve() / name}'


def refuse_full_disk(folder: Path) -> None:
    """Raise OSError where a folder has no room."""
    if shutil.disk_usage(folder).free < MIN_FREE_BYTES:
        raise OSError(ENOSPC, strerror(ENOSPC))


def reason(error: Exception) -> str:
    """Return what is wrong, without numbers."""
    return (isinstance(error, OSError) and error.strerror) or str(error)


def write_picture(bag: BagWriter, picture: Picture) -> None:
    """Write a picture as the camera sent it, and its orientations where it has any."""
    bag.write(DEROTATED_IMAGE if picture.derotated else IMAGE, bag.make(
        COMPRESSED_IMAGE, header=bag.header(picture.stamp_ns, FRAME_ID),
        format=kind_of_file(picture.data).lower(), data=np.frombuffer(picture.data, np.uint8)),
        picture.stamp_ns)
    if picture.orientation:
        for topic, quaternion in (
                (ORIENTATION, picture.orientation.R_world_camera),
                (VIRTUAL_ORIENTATION, picture.orientation.R_world_virtual)):
            bag.write_orientation(topic, picture.stamp_ns, FRAME_ID,
                                  Rotation.from_quat(quaternion))
