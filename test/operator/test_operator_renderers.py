# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What the page draws, with a graphics card and without, against the package's own warp."""

from base64 import b64decode, b64encode

import cv2
import numpy as np
import pytest
from sph_stab_ros.geometry.warp import perspective_view, view_rotation
from tiny_recordings import textured_sphere

pytest.importorskip('rclpy', reason='rclpy is not installed')
from bare_page import bare_page  # noqa: E402, I100
from graphics_cards import BLIND, NO_CARD, NO_MEMORY, SMALL_CARD  # noqa: E402

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


LOSE = """() => { window.lose = canvas =>
    canvas.getContext('webgl2').getExtension('WEBGL_lose_context').loseContext(); }"""
# Draws as the page does; tells what is on the canvas after each picture, and why it fell back.
PLAY = """async ([files, size, look, loseAfter]) => {
    const {Renderer} = await import('/renderer.js'), {decode} = await import('/decoder.js');
    const {fromYawPitch, matrix, radians} = await import('/rotation.js');
    const place = document.body, reasons = [], shown = [];
    const renderer = new Renderer(place, reason => reasons.push(reason));
    renderer.resize(...size);
    const [yaw, pitch, fov] = look.map(radians);
    for (const [n, file] of files.entries()) {
        renderer.load(await decode(Uint8Array.from(atob(file), one => one.charCodeAt(0)),
                                   renderer.maxColumns));
        const seen = renderer.draw(matrix(fromYawPitch(yaw, pitch)), fov);
        const drawn = place.firstElementChild.toDataURL('image/png').split(',')[1];
        shown.push([seen, renderer.slow, drawn]);
        if (n + 1 === loseAfter) {
            lose(place.firstElementChild);
            await new Promise(done => setTimeout(done, 300));
            const seen = renderer.draw(matrix(fromYawPitch(yaw, pitch)), fov);
            shown.push([seen, renderer.slow, drawn]);
        }
    }
    return [reasons, shown];
}"""


@pytest.fixture(scope='module')
def page():
    with bare_page('?renderer=webgl') as page:
        yield page


@pytest.mark.parametrize('size_wh', SIZES_WH, ids=str)
@pytest.mark.parametrize('kind', FILES)
@pytest.mark.parametrize('module, name', RENDERERS, ids=[name for _, name in RENDERERS])
def test_views_are_those_of_the_package(page, module, name, kind, size_wh):
    suffix, options = FILES[kind]
    file = cv2.imencode(suffix, textured_sphere(WIDTH), options)[1]
    image = cv2.imdecode(file, cv2.IMREAD_COLOR)
    drawn = page.evaluate(DRAW, [module, name, b64encode(file).decode(), size_wh, LOOKS_DEG])
    assert len(drawn) == 2 * len(LOOKS_DEG)
    for shown, look_deg in zip(drawn, 2 * LOOKS_DEG):
        grey, colours = differences(shown, image, look_deg, size_wh)
        # No tile, seam or pole is somewhere else; chroma may be the nearest sample's.
        assert grey.max() < 4, look_deg
        assert colours.mean() < 8, look_deg


def differences(shown, image, look_deg, size_wh):
    """Return how far what is shown is from the package's own view, in grey and in colours."""
    yaw_deg, pitch_deg, fov_deg = look_deg
    shown = cv2.imdecode(np.frombuffer(b64decode(shown), np.uint8), cv2.IMREAD_COLOR)
    focal_px = max(size_wh) / 2 / np.tan(np.deg2rad(fov_deg) / 2)
    expected = perspective_view(
        image, view_rotation(*np.deg2rad((yaw_deg, pitch_deg))),
        2 * np.arctan(size_wh[0] / 2 / focal_px), size_wh)
    assert shown.shape == expected.shape
    return [cv2.blur(np.abs(a.astype(np.float32) - b), (9, 9))
            for a, b in ([cv2.cvtColor(one, cv2.COLOR_BGR2GRAY) for one in (shown, expected)],
                         (shown, expected))]


@pytest.fixture
def fresh(page):
    """Return the document anew, in which nothing was changed."""
    page.goto(page.url)
    return page


def play(page, change, files, lose_after=0):
    """Play picture files in a browser that was changed; return the reasons, and what was shown."""
    page.evaluate(change)
    return page.evaluate(PLAY, [[b64encode(one).decode() for one in files], SIZES_WH[0],
                                LOOKS_DEG[0], lose_after])


def files_and_images(suffix='.jpg', count=4):
    images = [textured_sphere(WIDTH, seed) for seed in range(count)]
    files = [cv2.imencode(suffix, image)[1] for image in images]
    return files, [cv2.imdecode(one, cv2.IMREAD_COLOR) for one in files]


def is_right(shown, image, most=4):
    return differences(shown, image, LOOKS_DEG[0], SIZES_WH[0])[0].max() < most


@pytest.mark.parametrize('suffix', ['.jpg', '.png'])
def test_pictures_wider_than_the_card_takes_are_reduced(fresh, suffix):
    files, images = files_and_images(suffix)
    reasons, shown = play(fresh, SMALL_CARD, files)
    assert not reasons
    for (seen, slow, drawn), image in zip(shown, images):
        assert seen and not slow
        smaller = cv2.resize(image, (256, 128), interpolation=cv2.INTER_AREA)
        assert is_right(drawn, smaller, most=8)


def test_a_picture_that_was_not_reduced_is_drawn_by_the_processor(fresh):
    """A browser that does not know how leaves it as it is."""
    files, images = files_and_images()
    fresh.evaluate("""() => {
        const {createImageBitmap} = window;
        window.createImageBitmap = image => createImageBitmap(image);
    }""")
    reasons, shown = play(fresh, SMALL_CARD, files)
    assert reasons == [f'The graphics card takes 256 columns, not {WIDTH}.']
    assert all(seen and slow and is_right(drawn, image)
               for (seen, slow, drawn), image in zip(shown, images))


@pytest.mark.parametrize('change, reason', [
    (NO_CARD, 'This browser has no WebGL 2.'),
    (NO_MEMORY, 'The graphics card fails (WebGL error 1285).')])
def test_without_a_card_that_works_the_processor_draws(fresh, change, reason):
    files, images = files_and_images()
    reasons, shown = play(fresh, change, files)
    assert reasons == [reason]
    assert all(seen and slow and is_right(drawn, image)
               for (seen, slow, drawn), image in zip(shown, images))


def test_a_card_that_draws_nothing_is_given_up(fresh):
    """Until then nothing is said to be seen."""
    files, images = files_and_images()
    reasons, shown = play(fresh, BLIND, files)
    assert reasons == ['The graphics card draws nothing.']
    assert [seen for seen, _, _ in shown] == [False, False, False, True]
    assert is_right(shown[-1][2], images[-1])


def test_black_pictures_are_the_cards_no_fault(fresh):
    black = cv2.imencode('.jpg', np.zeros((WIDTH // 2, WIDTH, 3), np.uint8))[1]
    reasons, shown = play(fresh, '() => {}', [black] * 5)
    assert not reasons and all(seen for seen, _, _ in shown)


def test_a_context_that_is_lost_is_replaced_by_the_processor(fresh):
    """There is nothing to see until the next picture."""
    files, images = files_and_images()
    reasons, shown = play(fresh, LOSE, files, lose_after=2)
    assert reasons == ['The graphics card was taken away.']
    assert [(seen, slow) for seen, slow, _ in shown] == [
        (True, False), (True, False), (False, True), (True, True), (True, True)]
    for (_, _, drawn), image in zip([*shown[:2], *shown[3:]], images):
        assert is_right(drawn, image)
