# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What the page draws, with a graphics card and without, against the package's own warp."""

from base64 import b64decode, b64encode
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from importlib import resources
from threading import Thread

import cv2
import numpy as np
import pytest
from sph_stab_ros.geometry.warp import perspective_view, view_rotation
from tiny_recordings import textured_sphere

pytest.importorskip('rclpy', reason='rclpy is not installed')
from operator_harness import chromium  # noqa: E402, I100

WIDTH = 512
# No multiples of a tile; upright as a telephone, too.
SIZES_WH = (203, 117), (90, 161)
# Yaw, pitch, field of view of the longer side: ahead, across the seam, the poles, near and far.
LOOKS_DEG = [(0, 0, 100), (177, 12, 100), (40, 90, 100), (-100, -80, 140), (10, 30, 25)]
RENDERERS = ('sphere_renderer.js', 'SphereRenderer'), ('software_renderer.js', 'SoftwareRenderer')
DRAW = """async ([module, name, file, size, looks]) => {
    const {decode} = await import('/decoder.js'), {[name]: Renderer} = await import('/' + module);
    const {fromYawPitch, matrix, radians} = await import('/rotation.js');
    const canvas = document.createElement('canvas');
    [canvas.width, canvas.height] = size;
    const renderer = new Renderer(canvas), drawn = [];
    // The second time memory and textures are there already.
    for (let n = 0; n < 2; n++) {
        renderer.load(await decode(Uint8Array.from(atob(file), one => one.charCodeAt(0))));
        for (const [yaw, pitch, fov] of looks) {
            renderer.draw(matrix(fromYawPitch(radians(yaw), radians(pitch))), radians(fov));
            drawn.push(canvas.toDataURL('image/png').split(',')[1]);
        }
    }
    return drawn;
}"""
FILES = {'jpeg': ('.jpg', (cv2.IMWRITE_JPEG_QUALITY, 95)), 'png': ('.png', ())}
if hasattr(cv2, 'IMWRITE_JPEG_SAMPLING_FACTOR'):
    FILES['jpeg with all of its chroma'] = '.jpg', (
        cv2.IMWRITE_JPEG_QUALITY, 95,
        cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444)


class Handler(SimpleHTTPRequestHandler):
    """Serves files without a word."""

    def log_message(self, *_):
        """Say nothing."""


@pytest.fixture(scope='module')
def page():
    folder = resources.files('sph_stab_ros.operator') / 'page'
    server = ThreadingHTTPServer(('127.0.0.1', 0), partial(Handler, directory=folder))
    Thread(target=server.serve_forever).start()
    try:
        with chromium() as browser:
            page = browser.new_page()
            page.goto(f'http://127.0.0.1:{server.server_port}/icon.svg')
            # A document without the page's own scripts.
            page.goto(f'http://127.0.0.1:{server.server_port}/nothing')
            yield page
    finally:
        server.shutdown()
        server.server_close()


@pytest.mark.parametrize('size_wh', SIZES_WH, ids=str)
@pytest.mark.parametrize('kind', FILES)
@pytest.mark.parametrize('module, name', RENDERERS, ids=[name for _, name in RENDERERS])
def test_views_are_those_of_the_package(page, module, name, kind, size_wh):
    suffix, options = FILES[kind]
    file = cv2.imencode(suffix, textured_sphere(WIDTH), options)[1]
    image = cv2.imdecode(file, cv2.IMREAD_COLOR)
    drawn = page.evaluate(DRAW, [module, name, b64encode(file).decode(), size_wh, LOOKS_DEG])
    assert len(drawn) == 2 * len(LOOKS_DEG)
    for shown, (yaw_deg, pitch_deg, fov_deg) in zip(drawn, 2 * LOOKS_DEG):
        shown = cv2.imdecode(np.frombuffer(b64decode(shown), np.uint8), cv2.IMREAD_COLOR)
        focal_px = max(size_wh) / 2 / np.tan(np.deg2rad(fov_deg) / 2)
        expected = perspective_view(
            image, view_rotation(*np.deg2rad((yaw_deg, pitch_deg))),
            2 * np.arctan(size_wh[0] / 2 / focal_px), size_wh)
        assert shown.shape == expected.shape
        grey, colours = (
            cv2.blur(np.abs(a.astype(np.float32) - b), (9, 9))
            for a, b in ([cv2.cvtColor(one, cv2.COLOR_BGR2GRAY) for one in (shown, expected)],
                         (shown, expected)))
        # No tile, seam or pole is somewhere else; chroma may be the nearest sample's.
        assert grey.max() < 4, (yaw_deg, pitch_deg, fov_deg)
        assert colours.mean() < 8, (yaw_deg, pitch_deg, fov_deg)
