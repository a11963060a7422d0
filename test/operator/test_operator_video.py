# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The operator's video without server and browser: encoder, rate control, flow of pictures."""

from collections import deque
from dataclasses import replace

import cv2
import numpy as np
import pytest

pytest.importorskip('aiohttp', reason='aiohttp is not installed')
av = pytest.importorskip('av', reason='PyAV is not installed')
from operator_site import picture, striped_jpeg  # noqa: E402, I100
from sph_stab_ros.images.codec import ImageError  # noqa: E402
from sph_stab_ros.operator import h264  # noqa: E402
from sph_stab_ros.operator.flow_control import MAX_VIDEO_UNDRAWN, VideoFlow  # noqa: E402
from sph_stab_ros.operator.h264 import H264Encoder, MAX_COLUMNS  # noqa: E402
from sph_stab_ros.operator.pairing import Picture  # noqa: E402
from sph_stab_ros.operator.rate_control import (  # noqa: E402
    MAX_BIT_RATE, MIN_BIT_RATE, RateControl)

PERIOD_S = 1 / 30


class Clock:
    """A clock that stands still unless it is moved."""

    def __init__(self):
        self.now_s = 100.

    def __call__(self):
        """Return the time in seconds."""
        return self.now_s


# The encoder.

def test_each_picture_comes_out_at_once_and_as_it_was():
    encoder, decoder = H264Encoder(), av.CodecContext.create('h264', 'r')
    decoder.thread_count = 1
    for n in range(30):
        data, is_key = encoder.encode(striped_jpeg(n), 4e6, PERIOD_S, wants_key=n == 20)
        assert is_key == (n in (0, 20))
        frame, = decoder.decode(av.Packet(data))
        luma = frame.to_ndarray()[:64]
        wanted = cv2.imdecode(np.frombuffer(striped_jpeg(n), np.uint8), cv2.IMREAD_GRAYSCALE)
        # Of the next one it would differ by far more.
        assert np.abs(luma.astype(float) - wanted).mean() < 3


@pytest.mark.skipif(not hasattr(cv2, 'IMWRITE_JPEG_SAMPLING_FACTOR'),
                    reason='OpenCV before 4.7 writes JPEG of one sampling only')
@pytest.mark.parametrize('sampling', [0x111111, 0x211111, 0x221111], ids=['444', '422', '420'])
def test_colours_are_those_of_the_file(sampling):
    image = np.zeros((64, 128, 3), np.uint8)
    image[:, :64], image[:, 64:] = (255, 255, 255), (30, 60, 200)
    file = cv2.imencode('.jpg', image, (cv2.IMWRITE_JPEG_SAMPLING_FACTOR, sampling))[1].tobytes()
    data, _ = H264Encoder().encode(file, 8e6, PERIOD_S, wants_key=True)
    frame, = av.CodecContext.create('h264', 'r').decode(av.Packet(data)) or \
        av.CodecContext.create('h264', 'r').decode(None)
    # Full range, as JFIF has it.
    planes = [np.frombuffer(plane, np.uint8).reshape(-1, plane.line_size)
              for plane in frame.planes]
    for column, (b, g, r) in ((32, (255, 255, 255)), (96, (30, 60, 200))):
        y = 0.299 * r + 0.587 * g + 0.114 * b
        wanted = y, 128 + (b - y) / 1.772, 128 + (r - y) / 1.402
        got = (planes[0][32, column], planes[1][16, column // 2], planes[2][16, column // 2])
        np.testing.assert_allclose(got, wanted, atol=4)


@pytest.mark.parametrize('height, width', [(101, 202), (103, 206), (105, 210), (1500, 3000)])
@pytest.mark.parametrize('divisor', [1, 2])
def test_a_sphere_stays_one(height, width, divisor):
    file = cv2.imencode('.jpg', np.zeros((height, width), np.uint8))[1].tobytes()
    data, _ = H264Encoder(divisor).encode(file, 1e6, PERIOD_S, wants_key=True)
    decoder = av.CodecContext.create('h264', 'r')
    frame, = decoder.decode(av.Packet(data)) or decoder.decode(None)
    assert frame.width == 2 * frame.height
    assert width / divisor / 2 - 4 < frame.width <= min(width, MAX_COLUMNS) / divisor


@pytest.mark.parametrize('file', [
    b'', b'\xff\xd8 no picture', striped_jpeg()[:300] + b'\xff\xd9',
    cv2.imencode('.png', np.zeros((1, 1), np.uint8))[1].tobytes()])
def test_what_is_no_picture_is_an_error_and_no_end(file):
    encoder = H264Encoder()
    for n in range(2):
        with pytest.raises(ImageError):
            encoder.encode(file, 1e6, PERIOD_S, wants_key=False)
        assert encoder.encode(striped_jpeg(n), 1e6, PERIOD_S, wants_key=False)[1] == (n == 0)


@pytest.mark.parametrize('rate_hz', [6, 30])
def test_the_bit_rate_is_what_was_asked_for_and_changes(rate_hz):
    """At any rate of pictures, and without one that takes long on its way."""
    rng = np.random.default_rng(0)
    noise = cv2.GaussianBlur(rng.integers(0, 255, (240, 480, 3)).astype(np.uint8), (0, 0), 1)
    encoder = H264Encoder()
    for bit_rate in (1e6, 1.6e6, 0.8e6):
        bits = []
        for n in range(60):
            turned = np.roll(noise, 7 * n, axis=1)
            file = cv2.imencode('.jpg', turned)[1].tobytes()
            bits.append(8 * len(encoder.encode(file, bit_rate, 1 / rate_hz, False)[0]))
        assert 0.6 < np.mean(bits[20:]) * rate_hz / bit_rate < 1.1
        assert max(bits) < 0.5 * bit_rate


def test_where_hardware_does_not_open_software_encodes():
    """From the first picture on, with one line."""
    said = []
    encoder = H264Encoder(1, 'h264_none', lambda kind, text: said.append(text))
    for n in range(3):
        assert encoder.encode(striped_jpeg(n), 4e6, PERIOD_S, wants_key=n == 2)[1] == (n in (0, 2))
    assert said == ['h264_none cannot be used here: it is not in this PyAV; libx264 encodes']


def test_hardware_that_keeps_pictures_back_is_given_up(monkeypatch):
    """Whoever drives by them cannot wait; x265 looks ahead."""
    monkeypatch.setitem(h264.LIVE_ENCODERS, 'libx265', {'x265-params': 'log-level=none'})
    said = []
    encoder = H264Encoder(1, 'libx265', lambda kind, text: said.append(text))
    data, is_key = encoder.encode(striped_jpeg(), 4e6, PERIOD_S, wants_key=False)
    assert is_key and len(said) == 1
    decoder = av.CodecContext.create('h264', 'r')
    frame, = decoder.decode(av.Packet(data)) or decoder.decode(None)
    assert frame.width == 128 and 'libx265 cannot be used here' in said[0]


def test_hardware_that_gives_each_picture_at_once_is_used(monkeypatch):
    """Told that they are of full range; MPEG-4 stands in for it."""
    monkeypatch.setitem(h264.LIVE_ENCODERS, 'mpeg4', {'g': '300'})
    said = []
    encoder, decoder = H264Encoder(1, 'mpeg4', lambda kind, text: said.append(text)), \
        av.CodecContext.create('mpeg4', 'r')
    decoder.thread_count = 1
    shown = []
    for n in range(6):
        data, is_key = encoder.encode(striped_jpeg(n), 4e6, PERIOD_S, wants_key=n == 4)
        assert is_key == (n in (0, 4))
        shown += decoder.decode(av.Packet(data))
    shown += decoder.decode(None)
    for n, frame in enumerate(shown):
        wanted = cv2.imdecode(np.frombuffer(striped_jpeg(n), np.uint8), cv2.IMREAD_GRAYSCALE)
        assert np.abs(frame.to_ndarray()[:64].astype(float) - wanted).mean() < 3
    assert len(shown) == 6 and not said


# Rate control.

class Link:
    """A link in simulation, and a page at its end that draws what comes."""

    def __init__(self, flow, clock, round_trip_s):
        self._flow, self._clock, self._round_trip_s = flow, clock, round_trip_s
        self._free_s, self._acknowledgements, self._sequence = 0., deque(), 0

    def film(self, bit_rate, seconds):
        """Send pictures of the flow's rate, which the link has another of; return bits sent."""
        bits = 0
        for _ in range(round(seconds / PERIOD_S)):
            self._clock.now_s += PERIOD_S
            now_s, self._sequence = self._clock.now_s, self._sequence + 1
            while self._acknowledgements and self._acknowledgements[0][0] <= now_s:
                self._flow.acknowledge(self._acknowledgements.popleft()[1])
            size = round(self._flow.rate.bit_rate * PERIOD_S / 8)
            chunk = 'key' if self._flow.needs_key else 'delta'
            self._flow.offer(self._sequence, Picture(0, bytes(size), 0., chunk=chunk))
            if self._flow.next_picture():
                self._free_s = max(self._free_s, now_s) + 8 * size / bit_rate
                self._acknowledgements.append((self._free_s + self._round_trip_s, self._sequence))
                bits += 8 * size
        return bits


@pytest.mark.parametrize('link_bit_rate', [2e6, 4e6, 6e6])
@pytest.mark.parametrize('round_trip_s', [0.01, 0.2])
def test_the_rate_follows_the_link_down_and_up(link_bit_rate, round_trip_s):
    clock = Clock()
    flow = VideoFlow(lambda: None, clock)
    link = Link(flow, clock, round_trip_s)
    link.film(link_bit_rate, 20)
    assert link.film(link_bit_rate, 20) > 0.6 * 20 * link_bit_rate
    link.film(1.5e6, 10)
    assert flow.rate.bit_rate < 2e6
    link.film(20e6, 40)
    assert flow.rate.bit_rate == MAX_BIT_RATE


def test_what_a_page_says_keeps_the_rate_within_its_bounds():
    rng, clock = np.random.default_rng(0), Clock()
    rate = RateControl(clock)
    for _ in range(5000):
        clock.now_s += rng.exponential(0.05)
        if rng.random() < 0.3:
            rate.stalled()
        else:
            rate.acknowledged(int(rng.integers(0, 10**6)), rng.exponential(0.2))
        assert MIN_BIT_RATE <= rate.bit_rate <= MAX_BIT_RATE


# Flows.

@pytest.mark.parametrize('seed', range(20))
def test_what_a_browser_gets_it_can_decode(seed):
    """Whatever it acknowledges: but before a key picture nothing is missing."""
    rng, clock = np.random.default_rng(seed), Clock()
    flow = VideoFlow(lambda: None, clock)
    got, last_got = 0, None
    for sequence in range(1, 1000):
        clock.now_s += PERIOD_S
        key = flow.needs_key or rng.random() < 0.01
        flow.offer(sequence, replace(picture(sequence), chunk='key' if key else 'delta'))
        if rng.random() < 0.9 and (numbered := flow.next_picture()):
            got += 1
            assert numbered[1].chunk == 'key' or numbered[0] == last_got + 1
            last_got = numbered[0]
        if rng.random() < 0.2:
            flow.acknowledge(int(rng.choice([sequence - 2, 0, 2**52, last_got or 0])))
        if rng.random() < 0.02:
            flow.lose_step()
    assert got > 100


def test_who_acknowledges_nothing_gets_no_more():
    clock = Clock()
    flow = VideoFlow(lambda: None, clock)
    sent = 0
    for sequence in range(10_000):
        clock.now_s += 0.001
        flow.offer(sequence, replace(picture(sequence), chunk='key'))
        sent += flow.next_picture() is not None
    assert 0 < sent <= MAX_VIDEO_UNDRAWN
