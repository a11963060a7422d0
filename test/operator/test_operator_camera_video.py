# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The camera's own H.264 through the operator's server: who gets it as it is, and who does not."""

import cv2
import numpy as np
import pytest

pytest.importorskip('aiohttp', reason='aiohttp is not installed')
av = pytest.importorskip('av', reason='PyAV is not installed')
from encoded_video import COUNT, encode, KEY_PERIOD, stream, WIDTH  # noqa: E402, I100
from operator_camera import (  # noqa: E402
    CAMERA_BIT_RATE, check_camera_s_own, number_of, with_camera)
from sph_stab_ros.operator.camera_video import ENOUGH  # noqa: E402
from tiny_recordings import turning_spheres  # noqa: E402


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


class Failing:
    """A decoder that fails once it has decoded."""

    def __init__(self, decoder):
        self._decoder = decoder

    def decode(self, *arguments):
        """Decode, and fail."""
        assert not [*self._decoder.decode(*arguments)]


@with_camera()
async def test_what_the_decoder_fails_at_is_a_gap(site, camera):
    """Whatever it fails by: those behind it are not passed on as if nothing was missing."""
    watching = await camera.watch()
    await camera.film(watching.gets(KEY_PERIOD))
    failed = -(-camera.number // KEY_PERIOD) * KEY_PERIOD + 3
    await camera.film(lambda: camera.number == failed)
    decoder = camera.pictures._decoder
    camera.pictures._decoder = Failing(decoder)
    await camera.film(lambda: camera.number == failed + 1)
    camera.pictures._decoder = decoder
    await camera.film(watching.gets(KEY_PERIOD))
    check_camera_s_own(camera, watching)
    assert failed not in [number_of(one) for one in watching.got]


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
