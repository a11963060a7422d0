# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What surrounds the operator's page: camera, stabilizer and server as on a robot, a browser."""

from contextlib import contextmanager
import os
from pathlib import Path
import re
import shutil
import signal
import subprocess
import sys
from threading import Event, Thread
import time

import cv2
from geometry_msgs.msg import QuaternionStamped
from node_harness import DOMAINS, leave, rotation
import numpy as np
import pytest
import rclpy
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.time import Time
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import CompressedImage
from sph_stab_ros.geometry.equirect import bearing_grid
from sph_stab_ros.geometry.warp import rotate_equirect, view_rotation
from sph_stab_ros.images.codec import fill_compressed
from tiny_recordings import textured_sphere

TIMEOUT_S = 30.
TOKEN = 'sesame'
WIDTH = 512
DISC_RAD = 0.06
# WebGL in software where there is no graphics card, however long that takes on a busy machine; no
# connections of the browser's own.
CHROMIUM_FLAGS = (
    '--no-sandbox', '--disable-quic', '--no-first-run', '--disable-background-networking',
    '--disable-component-update', '--disable-sync',
    '--enable-unsafe-swiftshader', '--disable-gpu-watchdog')


def find_chromium():
    """Return the path of a Chromium or Chrome, or skip the test."""
    for name in (os.environ.get('CHROMIUM', ''), 'chromium', 'chromium-browser', 'google-chrome'):
        if name and (path := shutil.which(name)):
            return path
    return pytest.skip('there is no chromium here')


@contextmanager
def chromium():
    """Give a headless browser."""
    playwright = pytest.importorskip('playwright.sync_api', reason='playwright is not installed')
    path = find_chromium()
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=path, args=CHROMIUM_FLAGS)
        try:
            yield browser
        finally:
            browser.close()


def world_with_disc():
    """Return a sphere with texture, and a disc straight ahead that is brighter than all else."""
    world = np.uint8(40 + textured_sphere(WIDTH) * 0.45)
    world[np.arccos(bearing_grid(WIDTH)[..., 2]) < DISC_RAD] = 255
    return world


class Robot:
    """
    Camera, stabilizer and operator's server in a ROS domain of their own.

    The camera turns as told by ``turn`` and publishes at 15 Hz, in a thread, while it is on.
    """

    RATE_HZ = 15.

    def __init__(self, folder):
        self._folder = folder
        self._domain = next(DOMAINS)
        self._processes = {}
        self._context = Context()
        rclpy.init(context=self._context, domain_id=self._domain)
        self._node = rclpy.create_node('camera', context=self._context)
        self._images = self._node.create_publisher(CompressedImage, 'image/compressed', 10)
        self.looks, self.orientations = [], []
        for topic, received in (('view/direction', self.looks),
                                ('orientation', self.orientations)):
            self._node.create_subscription(
                QuaternionStamped, topic, lambda msg, to=received: to.append(rotation(msg)), 10)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._world = world_with_disc()
        self._stamp_ns = 10**18
        self._ending = Event()
        self.turn(0)
        self._threads = [Thread(target=self._spin), Thread(target=self._film)]
        for thread in self._threads:
            thread.start()

    def close(self):
        """End everything."""
        self._ending.set()
        for thread in self._threads:
            thread.join()
        for name in tuple(self._processes):
            self.stop(name)
        leave(self._node, self._executor)

    def _spin(self):
        while not self._ending.is_set():
            self._executor.spin_once(timeout_sec=0.05)

    def _film(self):
        while not self._ending.wait(1 / self.RATE_HZ):
            self._stamp_ns += round(1e9 / self.RATE_HZ)
            msg = CompressedImage(format=self._image.format)
            msg.data.frombytes(self._image.data)
            msg.header.stamp = Time(nanoseconds=self._stamp_ns).to_msg()
            msg.header.frame_id = 'camera'
            self._images.publish(msg)

    def turn(self, yaw_deg, roll_deg=0):
        """Turn the camera to the left of where it looked first; return the stamp then, in ns."""
        R_world_camera = view_rotation(np.deg2rad(yaw_deg), 0, np.deg2rad(roll_deg))
        self.film(rotate_equirect(self._world, R_world_camera))
        return self._stamp_ns

    def film(self, image):
        """Publish an image from now on."""
        self._image = fill_compressed(CompressedImage(), image)

    def start(self, module, *arguments, ros_arguments=()):
        """Start an executable of the package; its output is ``output(module)``."""
        with open(self._folder / f'{module}.log', 'w') as log:
            self._processes[module] = subprocess.Popen(
                [sys.executable, '-m', f'sph_stab_ros.{module}', *arguments,
                 '--ros-args', *ros_arguments],
                env={**os.environ, 'ROS_DOMAIN_ID': str(self._domain)}, stdout=log, stderr=log)

    def start_stabilizer(self):
        """Start the node."""
        self.start('stabilizer', ros_arguments=('-p', 'image_transport:=compressed'))

    def start_operator(self, port=0):
        """Start the server with the TOKEN; return the page's address."""
        token_file = self._folder / 'token'
        token_file.write_text(TOKEN + '\n')
        self.start('operator', '--port', str(port), '--token-file', str(token_file))
        wait_until(lambda: 'http' in self.output('operator'), lambda: self.output('operator'))
        return self.output('operator').split()[-1]

    def send_signal(self, module, number):
        """Send a signal to one of the processes."""
        self._processes[module].send_signal(number)

    def stop(self, module, number=signal.SIGINT):
        """End a process; return its exit status."""
        process = self._processes.pop(module)
        process.send_signal(number)
        try:
            return process.wait(TIMEOUT_S)
        except subprocess.TimeoutExpired:
            process.kill()
            raise

    def output(self, module):
        """Return what a process has written."""
        return Path(self._folder / f'{module}.log').read_text()


def wait_until(condition, explain=lambda: ''):
    """Wait until a condition holds; return its value."""
    end_s = time.monotonic() + TIMEOUT_S
    while not (value := condition()):
        assert time.monotonic() < end_s, f'waited in vain: {explain()}'
        time.sleep(0.02)
    return value


class Page:
    """The page in a browser, seen by its pixels."""

    SIZE_WH = 1100, 600
    # Between the instruments above, below and to the left.
    CLIP = {'x': 150, 'y': 165, 'width': 950, 'height': 200}
    FOV_DEG = 100.

    def __init__(self, browser, address, **options):
        width, height = self.SIZE_WH
        self.context = browser.new_context(
            viewport={'width': width, 'height': height}, color_scheme='dark', **options)
        self.page = self.context.new_page()
        self.page.set_default_timeout(1e3 * TIMEOUT_S)
        self.errors, self.requests = [], []
        self.page.on('pageerror', lambda error: self.errors.append(str(error)))
        self.page.on('request', lambda request: self.requests.append(request.url))
        self.answer = self.page.goto(address)

    @property
    def stamp_ns(self):
        """Return the stamp of the picture on display, in ns."""
        return int(self.page.get_attribute('#picture', 'data-stamp-ns') or 0)

    def situation(self):
        """Return what the page says of itself, for messages."""
        return ' | '.join((*self.page.inner_text('body').split('\n'), *self.errors))

    def wait_for_situation(self, name):
        """Wait until the page says how things are."""
        # Playwright's own waiting evaluates strings in the page, whose policy forbids that.
        wait_until(lambda: self.page.get_attribute('html', 'data-situation') == name,
                   self.situation)

    def wait_for_picture_after(self, stamp_ns):
        """Wait until a picture later than a stamp is on display."""
        wait_until(lambda: self.stamp_ns > stamp_ns, self.situation)

    def disc(self):
        """Return where the bright disc is on the screen, in pixels from the centre (x, y)."""
        shot = self.page.screenshot(clip=self.CLIP)
        grey = cv2.imdecode(np.frombuffer(shot, np.uint8), cv2.IMREAD_GRAYSCALE)
        v, u = np.nonzero(grey > 0.85 * grey.max())
        assert 20 < u.size < 5000, 'no disc in the picture'
        return (u.mean() + self.CLIP['x'] - (self.SIZE_WH[0] - 1) / 2,
                v.mean() + self.CLIP['y'] - (self.SIZE_WH[1] - 1) / 2)

    def disc_deg(self):
        """Return how far the disc is to the right of the centre of the view."""
        focal_px = self.SIZE_WH[0] / 2 / np.tan(np.deg2rad(self.FOV_DEG / 2))
        return np.rad2deg(np.arctan(self.disc()[0] / focal_px))

    def number(self, element):
        """Return the number that an element's text begins with, or None."""
        number = re.match('[0-9]+', self.page.inner_text(f'#{element}'))
        return number and int(number.group())

    def heading_deg(self):
        """Return the heading on the scale, within −180 and 180."""
        return (self.number('heading') + 180) % 360 - 180


def yaw_deg(R):
    """Return the yaw of a rotation, positive to the left."""
    x, _, z = (R * Rotation.identity()).apply((0, 0, 1))
    return -np.rad2deg(np.arctan2(x, z))
