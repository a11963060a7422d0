# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""A server of the operator's page that shows pictures, in a thread, and a way to it that fails."""

import asyncio
from dataclasses import dataclass
from threading import Thread

import cv2
import numpy as np
from operator_harness import wait_until
from operator_site import IDENTITY, site
from sph_stab_ros.operator.pairing import Orientation, Picture

PERIOD_S = 0.05


@dataclass(frozen=True)
class State:
    """What the page is told of a robot, see RobotState."""

    camera: bool = True
    tracking: str = 'ok'
    healthy: bool = True
    message: str = 'ok'
    rate_hz: str = '30.0'
    latency_ms: str = '20.0'
    modes: tuple = ('lock', 'follow', 'yaw_follow')
    mode: str = 'lock'
    can_reset: bool = True
    can_level: bool = True


class Served(Thread):
    """
    A server that shows grey pictures, or ``file``, of a robot in the State ``state``.

    It does so while it is ``on``; ``robot`` notes what is asked of it, ``last_ns`` is the stamp of
    the last picture.
    """

    def __init__(self, **options):
        super().__init__()
        self.state, self.late_s, self.url, self.port = State(), 0., None, None
        self.file = cv2.imencode('.jpg', np.full((64, 128, 3), 128, np.uint8))[1].tobytes()
        self.robot, self.server, self.on, self.last_ns = None, None, True, 0
        self._options = options
        self._ending = False

    def __enter__(self):
        """Begin serving."""
        self.start()
        wait_until(lambda: self.url)
        return self

    def __exit__(self, *_):
        """End serving."""
        self.end()

    def run(self):
        """Serve until the end."""
        asyncio.run(self._serve())

    async def _serve(self):
        async with site(**self._options) as one:
            self.robot, self.server = one.robot, one.server
            self.port, self.url = one.port, one.url
            while not self._ending:
                one.robot.state = self.state
                now_s = asyncio.get_running_loop().time()
                if self.on:
                    picture = self.picture(now_s)
                    one.server.show(picture)
                    self.last_ns = picture.stamp_ns
                await asyncio.sleep(PERIOD_S)

    def picture(self, now_s):
        """Return what the camera gives next."""
        return Picture(round(1e9 * now_s), self.file, now_s - self.late_s,
                       Orientation(IDENTITY, IDENTITY))

    def end(self):
        """End serving."""
        self._ending = True
        self.join()


class Way(Thread):
    """
    A way to a port that can fall silent without an end: what is sent gets lost, nothing is closed.

    As a radio does that is out of reach. Connections that were silenced stay so.
    """

    def __init__(self, port):
        super().__init__()
        self.to_port, self.silent, self.port = port, False, None
        self._loop = asyncio.new_event_loop()

    def __enter__(self):
        """Begin."""
        self.start()
        wait_until(lambda: self.port)
        return self

    def __exit__(self, *_):
        """End; what was silent is closed now."""
        self._loop.call_soon_threadsafe(self._ending.set)
        self.join()

    def run(self):
        """Carry until the end."""
        self._loop.run_until_complete(self._serve())
        self._loop.close()

    async def _serve(self):
        self._ending = asyncio.Event()
        tasks = set()

        async def accept(reader, writer):
            tasks.add(asyncio.current_task())
            await self._carry(reader, writer)

        server = await asyncio.start_server(accept, '127.0.0.1', 0)
        self.port = server.sockets[0].getsockname()[1]
        await self._ending.wait()
        server.close()
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)

    async def _carry(self, reader, writer):
        far_reader, far_writer = await asyncio.open_connection('127.0.0.1', self.to_port)
        try:
            await asyncio.gather(self._copy(reader, far_writer), self._copy(far_reader, writer))
        finally:
            writer.close()
            far_writer.close()

    async def _copy(self, reader, writer):
        try:
            while data := await reader.read(1 << 16):
                if self.silent:
                    await asyncio.Event().wait()
                writer.write(data)
        except ConnectionError:
            pass
        writer.close()
