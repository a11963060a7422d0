# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""A camera of video before a server of the operator's page, and browsers that watch."""

import asyncio

from encoded_video import KEY_PERIOD, message, stream
from operator_site import IDENTITY, site, TIMEOUT_S
from scipy.spatial.transform import Rotation
from sph_stab_ros.geometry.conventions import NS_PER_S
from sph_stab_ros.operator.camera_pictures import CameraPictures
from sph_stab_ros.operator.pairing import Orientation, Pairing
from sph_stab_ros.operator.video import Video

# Less than what a browser is taken to be able to get at first.
CAMERA_BIT_RATE = 2e6


class Camera:
    """
    A camera of video in front of a server, and a stabilizer that knows the orientation of each.

    Its pictures are numbered; the stream begins anew when it is at its end. The stabilizer leaves
    out those ``left_out``, and the network those ``lost``.
    """

    def __init__(self, site, packets, codec='h264'):
        loop = asyncio.get_running_loop()
        self._site, self.packets, self._codec = site, packets, codec
        self._pairing = Pairing(lambda one: loop.call_soon_threadsafe(self._show, one))
        self.pictures = CameraPictures(self._taken, self._refused, False)
        self._done = 0
        bits = 8 * sum(len(data) for _, data in packets)
        self._period_s = bits / len(packets) / CAMERA_BIT_RATE
        self._watching = []
        self.number, self.left_out, self.lost, self.shown = 0, (), (), []

    def _show(self, picture):
        self.shown.append(picture)
        self._site.server.show(picture)

    def _taken(self, picture):
        self._pairing.add_picture(picture)
        self._done += 1

    def _refused(self, kind, text):
        self._done += 1

    def data(self, number):
        """Return the packet with a number."""
        return self.packets[number % len(self.packets)][1]

    async def film(self, until, waits=True):
        """Send pictures, each when the one before is done, until a condition holds."""
        end_s = asyncio.get_running_loop().time() + TIMEOUT_S
        while not until():
            assert asyncio.get_running_loop().time() < end_s, 'waited in vain'
            self.pictures.needs_files = self._site.robot.needs_files
            at = self.number % len(self.packets)
            index, data = self.packets[at]
            # Pictures may be sent in another order than that of their times.
            number = self.number - at + index
            msg = message(data, self._codec)
            msg.header.stamp.sec, msg.header.stamp.nanosec = divmod(stamp_of(number), NS_PER_S)
            if number not in self.left_out:
                self._pairing.add_orientation(
                    stamp_of(number), Orientation(turned(number), IDENTITY))
            if self.number not in self.lost:
                done = self._done
                self.pictures.put(msg, self.number * self._period_s)
                while waits and self._done == done:
                    await asyncio.sleep(0.001)
            self.number += 1
            await asyncio.sleep(0.005)
            while not self._all_drawn():
                await asyncio.sleep(0.001)

    def _all_drawn(self):
        """Tell whether those who draw have drawn all, so that a busy machine delays nobody."""
        return not any(client.flow._waiting or client.flow._undrawn for client, watching in zip(
            self._site.server._browsers, self._watching) if watching.draws)

    async def watch(self, query='?video=h264'):
        """Return a browser that has come."""
        self._watching.append(Watching(await self._site.connect(query)))
        return self._watching[-1]

    def close(self):
        """End."""
        self.pictures.close()
        for watching in self._watching:
            watching.close()


def stamp_of(number):
    """Return the stamp of the camera's picture with a number, in ns."""
    return 10**18 + number * 33_333_333


def number_of(header):
    """Return the number of the camera's picture in a message to a browser."""
    return (int(header['stamp_ns']) - 10**18) // 33_333_333


def turned(number):
    """Return the orientation of the picture with a number."""
    return tuple(Rotation.from_euler('y', number % 360, degrees=True).as_quat().tolist())


def with_camera(packets=lambda: stream('h264'), codec='h264'):
    """Run a test, a coroutine function of a Site and a Camera before it."""
    def decorate(test):
        def run(*arguments, **named):
            async def run_it():
                async with site(video=Video(lambda kind, text: None)) as one:
                    camera = Camera(one, packets(), codec)
                    try:
                        await asyncio.wait_for(test(one, camera, *arguments, **named),
                                               4 * TIMEOUT_S)
                    finally:
                        camera.close()
            asyncio.run(run_it())
        run.__name__ = test.__name__
        return run
    return decorate


class Watching:
    """A browser that draws what it gets, while ``draws``; ``got`` are the messages."""

    def __init__(self, browser):
        self._browser, self.got, self.draws = browser, [], True
        self._task = asyncio.create_task(self._draw())

    def close(self):
        """End."""
        self._task.cancel()

    async def _draw(self):
        while True:
            header = await self._browser.receive('picture')
            self.got.append({**header, 'data': self._browser.data})
            if self.draws:
                await self.draw()

    async def draw(self):
        """Tell that the last picture is drawn, and those before it."""
        await self._browser.send('drawn', sequence=self.got[-1]['sequence'])

    async def fail(self):
        """Tell that it cannot be decoded."""
        await self._browser.send('need_key')

    @property
    def passed(self):
        """Return those of the camera's own."""
        return [one for one in self.got if one['codec']]

    def gets(self, count):
        """Return the condition that so many more of the camera's own are there."""
        least = len(self.passed) + count
        return lambda: len(self.passed) >= least


def check_camera_s_own(camera, watching):
    """Check that each is the camera's to the last bit, with its orientation and what it needs."""
    before = None
    for one in watching.got:
        number = number_of(one)
        assert one['orientation']['R_world_camera'] == list(turned(number))
        if one['codec']:
            assert one['data'] == camera.data(number)
            assert one['chunk'] == ('delta' if number % KEY_PERIOD else 'key')
            assert one['codec'].startswith('avc1.42c0') and len(one['codec']) == len('avc1.640028')
            # The one that it is made of is the one that came before it.
            assert one['chunk'] == 'key' or (
                before['codec'] == one['codec'] and number_of(before) == number - 1)
        before = one
