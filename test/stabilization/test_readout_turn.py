# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""A stabiliser that knows that rows are read one after the other; the picture does not wobble."""

from dataclasses import replace

import cv2
import numpy as np
from projection_pictures import picture_of
import pytest
from scipy.spatial.transform import Rotation
from sph_stab_ros.config import (
    COLUMNS, FISHEYE, FisheyeConfig, LensConfig, ROWS, StabilizerConfig, TrackerConfig)
from sph_stab_ros.geometry.equirect import bearing_grid
from sph_stab_ros.geometry.projection_factory import projection_of
from sph_stab_ros.images.frame import Frame
from sph_stab_ros.stabilization.offline import offline_stabilizer
from sph_stab_ros.stabilization.pipeline import Stabilizer
from sph_stab_ros.stabilization.readout_turn import MAX_INTERVAL_S, ReadoutTurn
from synthetic import texture_along, textured_sphere

WIDTH = 256
SIDE = 200
PERIOD_S = 1 / 30
READOUT_S = 0.03


def shaken(time_s):
    """Return orientations at times (N,)."""
    return Rotation.from_rotvec(0.12 * np.sin(2 * np.pi * np.outer(time_s, (1.2, 1.6, 0.9))))


def read_row_by_row(time_s):
    """Return a sphere of a shaken camera, in so many bands as its orientation is that of a row."""
    rows = np.arange(WIDTH // 2)
    times_s = time_s + ((rows + 0.5) / len(rows) - 0.5) * READOUT_S
    R_world_rows = shaken(times_s).as_matrix().astype(np.float32)
    return texture_along(bearing_grid(WIDTH) @ np.swapaxes(R_world_rows, 1, 2))


@pytest.fixture(name='frames', scope='module')
def shaken_frames():
    """Return Frames at 30 Hz."""
    return [Frame(read_row_by_row(time_s), int(1e9 * time_s))
            for time_s in PERIOD_S * np.arange(8)]


def wobble(frames, processor):
    """Return by how much stabilised pictures differ from what a camera at rest sees."""
    spheres = [processor.process(frame).sphere() for frame in frames]
    at_rest = textured_sphere(WIDTH, shaken([0.])[0])
    # The first picture does not tell how the camera turned meanwhile.
    return np.mean([cv2.absdiff(sphere, at_rest).mean() for sphere in spheres[2:]])


def config(estimator, readout_s):
    """Return the config of a camera that is read for so long."""
    return StabilizerConfig(tracker=TrackerConfig(
        estimator=estimator, flow='dis', working_width=WIDTH, rolling_shutter_s=readout_s))


def lying(frames, angle_deg):
    """Return what a fisheye camera that lies on its side (±90) sees of spheres, and its config."""
    lens = FisheyeConfig(SIDE, SIDE, fov_deg=220., front=LensConfig(
        (SIDE - 1) / 2, (SIDE - 1) / 2, SIDE / 2.5, k1=0., k2=0.))
    upright, turned = (StabilizerConfig(projection=FISHEYE, fisheye=replace(
        lens, front=replace(lens.front, roll_deg=deg))) for deg in (0., angle_deg))
    projection = projection_of((SIDE, SIDE), upright)
    pictures = [picture_of(projection, frame.image) for frame in frames]
    return [[replace(frame, source=np.ascontiguousarray(np.rot90(picture, turns)))
             for frame, picture in zip(frames, pictures)]
            for turns in (0, round(angle_deg / 90))], (upright, turned)


@pytest.mark.parametrize('angle_deg, by, sign', [
    (90., COLUMNS, 1), (-90., COLUMNS, -1), (180., ROWS, -1)])
def test_how_the_sensor_lies_is_nobodys_business(frames, angle_deg, by, sign):
    """A picture turned with its lens, and read as it was, has the same orientations."""
    (upright, turned), configs = lying(frames, angle_deg)
    outcomes = []
    for pictures, config, how in ((upright, configs[0], (READOUT_S, ROWS)),
                                  (turned, configs[1], (sign * READOUT_S, by)),
                                  (turned, configs[1], (-sign * READOUT_S, by))):
        stabilizer = Stabilizer(replace(config, tracker=TrackerConfig(
            working_width=WIDTH, rolling_shutter_s=how[0], rolling_shutter_by=how[1])))
        outcomes.append(Rotation.concatenate(
            [stabilizer.process(picture).R_world_camera for picture in pictures]))
    as_upright, wrong = (np.rad2deg((outcomes[0].inv() * one).magnitude().max())
                         for one in outcomes[1:])
    assert as_upright < 0.01 < wrong / 3


@pytest.mark.parametrize('estimator', ('anchored', 'moment'))
def test_the_picture_wobbles_less(frames, estimator):
    """Whoever estimates the orientations."""
    as_it_is, known = (wobble(frames, Stabilizer(config(estimator, readout_s)))
                       for readout_s in (0., READOUT_S))
    assert known < 0.7 * as_it_is


def test_offline_too(frames):
    """Where the recording is also read backwards, and the last row is the first."""
    def read(processor):
        for frame in frames:
            processor.process(frame)
    as_it_is, known = (
        wobble(frames, offline_stabilizer(config('anchored', readout_s), read, lambda one, _: one))
        for readout_s in (0., READOUT_S))
    assert known < 0.7 * as_it_is


def test_the_turn_of_a_read_out_is_that_of_the_camera_meanwhile():
    """As far as its orientations tell: not at first, nor after a gap or a step back."""
    rate_rad_s = np.array((0.5, -1., 0.2))
    turn, times_s = ReadoutTurn(), np.array((0., 0.1, 0.2))
    turns = [turn.update(int(1e9 * time_s), Rotation.from_rotvec(rate_rad_s * time_s), READOUT_S)
             for time_s in (*times_s, 0.2 + 2 * MAX_INTERVAL_S, 0.1, 0.2)]
    known = READOUT_S * rate_rad_s
    np.testing.assert_allclose(turns, [0 * known, known, known, 0 * known, 0 * known, known],
                               atol=1e-12)
