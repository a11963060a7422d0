# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
"""What the operator's page keeps: recordings on the robot, snapshots in the browser."""

import asyncio
from collections import namedtuple
from datetime import datetime
import os
import shutil
import signal
import subprocess
import sys
from threading import Event

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from sph_stab_ros.geometry.warp import view_rotation
from sph_stab_ros.recording import decoded_frames, open_recording

pytest.importorskip('rclpy', reason='rclpy is not installed')
pytest.importorskip('aiohttp', reason='aiohttp is not installed')
from operator_harness import DISC_RAD, wait_until, world_with_disc  # noqa: E402, I100
from operator_served import Served, State  # noqa: E402
from operator_site import IDENTITY, served, striped_jpeg  # noqa: E402
from sph_stab_ros.operator import recorder as recorder_module  # noqa: E402
from sph_stab_ros.operator.pairing import Orientation, Picture  # noqa: E402
from sph_stab_ros.operator.recorder import MAX_WAITING, Recorder  # noqa: E402
from sph_stab_ros.operator.robot_interface import RobotError  # noqa: E402

T0_NS = 10**18
Usage = namedtuple('Usage', 'free')
# Records until somebody kills it; says when it has given a number of pictures to the disk.
CRASHING = """
import asyncio
from pathlib import Path
import sys
from sph_stab_ros.operator.recorder import MAX_WAITING, Recorder
from test_operator_recorder import numbered, settle
recorder = Recorder(Path(sys.argv[1]), print)
asyncio.run(recorder.record(True))
for n in range(200):
    recorder.take(numbered(n))
    if n % MAX_WAITING == 0:
        settle(recorder)
settle(recorder)
print('written', flush=True)
input()
"""


def numbered(n):
    """Return a Picture, and its orientation, by which one knows its number."""
    R = view_rotation(np.deg2rad(n), 0)
    return Picture(T0_NS + n * 10**8, striped_jpeg(n, 256), 0.,
                   Orientation(tuple(R.as_quat().tolist()), IDENTITY))


def said(kind, text):
    """Fail: there is nothing to warn of."""
    raise AssertionError(text)


def settle(recorder):
    """Wait until all is written that a Recorder has; it refuses what it does already."""
    with pytest.raises(RobotError, match='already'):
        asyncio.run(recorder.record(True))


def check(bag, at_least=0):
    """Check that a bag has the pictures from the first one on, each with its orientation."""
    recording = open_recording(bag, '/image/compressed')
    stamps_ns = [frame.stamp_ns for frame in decoded_frames(recording)]
    assert stamps_ns == [numbered(n).stamp_ns for n in range(len(stamps_ns))]
    assert len(stamps_ns) >= at_least
    for topic in ('/orientation', '/virtual_orientation'):
        messages = [msg for _, msg in recording.messages(topic)]
        # In the last part that is whole either may be the last.
        assert abs(len(messages) - len(stamps_ns)) <= 1
        for n, msg in enumerate(messages):
            q = msg.quaternion
            R = view_rotation(np.deg2rad(n), 0) if topic == '/orientation' else \
                Rotation.identity()
            assert (Rotation.from_quat([q.x, q.y, q.z, q.w]) * R.inv()).magnitude() < 1e-9
    return len(stamps_ns)


def test_a_recording_has_every_picture_with_its_orientation(tmp_path):
    recorder = Recorder(tmp_path / 'new', said)
    recorder.take(numbered(100))
    assert recorder.name == ''
    assert asyncio.run(recorder.record(True)).startswith('Recording ')
    bag = tmp_path / 'new' / recorder.name
    for n in range(10):
        recorder.take(numbered(n))
    assert str(bag) in asyncio.run(recorder.record(False))
    assert recorder.name == ''
    recorder.take(numbered(100))
    assert check(bag) == 10
    with pytest.raises(RobotError, match='Nothing is being recorded'):
        asyncio.run(recorder.record(False))
    recorder.close()


def test_the_end_of_the_server_ends_a_recording(tmp_path):
    recorder = Recorder(tmp_path, said)
    asyncio.run(recorder.record(True))
    for n in range(10):
        recorder.take(numbered(n))
    recorder.close()
    bag, = tmp_path.iterdir()
    assert check(bag) == 10


def test_a_killed_recorder_leaves_what_it_has_recorded(tmp_path):
    """All but what waits for its part to be whole, of a megabyte."""
    with subprocess.Popen(
            [sys.executable, '-c', CRASHING, str(tmp_path)], text=True,
            stdin=subprocess.PIPE, stdout=subprocess.PIPE,
            env={**os.environ, 'PYTHONPATH': os.pathsep.join(sys.path)}) as process:
        assert process.stdout.readline() == 'written\n'
        process.send_signal(signal.SIGKILL)
    bag, = tmp_path.iterdir()
    lost_at_most = 2**20 // len(numbered(0).data) + 2
    assert check(bag, at_least=200 - lost_at_most) < 200


def test_a_full_disk_is_told_and_ends_a_recording(tmp_path, monkeypatch):
    warnings = []
    recorder = Recorder(tmp_path, lambda kind, text: warnings.append(text))
    asyncio.run(recorder.record(True))
    bag = tmp_path / recorder.name
    recorder.take(numbered(0))
    settle(recorder)
    monkeypatch.setattr(shutil, 'disk_usage', lambda path: Usage(10**8))
    recorder.take(numbered(1))
    wait_until(lambda: not recorder.name)
    # Behind what the thread does to the bag's end.
    with pytest.raises(RobotError, match='Nothing is being recorded'):
        asyncio.run(recorder.record(False))
    assert warnings == ['The recording has ended: No space left on device.']
    assert [recorder.pop_failure(), recorder.pop_failure()] == [warnings[0], '']
    assert check(bag) == 1
    with pytest.raises(RobotError, match='Not recorded: No space left on device.'):
        asyncio.run(recorder.record(True))
    recorder.close()


def test_where_nothing_can_be_written_that_is_told(tmp_path):
    file = tmp_path / 'file'
    file.touch()
    recorder = Recorder(file, said)
    with pytest.raises(RobotError, match='Not recorded: File exists.'):
        asyncio.run(recorder.record(True))
    recorder.close()


def test_a_slow_disk_loses_pictures_not_memory(tmp_path, monkeypatch):
    warnings, goes_on = [], Event()
    recorder = Recorder(tmp_path, lambda kind, text: warnings.append(text))
    asyncio.run(recorder.record(True))
    bag = tmp_path / recorder.name
    write_picture = recorder_module.write_picture

    def write_slowly(*args):
        assert goes_on.wait(60)
        write_picture(*args)

    monkeypatch.setattr(recorder_module, 'write_picture', write_slowly)
    for n in range(MAX_WAITING):
        recorder.take(numbered(n))
    assert not warnings
    recorder.take(numbered(n + 1))
    assert warnings == ['picture not recorded: the disk is too slow']
    goes_on.set()
    asyncio.run(recorder.record(False))
    assert check(bag) == MAX_WAITING
    recorder.close()


async def watched_by(site, count):
    """Wait until so many browsers are reported to the robot."""
    while len(site.robot.watchers) != count:
        await asyncio.sleep(0.05)


def test_who_has_control_records_on_the_robot(tmp_path):
    """Everybody is told, and it goes on also when nobody is left."""
    @served(recordings=tmp_path)
    async def run(site):
        steering, watching = await site.connect(), await site.connect()
        await steering.control('yours')
        await watching.send('record', on=True)
        assert not (await watching.receive('notice'))['ok']
        await steering.send('record', on=True)
        assert (await steering.receive('notice'))['text'].startswith('Recording ')
        state = await watching.receive('state', lambda state: state['recording'])
        assert [bag.name for bag in tmp_path.iterdir()] == [state['recording']]
        site.server.show(numbered(0))
        await watched_by(site, 2)
        for browser in (steering, watching):
            await browser.socket.close()
        await watched_by(site, 0)
        assert site.robot.watched
        site.server.show(numbered(1))
    run()
    bag, = tmp_path.iterdir()
    assert check(bag) == 2


def test_everybody_is_told_of_a_recording_that_ends_by_itself(tmp_path, monkeypatch):
    @served(recordings=tmp_path)
    async def run(site):
        steering, watching = await site.connect(), await site.connect()
        await steering.control('yours')
        await steering.send('record', on=True)
        await watching.receive('state', lambda state: state['recording'])
        monkeypatch.setattr(shutil, 'disk_usage', lambda path: Usage(10**8))
        site.server.show(numbered(0))
        for browser in (steering, watching):
            await browser.receive('notice', lambda notice: 'has ended' in notice['text'])
            await browser.receive('state', lambda state: not state['recording'])
    run()


def pad(page, button, pressed):
    """Give a page a gamepad of which a button is pressed, or let go."""
    page.page.evaluate("""([button, pressed]) => {
        const buttons = Array.from({length: 17}, () => ({pressed: false, value: 0}));
        buttons[button].pressed = pressed;
        const pad = {mapping: 'standard', index: 0, axes: [0, 0, 0, 0], buttons};
        navigator.getGamepads = () => [pad];
        dispatchEvent(new Event('gamepadconnected'));
    }""", [button, pressed])


def see_two(page):
    """Wait for two more pictures: one may have been on its way before."""
    for _ in range(2):
        page.wait_for_picture_after(page.stamp_ns)


def test_recordings_by_button_keyboard_and_gamepad(opened, tmp_path):
    with Served(recordings=tmp_path) as served:
        page = opened(served.url)
        page.wait_for_situation('stabilized')

        def is_recording():
            return page.page.get_attribute('#record', 'aria-pressed') == 'true'

        page.page.click('#record')
        wait_until(is_recording)
        see_two(page)
        bag, = tmp_path.iterdir()
        assert bag.name in page.page.get_attribute('#record', 'title')
        page.page.keyboard.press('v')
        wait_until(lambda: not is_recording())
        wait_until(lambda: 'Recorded: ' in page.page.text_content('#notice'))
        # Its name is the second's in which it begins.
        wait_until(lambda: f'{datetime.now():%Y-%m-%d_%H-%M-%S}' != bag.name)
        pad(page, 8, True)
        wait_until(is_recording)
        pad(page, 8, False)
        see_two(page)
        assert len(list(tmp_path.iterdir())) == 2
        served.state = State(tracking='')
        page.page.keyboard.press('v')
        wait_until(lambda: not is_recording())
    for one in tmp_path.iterdir():
        assert next(decoded_frames(open_recording(one))).image.shape == (64, 128, 3)


@pytest.mark.parametrize('query', ['', '?renderer=webgl'])
@pytest.mark.parametrize('by', ['button', 'keyboard', 'gamepad'])
def test_a_snapshot_is_what_is_on_the_screen(opened, tmp_path, by, query):
    with Served() as served:
        served.file = cv2.imencode('.jpg', world_with_disc())[1].tobytes()
        page = opened(served.url + '/' + query)
        page.wait_for_situation('stabilized')
        served.on = False
        page.wait_for_situation('silent')
        wait_until(lambda: page.stamp_ns == served.last_ns)
        with page.page.expect_download() as download:
            if by == 'button':
                page.page.click('#snapshot')
            elif by == 'keyboard':
                page.page.keyboard.press('p')
            else:
                pad(page, 3, True)
        name = download.value.suggested_filename
        download.value.save_as(tmp_path / name)
    ns = f'{served.last_ns:019d}'
    assert name == f"view_{ns[:-9].lstrip('0') or '0'}.{ns[-9:]}.png"
    image = cv2.imread(str(tmp_path / name), cv2.IMREAD_GRAYSCALE)
    height, width = image.shape
    assert width / height == pytest.approx(np.divide(*page.SIZE_WH), rel=0.01)
    v, u = np.nonzero(image > 0.85 * image.max())
    assert u.mean() == pytest.approx((width - 1) / 2, abs=2)
    assert v.mean() == pytest.approx((height - 1) / 2, abs=2)
    # Half of the view is 50°.
    radius = np.sqrt(u.size / np.pi) / (width / 2) * np.tan(np.deg2rad(50))
    assert radius == pytest.approx(np.tan(DISC_RAD), rel=0.1)


def test_without_a_picture_there_is_no_snapshot(opened):
    with Served() as served:
        served.on = False
        page = opened(served.url)
        page.wait_for_situation('silent')
        page.page.keyboard.press('p')
        wait_until(lambda: 'no picture' in page.page.text_content('#notice'))
