# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The names that options choose from are those that the algorithms have something for."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sph_stab_ros.config import (
    ANCHORED, CROPPED_EQUIRECT, CUBEMAP, DUAL_FISHEYE, EQUI_ANGULAR_CUBEMAP, EQUIRECT, FISHEYE,
    FLOWS, GOPRO_MAX, LEVELS, METHODS, MODES, NODE_PARAMETERS, PROJECTIONS, SmoothingConfig,
    StabilizerConfig, STRETCHED_EQUIRECT, TrackerConfig)
from sph_stab_ros.geometry.cropped_equirect import CroppedEquirect
from sph_stab_ros.geometry.cubemap import Cubemap
from sph_stab_ros.geometry.fisheye import DualFisheye, Fisheye
from sph_stab_ros.geometry.gopro_max import GoProMax
from sph_stab_ros.geometry.projection import Equirect
from sph_stab_ros.geometry.projection_factory import projection_of
from sph_stab_ros.images.frame import Frame
from sph_stab_ros.stabilization.imu import ImuSample
from sph_stab_ros.stabilization.level import GRAVITY_M_S2, heading
from sph_stab_ros.stabilization.pipeline import Stabilizer
from sph_stab_ros.stabilization.smoothing import Smoother
from sph_stab_ros.tracking import make_tracker
from sph_stab_ros.tracking.anchored.tracker import AnchoredTracker
from sph_stab_ros.tracking.frame_to_frame import methods, optical_flow
from sph_stab_ros.tracking.frame_to_frame.tracker import FrameToFrameTracker
from synthetic import angle_deg, textured_sphere


def test_flows_are_those_that_can_be_computed():
    assert set(FLOWS) == optical_flow.FLOWS.keys()


def test_methods_are_those_that_can_be_used():
    assert set(METHODS) == methods.METHODS.keys()


def test_every_estimator_that_can_be_chosen_has_its_tracker():
    choices = NODE_PARAMETERS['estimator'].choices
    assert set(choices) == {ANCHORED, *METHODS}
    for estimator in choices:
        tracker = make_tracker(TrackerConfig(estimator=estimator), 128)
        assert type(tracker) is (
            AnchoredTracker if estimator == ANCHORED else FrameToFrameTracker)


def test_every_mode_draws_the_picture_elsewhere():
    R = Rotation.from_euler('YX', (40, 20), degrees=True)
    # A smoother starts in its target.
    targets = [Smoother().update(SmoothingConfig(mode=mode), 0, R) for mode in MODES]
    expected = (Rotation.identity(), R, heading(R))
    assert len(MODES) == len(expected)
    for mode, target, R_target in zip(MODES, targets, expected):
        assert angle_deg(target, R_target) < 1e-9, mode


def test_every_level_makes_another_world():
    """A camera whose IMU says that it is rolled by 30 degrees is level, or is made level."""
    image = textured_sphere(256)
    force_m_s2 = Rotation.from_euler('x', 30, degrees=True).apply((0, 0, GRAVITY_M_S2))
    turned_deg = {}
    for level in LEVELS:
        stabilizer = Stabilizer(StabilizerConfig(level=level))
        for stamp_ns in range(0, 10**9, 10**7):
            stabilizer.add_imu(ImuSample(stamp_ns, force_m_s2, np.zeros(3)))
        stabilized = stabilizer.process(Frame(image, 10**9))
        turned_deg[level] = np.rad2deg(stabilized.R_world_camera.magnitude())
    assert turned_deg == pytest.approx({'first_frame': 0, 'imu': 30}, abs=0.1)


def test_every_projection_is_one_of_its_own():
    # Of the circles the size of the default calibration.
    kinds = {
        EQUIRECT: ((512, 256), Equirect), STRETCHED_EQUIRECT: ((1280, 720), CroppedEquirect),
        CROPPED_EQUIRECT: ((512, 256), CroppedEquirect), CUBEMAP: ((600, 400), Cubemap),
        EQUI_ANGULAR_CUBEMAP: ((1280, 720), Cubemap), FISHEYE: ((1280, 720), Fisheye),
        DUAL_FISHEYE: ((1280, 720), DualFisheye), GOPRO_MAX: ((512, 336), GoProMax)}
    assert set(PROJECTIONS) == kinds.keys()
    for name, (size_wh, kind) in kinds.items():
        projection = projection_of(size_wh, StabilizerConfig(projection=name))
        assert type(projection) is kind
        if kind is Cubemap:
            assert projection.equi_angular == (name == EQUI_ANGULAR_CUBEMAP)


@pytest.mark.parametrize('name', [name for name, one in NODE_PARAMETERS.items() if one.choices])
def test_what_is_chosen_by_default_can_be_chosen(name):
    option = NODE_PARAMETERS[name]
    assert option.default in option.choices
    assert len(set(option.choices)) == len(option.choices) > 1
