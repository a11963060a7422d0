# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The operator's video in a browser: which picture is shown, how it looks, and what goes wrong."""

import base64
from dataclasses import replace
from itertools import islice
from pathlib import Path

import cv2
import numpy as np
import pytest
from sph_stab_ros.geometry.equirect import bearing_grid
from sph_stab_ros.geometry.warp import rotate_equirect, view_rotation

pytest.importorskip('rclpy', reason='rclpy is not installed')
pytest.importorskip('aiohttp', reason='aiohttp is not installed')
pytest.importorskip('av', reason='PyAV is not installed')
from encoded_video import encode, message  # noqa: E402, I100
from operator_harness import wait_until  # noqa: E402
from operator_served import Served  # noqa: E402
from operator_site import IDENTITY  # noqa: E402
from sph_stab_ros.operator import rate_control  # noqa: E402
from sph_stab_ros.operator.camera_pictures import Packets  # noqa: E402
from sph_stab_ros.operator.pairing import Orientation, Picture  # noqa: E402
from sph_stab_ros.operator.video import Video  # noqa: E402
from sph_stab_ros.recording import decoded_frames, open_recording  # noqa: E402

LEVELS = 5
# By how much what is drawn may be off, and now and then video for a slow browser or link.
EXACT, COARSE = 6, 15
# Called by whoever has just drawn: what is on the canvas, and what it is said to be.
PROBE = """() => {
    const place = document.getElementById('picture'), canvas = place.querySelector('canvas');
    window.drawn = [];
    new MutationObserver(() => {
        const {width, height} = canvas;
        const {data} = canvas.getContext('2d').getImageData(width >> 1, height >> 1, 1, 1);
        window.drawn.push([Number(place.dataset.stampNs), data[0], data[1], data[2]]);
    }).observe(place, {attributeFilter: ['data-stamp-ns']});
}"""
PIXELS = "document.querySelector('#picture canvas').toDataURL().split(',')[1]"


def warn(kind, text):
    """Fail: nothing here is to be warned of."""
    raise AssertionError(text)


class Filmed(Served):
    """Serves a film as video, picture after picture; stamps are their numbers."""

    def __init__(self, files, video=True, **options):
        super().__init__(video=Video(warn) if video else None, **options)
        self.files, self.number, self.last = files, 0, None

    def picture(self, now_s):
        """Return the next picture, or the last one again, with an orientation of its own."""
        if self.number != self.last:
            self.number += 1
        return Picture(self.number, self.files[self.number % len(self.files)], now_s,
                       Orientation(tuple(turned(self.number).as_quat().tolist()), IDENTITY))


def turned(number):
    """Return the R_world_camera of a picture."""
    return view_rotation(np.deg2rad(40) * (number % LEVELS), 0)


def spheres():
    """
    Return files of a world as the turning camera sees it, with a disc straight ahead of its begin.

    The disc has another grey level in each. Who draws one of them with the orientation of another
    draws it elsewhere, and who says that it were another draws the wrong level.
    """
    files = []
    for n in range(LEVELS):
        world = np.full((256, 512, 3), 20, np.uint8)
        world[np.arccos(bearing_grid(512)[..., 2]) < 0.2] = level(n)
        files.append(cv2.imencode('.jpg', rotate_equirect(world, turned(n)))[1].tobytes())
    return files


def level(number):
    """Return the grey level of the disc in a picture."""
    return 70 + 35 * (number % LEVELS)


def off(drawn):
    """Return by how many grey levels each of what was drawn is off, in its worst channel."""
    return [np.abs(np.subtract(rgb, level(number))).max() for number, *rgb in drawn]


def figure(page, name):
    """Return the text of a figure of the link."""
    return page.page.text_content(f'[data-figure={name}]')


@pytest.mark.parametrize('query', ['', '?video=jpeg'])
def test_every_picture_is_drawn_with_its_own_stamp_and_orientation(opened, query):
    with Filmed(spheres()) as served:
        page = opened(served.url + '/' + query)
        page.wait_for_situation('stabilized')
        page.page.evaluate(PROBE)
        wait_until(lambda: page.page.evaluate('window.drawn.length') > 40, page.situation)
        drawn = page.page.evaluate('window.drawn')
        # A browser that has little time is given pictures of half the width.
        assert figure(page, 'what').startswith('JPEG' if query else 'H.264')
    numbers = [number for number, *_ in drawn]
    assert numbers == sorted(set(numbers))
    assert max(off(drawn)) <= (EXACT if query else COARSE)
    assert np.median(off(drawn)) <= EXACT


class Passed(Filmed):
    """Serves the film as the video of a camera, in its usual range of values, and as files."""

    def __init__(self):
        images = [cv2.imdecode(np.frombuffer(file, np.uint8), cv2.IMREAD_COLOR)
                  for file in spheres()]
        packets = encode(images, 'h264', LEVELS)
        super().__init__([cv2.imencode('.jpg', image)[1].tobytes() for image in images])
        self._packets, self._stream = packets, Packets()

    def picture(self, now_s):
        """Return the next picture, with the packet that it is in the camera's video."""
        picture = super().picture(now_s)
        packet = self._stream.add(message(self._packets[self.number % LEVELS][1]))
        return replace(picture, packet=packet)


def test_a_camera_s_own_video_is_drawn_as_it_is(opened):
    """With its own stamp and orientation, and in its own colours."""
    with Passed() as served:
        page = opened(served.url)
        wait_until(lambda: served.robot and served.robot.needs_files is False, page.situation)
        page.wait_for_situation('stabilized')
        page.page.evaluate(PROBE)
        wait_until(lambda: page.page.evaluate('window.drawn.length') > 40, page.situation)
        drawn = page.page.evaluate('window.drawn')
        assert served.robot.needs_files is False
        assert figure(page, 'what') == 'H.264, 512×256'
    assert max(off(drawn)) <= EXACT


def test_the_page_says_what_pictures_come_as(opened):
    """And shows more of it when it is unfolded."""
    with Filmed(spheres()) as served:
        page = opened(served.url)
        wait_until(lambda: 'H.264 video' in page.page.text_content('#link'))
        page.page.click('#link-panel summary')
        for name in ('what', 'mbit_s', 'drawn', 'dropped', 'round_trip_ms'):
            wait_until(lambda: figure(page, name)[0].isalnum(), page.situation)
            assert page.page.is_visible(f'[data-figure={name}]')
        # These stamps are of no clock.
        assert figure(page, 'latency_ms') == '–'
    with Filmed(spheres(), video=False) as served:
        page = opened(served.url)
        page.wait_for_situation('stabilized')
        wait_until(lambda: 'it needs PyAV' in page.page.text_content('#link'), page.situation)
        wait_until(lambda: figure(page, 'what') == 'JPEG, 512×256', page.situation)


def test_ages_are_by_the_server_s_clock_and_gaps_are_pictures_left_out(opened):
    with Filmed(spheres()) as served:
        figures = opened(served.url).page.evaluate("""async () => {
            const {LinkFigures} = await import('/link_figures.js');
            // The server's clock is ahead by 5 s; one way of the second round trip was slow.
            let now = 1e12;
            const figures = new LinkFigures(() => now);
            for (const [there, back] of [[20, 20], [20, 400]]) {
                const sent_ms = now, server_ms = now + there + 5000;
                now += there + back;
                figures.echoed({sent_ms, server_ms});
            }
            for (const sequence of [7, 8, 13]) {
                now += 33;
                const stamp_ns = String(BigInt(now + 5000 - 120) * 1000000n);
                figures.drawn({sequence, stamp_ns, chunk: 'key', width: 64, height: 32});
            }
            figures.received(1e6);
            return figures.figures();
        }""")
    assert figures == {
        'what': 'H.264, 64×32', 'mbit_s': 4, 'drawn': 1.5, 'dropped': 2, 'latency_ms': 120,
        'latency_p95_ms': 120, 'round_trip_ms': 420}


def test_a_broken_decoder_goes_on_with_a_key_picture(opened):
    with Filmed(spheres()) as served:
        page = opened(served.url)
        page.wait_for_situation('stabilized')
        page.page.evaluate("""() => {
            const {decode} = VideoDecoder.prototype;
            VideoDecoder.prototype.decode = function () {
                VideoDecoder.prototype.decode = decode;
                throw new Error('broken');
            };
        }""")
        page.page.evaluate(PROBE)
        wait_until(lambda: page.page.evaluate('window.drawn.length') > 10, page.situation)
        assert figure(page, 'what') == 'H.264, 512×256'


def test_a_browser_that_cannot_after_all_gets_files(opened):
    with Filmed(spheres()) as served:
        page = opened(served.url)
        page.page.evaluate(
            '() => { VideoDecoder.prototype.decode = () => { throw new Error("broken"); }; }')
        wait_until(lambda: figure(page, 'what') == 'JPEG, 512×256', page.situation)
        page.wait_for_situation('stabilized')
        page.wait_for_picture_after(page.stamp_ns)
        wait_until(lambda: 'come as JPEG' in page.page.text_content('#link'), page.situation)


@pytest.mark.slow
@pytest.mark.parametrize('recording', [
    'bags/drone', '../shared/data/car_overpass/car_overpass.mp4'])
def test_what_is_drawn_is_like_the_raw_picture(opened, recording, monkeypatch):
    """In the middle of a film, and at half of the bits that there may be."""
    for bound in ('MIN_BIT_RATE', 'MAX_BIT_RATE'):
        monkeypatch.setattr(rate_control, bound, 4e6)
    path = Path(__file__).resolve().parents[2] / recording
    if not path.exists():
        pytest.skip(f'there is no {recording}')
    images = [cv2.resize(frame.image, (1920, 960))
              for frame in islice(decoded_frames(open_recording(path)), 60)]
    views = []
    for query, files in (('', [cv2.imencode('.jpg', image)[1].tobytes() for image in images]),
                         ('?video=jpeg', [cv2.imencode('.png', images[-1])[1].tobytes()])):
        with Filmed(files) as served:
            served.last = 59
            page = opened(served.url + '/' + query)
            wait_until(lambda: page.stamp_ns == 59, page.situation)
            png = base64.b64decode(page.page.evaluate(PIXELS))
            views.append(cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR))
    assert ssim(*(view.astype(float) for view in views)) >= 0.93


def ssim(a, b):
    """Return the mean structural similarity of two images, of 255 levels (Wang et al. 2004)."""
    def blurred(image):
        return cv2.GaussianBlur(image, (11, 11), 1.5)
    mean_a, mean_b = blurred(a), blurred(b)
    var_a, var_b = blurred(a * a) - mean_a ** 2, blurred(b * b) - mean_b ** 2
    covariance = blurred(a * b) - mean_a * mean_b
    c1, c2 = (0.01 * 255) ** 2, (0.03 * 255) ** 2
    return float(np.mean((2 * mean_a * mean_b + c1) * (2 * covariance + c2)
                         / ((mean_a ** 2 + mean_b ** 2 + c1) * (var_a + var_b + c2))))
