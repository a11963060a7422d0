# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The node and the player with pictures that are not what the parameters say."""

import os
import re
import subprocess
import sys

import cv2
from dual_fisheye_frames import fisheye_picture
import numpy as np
import pytest
from sph_stab_ros.config import FisheyeConfig, LensConfig
from synthetic import textured_sphere
from tiny_recordings import stamps_of, write_bag

pytest.importorskip('rclpy', reason='rclpy is not installed')
from node_harness import DOMAINS, stabilizer  # noqa: E402, I100

QUICK = ('-p', 'working_width:=192')
READ_BY = '-p projection:=dual_fisheye reads them'
SQUARE = {'radius_px': 150., 'k1': 0., 'k2': 0., 'roll_deg': 0., 'center_v_px': 159.5}
CIRCLES = FisheyeConfig(width=640, height=320, front=LensConfig(center_u_px=159.5, **SQUARE),
                        rear=LensConfig(center_u_px=479.5, yaw_deg=180., **SQUARE))


@pytest.fixture(scope='module')
def circles():
    sphere = np.repeat(np.uint8(40 + 0.6 * textured_sphere(640))[..., None], 3, axis=-1)
    return fisheye_picture(sphere, CIRCLES)


def test_circles_that_are_taken_for_a_sphere_are_told_of(tmp_path, circles):
    with stabilizer(tmp_path, *QUICK, topics=('orientation', '/diagnostics')) as peer:
        for stamp_ns in stamps_of(5):
            peer.stabilize(circles, stamp_ns)
        values = peer.diagnostics(lambda values: READ_BY in values['message'])
        assert values['level'] == b'\1' and values['notice: other_pictures'] == '1'
        assert peer.output().count(READ_BY) == 1


def test_pictures_that_are_refused_are_told_of_too(tmp_path, circles):
    with stabilizer(tmp_path, *QUICK, topics=('/diagnostics',)) as peer:
        for number, stamp_ns in enumerate(stamps_of(4), 1):
            peer.send(cv2.resize(circles, (640, 360)), stamp_ns)
            values = peer.diagnostics(lambda values: values['refused'] == str(number))
        assert re.match(f'images are refused: not 2:1: the pictures look like .*: {READ_BY}.*'
                        '-p fisheye.stretched:=true', values['message'])


@pytest.mark.slow
def test_spheres_are_not_warned_of(tmp_path):
    sphere = np.uint8(40 + 0.6 * textured_sphere(640))
    with stabilizer(tmp_path, *QUICK, topics=('orientation', '/diagnostics')) as peer:
        for stamp_ns in stamps_of(5):
            peer.stabilize(sphere, stamp_ns)
        assert peer.diagnostics(lambda values: values['frames'] == '5')['message'] == 'ok'
        assert 'look like' not in peer.output()


@pytest.mark.slow
def test_the_player_tells_of_them_too(tmp_path, circles):
    bag = write_bag(tmp_path / 'bag', [circles] * 5)
    played = subprocess.run(
        [sys.executable, '-m', 'sph_stab_ros.player', str(bag)], text=True, capture_output=True,
        env={**os.environ, 'ROS_DOMAIN_ID': str(next(DOMAINS))}, timeout=60)
    assert played.returncode == 0
    assert (played.stdout + played.stderr).count(READ_BY) == 1
