# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The camera's own H.264 through the operator's server: who gets it as it is, and who does not."""

import asyncio

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

pytest.importorskip('aiohttp', reason='aiohttp is not installed')
av = pytest.importorskip('av', reason='PyAV is not installed')
from encoded_video import COUNT, encode, KEY_PERIOD, message, stream, WIDTH  # noqa: E402, I100
from operator_site import IDENTITY, site, TIMEOUT_S  # noqa: E402
from sph_stab_ros.geometry.conventions import NS_PER_S  # noqa: E402
from sph_stab_ros.operator.camera_pictures import CameraPictures  # noqa: E402
from sph_stab_ros.operator.camera_rung import ENOUGH  # noqa: E402
from sph_stab_ros.operator.pairing import Orientation, Pairing  # noqa: E402
from sph_stab_ros.operator.video import Video  # noqa: E402
from tiny_recordings import turning_spheres  # noqa: E402

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
        self._pictures = CameraPictures(self._taken, self._refused, False)
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
            self._pictures.needs_files = self._site.robot.needs_files
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
                self._pictures.put(msg, self.number * self._period_s)
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
        self._pictures.close()
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


@with_camera()
async def test_what_comes_is_the_camera_s_own(site, camera):
    """When it is known how many bits that takes; until then our encoder makes pictures."""
    watching = await camera.watch()
    await camera.film(watching.gets(30))
    check_camera_s_own(camera, watching)
    assert watching.got[0]['chunk'] == 'key' and not watching.got[0]['codec']
    assert watching.passed[0]['chunk'] == 'key'
    # Then no picture is made a file, let alone encoded.
    assert site.robot.needs_files is False
    assert not camera.shown[-1].data
    assert not any(rung._encoder for rung in (site.server._video._full, site.server._video._half))


@with_camera()
async def test_who_comes_later_or_takes_files_gets_them_at_once(site, camera):
    """And disturbs nobody."""
    first = await camera.watch()
    await camera.film(first.gets(5))
    late, files = [await camera.watch(query) for query in ('?video=h264', '')]
    await camera.film(lambda: late.passed and len(files.got) > 5)
    for one in (first, late):
        check_camera_s_own(camera, one)
    assert late.got[0]['chunk'] == 'key' and not any(one['chunk'] for one in files.got)
    assert all(one['data'].startswith(b'\xff\xd8') for one in files.got)
    numbers = [number_of(one) for one in first.passed]
    assert numbers == [*range(numbers[0], numbers[-1] + 1)]


@with_camera()
async def test_who_does_not_keep_up_gets_our_encoder_s_and_others_are_not_disturbed(site, camera):
    good, slow = [await camera.watch() for _ in range(2)]
    await camera.film(lambda: len(good.passed) > 5 and len(slow.passed) > 5)
    flow = [client.video for client in site.server._browsers][1]
    slow.draws = False
    await camera.film(lambda: flow.rate.bit_rate < ENOUGH * CAMERA_BIT_RATE)
    assert flow not in site.server._video._camera
    had, slow.draws = len(slow.got), True
    await slow.draw()
    await camera.film(lambda: len(slow.got) > had + 5)
    assert slow.got[had]['chunk'] == 'key'
    assert not any(one['codec'] for one in slow.got[had:had + 5])
    for one in (good, slow):
        check_camera_s_own(camera, one)
    numbers = [number_of(one) for one in good.passed]
    assert numbers == [*range(numbers[0], numbers[-1] + 1)]


@with_camera()
async def test_behind_a_lost_packet_nothing_comes_before_the_next_key_picture(site, camera):
    watching = await camera.watch()
    await camera.film(watching.gets(KEY_PERIOD))
    lost = -(-camera.number // KEY_PERIOD) * KEY_PERIOD + 3
    camera.lost = (lost,)
    await camera.film(lambda: number_of(watching.got[-1]) >= lost + KEY_PERIOD)
    check_camera_s_own(camera, watching)
    numbers = [number_of(one) for one in watching.got]
    assert lost - 1 in numbers
    assert not {*range(lost, lost + KEY_PERIOD - 3)} & {*numbers}
    assert watching.got[numbers.index(lost + KEY_PERIOD - 3)]['codec']


@with_camera()
async def test_a_packet_that_the_stabilizer_has_left_out_is_not_needed(site, camera):
    """Our encoder makes what follows of what there is."""
    watching = await camera.watch()
    await camera.film(watching.gets(KEY_PERIOD))
    left_out = -(-camera.number // KEY_PERIOD) * KEY_PERIOD + 3
    camera.left_out = (left_out,)
    await camera.film(lambda: number_of(watching.got[-1]) > left_out)
    await camera.film(watching.gets(1))
    check_camera_s_own(camera, watching)
    after = next(one for one in watching.got if number_of(one) > left_out)
    assert after['chunk'] == 'key'
    assert left_out not in [number_of(one) for one in watching.got]


@with_camera()
async def test_a_browser_that_cannot_decode_it_is_not_given_it_again(site, camera):
    watching = await camera.watch()
    await camera.film(watching.gets(1))
    flow, = [client.video for client in site.server._browsers]
    await watching.fail()
    await camera.film(lambda: not flow.takes_camera)
    had = len(watching.got)
    begin = camera.number
    await camera.film(lambda: camera.number > begin + 4 * KEY_PERIOD and len(watching.got) > had)
    later = [one for one in watching.got if number_of(one) > begin]
    assert later and not any(one['codec'] for one in later)


@with_camera()
async def test_damage_ends_nothing(site, camera):
    """What comes meanwhile may show it, where a decoder does not notice; no thread ends by it."""
    watching, rng = await camera.watch(), np.random.default_rng(0)
    whole = camera.packets
    camera.packets = [(index, damaged(data, rng)) for index, data in whole]
    begin = camera.number
    await camera.film(lambda: camera.number == begin + 2 * COUNT, waits=False)
    camera.packets = whole
    await camera.film(watching.gets(1))


def damaged(data, rng):
    """Return a packet with other bytes somewhere, or without its end, or none of it."""
    data = bytearray(data)
    for place in rng.integers(0, min(len(data), 60), 4):
        data[place] = rng.integers(0, 256)
    return bytes(data[:rng.integers(0, len(data) + 1)] if rng.random() < 0.3 else data)


def of_format(pixel_format):
    """Return the packets of a stream of other pixels."""
    return encode(turning_spheres(COUNT, WIDTH)[0], 'h264', pixel_format=pixel_format)


def without_key_pictures():
    """Return the packets of a stream that is refreshed piece by piece, longer than any test."""
    return encode(10 * [*turning_spheres(COUNT, WIDTH)[0]], 'h264 refresh')


def without_parameters():
    """Return the packets of a stream whose parameters come but once."""
    first, *others = stream('h264')
    start = b'\0\0\0\1'
    return [first, *((index, data if index % KEY_PERIOD else start + data[data.rfind(
        b'\0\0\1\x65') + 3:]) for index, data in others)]


@pytest.mark.parametrize('packets, codec', [
    (lambda: stream('h264 B'), 'h264'), (without_key_pictures, 'h264'),
    (lambda: stream('h265'), 'h265'), (lambda: of_format('yuv422p'), 'h264'),
    (lambda: of_format('yuv420p10le'), 'h264'), (without_parameters, 'h264')],
    ids=['B', 'no key pictures', 'H.265', '4:2:2', '10 bit', 'no parameters'])
def test_what_browsers_cannot_take_is_encoded_anew(packets, codec):
    @with_camera(packets, codec)
    async def test(site, camera):
        watching = await camera.watch()
        await camera.film(lambda: len(watching.got) > 3 * KEY_PERIOD, waits=False)
        assert not watching.passed
        check_camera_s_own(camera, watching)
        decoder = av.CodecContext.create('h264', 'r')
        decoder.thread_count = 1
        spheres = [cv2.cvtColor(one, cv2.COLOR_BGR2GRAY).astype(float)
                   for one in turning_spheres(COUNT, WIDTH)[0]]
        for one in watching.got:
            frame, = decoder.decode(av.Packet(one['data']))
            luma = frame.to_ndarray()[:WIDTH // 2]
            # Whichever it is like most.
            difference = [np.abs(luma - sphere).mean() for sphere in spheres]
            assert np.argmin(difference) == number_of(one) % COUNT
    test()
