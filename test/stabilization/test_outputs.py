# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What is published of a stabilised frame, without ROS."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from sph_stab_ros.config import NodeConfig, ViewConfig
from sph_stab_ros.images.frame import Frame
from sph_stab_ros.stabilization.outputs import (
    configured_camera, configured_look, orientation_outputs, picture_outputs, topics)
from sph_stab_ros.stabilization.stabilized_frame import StabilizedFrame
from sph_stab_ros.tracking import TrackingStatus
from tiny_recordings import textured_sphere

R_WORLD_CAMERA, R_WORLD_VIRTUAL = Rotation.random(2, random_state=5)
STABILIZED = StabilizedFrame(
    Frame(textured_sphere(256), 5_000_000_006, 'theta'), R_WORLD_CAMERA, TrackingStatus.OK,
    covariance=np.eye(3), R_world_virtual=R_WORLD_VIRTUAL)
CONFIG = NodeConfig(views=('view', 'rear'), view=ViewConfig(yaw_deg=30., hfov_deg=60.))
CAMERAS = [configured_camera('view', CONFIG.view),
           configured_camera('rear', ViewConfig(frame_id='rear_optical'))]


def make(type_name, **fields):
    """Return what looks like a message."""
    return SimpleNamespace(type=type_name, **fields)


def orientations(stabilized=STABILIZED, config=CONFIG):
    """Return the messages that cost little, by topic."""
    return {output.topic: output.message(make)
            for output in orientation_outputs(stabilized, config, CAMERAS)}


def pictures(stabilized=STABILIZED, config=CONFIG, **options):
    """Return the messages that show something, by topic."""
    return {output.topic: output.message(make)
            for output in picture_outputs(stabilized, config, CAMERAS, **options)}


def rotation(quaternion):
    """Return the Rotation of a Quaternion."""
    return Rotation.from_quat((quaternion.x, quaternion.y, quaternion.z, quaternion.w))


def looked_up(transforms, target, source):
    """Return R_target_source as tf2 chains it: up from the source, then down to the target."""
    parents = {one.child_frame_id: (one.header.frame_id, rotation(one.transform.rotation))
               for one in transforms}

    def from_root(frame):
        R_root_frame = Rotation.identity()
        while frame in parents:
            frame, R_parent_frame = parents[frame]
            R_root_frame = R_parent_frame * R_root_frame
        return R_root_frame
    return from_root(target).inv() * from_root(source)


def test_messages_are_of_the_types_that_are_advertised_and_of_the_frame_s_stamp():
    said = {**orientations(), **pictures()}
    assert {topic: msg.type for topic, msg in said.items()} == topics(CONFIG.views)
    for topic, msg in said.items():
        header = msg.transforms[0].header if topic == '/tf' else msg.header
        assert (header.stamp.sec, header.stamp.nanosec) == (5, 6)


def test_raw_images_are_left_out_where_nobody_wants_them():
    assert pictures().keys() - pictures(raw=False).keys() == {
        'stabilized/image', 'view/image', 'rear/image'}


def test_looking_up_gives_the_rotations_of_the_core():
    transforms = orientations()['/tf'].transforms
    R_world_view = R_WORLD_VIRTUAL * configured_look(CONFIG.view).R_virtual_view
    for target, source, expected in (
            ('stabilized_optical', 'theta', R_WORLD_CAMERA),
            ('theta', 'stabilized_optical', R_WORLD_CAMERA.inv()),
            ('stabilized_optical', 'view_optical', R_world_view),
            ('theta', 'view_optical', R_WORLD_CAMERA.inv() * R_world_view),
            ('virtual_optical', 'rear_optical', Rotation.identity())):
        found = looked_up(transforms, target, source)
        assert (found.inv() * expected).magnitude() < 1e-9


def test_the_robot_s_tree_keeps_its_parents():
    transforms = orientations()['/tf'].transforms
    children = sorted(one.child_frame_id for one in transforms)
    assert children == ['rear_optical', 'stabilized_optical', 'view_optical', 'virtual_optical']
    parents = {one.header.frame_id for one in transforms}
    assert parents == {'theta', 'stabilized_optical'}
    translations = [vars(one.transform.translation) for one in transforms]
    assert all((one['x'], one['y'], one['z']) == (0, 0, 0) for one in translations)


@pytest.mark.parametrize('frame_id', (
    '', '/', 'stabilized_optical', '/stabilized_optical', 'virtual_optical', 'view_optical',
    '/view_optical', 'rear_optical'))
def test_no_frame_becomes_its_own_parent_or_hangs_in_the_air(frame_id):
    frame = replace(STABILIZED.frame, frame_id=frame_id)
    assert orientations(replace(STABILIZED, frame=frame)).keys() == orientations().keys() - {'/tf'}


def test_transforms_are_left_out_on_demand_and_an_unknown_covariance_is_not_made_up():
    assert '/tf' not in orientations(config=replace(CONFIG, publish_tf=False))
    assert 'orientation_covariance' not in orientations(replace(STABILIZED, covariance=None))


def test_the_sphere_is_in_the_frame_that_it_is_turned_to():
    still = replace(STABILIZED, R_world_virtual=Rotation.identity())
    for stabilized, frame_id in ((STABILIZED, 'virtual_optical'), (still, 'stabilized_optical')):
        for topic in ('stabilized/image', 'stabilized/image/compressed'):
            assert pictures(stabilized)[topic].header.frame_id == frame_id


def test_pictures_are_drawn_when_they_are_asked_for_and_once(monkeypatch):
    drawn = []
    monkeypatch.setattr(StabilizedFrame, 'sphere', lambda _: drawn.append('sphere')
                        or np.zeros((8, 16, 3), np.uint8))
    outputs = {one.topic: one for one in picture_outputs(STABILIZED, CONFIG, CAMERAS)}
    assert not drawn
    outputs['stabilized/image'].draw()
    for topic in ('stabilized/image', 'stabilized/image/compressed', 'view/camera_info'):
        outputs[topic].message(make)
    assert drawn == ['sphere']
