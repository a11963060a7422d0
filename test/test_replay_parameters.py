# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What the node's parameters do in replay: levelling by an IMU, views, the front's mark."""

from dataclasses import replace
from functools import partial
import json
from operator import itemgetter

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from simulated_imu import imu_samples
from sph_stab_ros.evaluate import main as evaluate
from sph_stab_ros.geometry.conventions import R_CAMERA_BODY
from sph_stab_ros.geometry.trajectory import read_tum
from sph_stab_ros.recording import open_recording
from sph_stab_ros.recording.bag_writer import BagWriter
from sph_stab_ros.replay import arguments, main
from sph_stab_ros.simulation import flights
from sph_stab_ros.stabilization.imu import mount_rotation
from sph_stab_ros.stabilization.level import heading
from sph_stab_ros.stabilization.pipeline import Stabilizer
from synthetic import textured_sphere
from tiny_recordings import write_imu

WIDTH = 256
MOUNT = mount_rotation(*np.deg2rad((10., 20., -40.)))
LEVELLED = """\
stabilizer:
  ros__parameters:
    level: imu
    imu: {roll_deg: 10.0, pitch_deg: 20.0, yaw_deg: -40.0}
    working_width: 256
"""


def angles_deg(R_a, R_b):
    """Return the angles between rotations in degrees."""
    return np.rad2deg((R_a.inv() * R_b).magnitude())


def call(*args, expect=0):
    """Run the command in this process and check its exit status."""
    assert main([str(arg) for arg in args]) == expect


def frames_of(path):
    """Return all pictures of a video."""
    return [frame.image for frame in open_recording(path).frames()]


def fly(path, frames, dark=()):
    """
    Write a bag of a simulated flight that turns on the spot, with an IMU and the truth.

    Return the bag, the IMU's samples and the true orientations in the level world.
    """
    flight = flights.synthetic(0, frames, rotation_amplitude_deg=40., max_frequency_hz=1.)
    flight = replace(flight, position=lambda t: np.zeros((*np.shape(t), 3)))
    R_level_camera = R_CAMERA_BODY * flight.R_mocap_camera(flight.frame_times_s)
    R_level_camera = heading(R_level_camera[0]).inv() * R_level_camera
    samples = imu_samples(flight, MOUNT, rate_hz=100, force_noise_m_s2=0.05)
    with BagWriter(path) as bag:
        writes = [(one.stamp_ns, partial(write_imu, bag, '/imu/data', one)) for one in samples]
        for i, (ns, R) in enumerate(zip(flight.stamps_ns.tolist(), R_level_camera)):
            image = textured_sphere(WIDTH, R) * (i not in dark)
            # A recorder hears of pictures later, and sorts by when it did.
            writes += ((ns + 50_000_000, partial(
                bag.write_jpeg, '/image/compressed', ns, 'camera', image)),
                (ns, partial(bag.write_orientation, '/truth', ns, 'level', R * R_CAMERA_BODY)))
        for _, write in sorted(writes, key=itemgetter(0)):
            write()
    return path, samples, R_level_camera


def test_a_bag_with_an_imu_is_levelled_as_the_stabilizer_is(tmp_path, capsys):
    """The law of replay: the same pictures and samples give the same orientations."""
    path, samples, R_level_camera = fly(tmp_path / 'bag', 40)
    (tmp_path / 'robot.yaml').write_text(LEVELLED)
    args = path, '--trajectory', tmp_path / 'out.tum', '--params-file', tmp_path / 'robot.yaml'
    call(*args)
    found = read_tum(tmp_path / 'out.tum')
    used = [one for one in samples if one.stamp_ns <= found.stamps_ns[-1]]
    assert f'levelled by {len(used)} samples of /imu/data, 0 left out' in capsys.readouterr().out

    config = arguments([str(arg) for arg in args])[1].config
    stabilizer, R_world_camera = Stabilizer(config), []
    for frame in open_recording(path).frames():
        while samples and samples[0].stamp_ns <= frame.stamp_ns:
            stabilizer.add_imu(samples[0])
            samples = samples[1:]
        R_world_camera.append(stabilizer.process(frame).R_world_camera)
    assert angles_deg(found.rotations, Rotation.concatenate(R_world_camera)).max() < 1e-5
    # And they are level, from the first picture on; without the IMU they are not.
    assert angles_deg(found.rotations, R_level_camera).max() < 0.5
    call(path, '--trajectory', tmp_path / 'other.tum', '--working-width', WIDTH)
    assert angles_deg(read_tum(tmp_path / 'other.tum').rotations, R_level_camera).min() > 1


def test_the_gyro_bridges_the_dark_in_evaluate_too(tmp_path):
    """Longer than prediction is trusted without it."""
    path, _, _ = fly(tmp_path / 'bag', 60, dark=range(15, 45))
    (tmp_path / 'robot.yaml').write_text(LEVELLED)
    largest_deg = []
    for words in (['--params-file', tmp_path / 'robot.yaml'], ['--working-width', WIDTH]):
        args = [path, '--estimators', 'anchored', '--mount', '0,0,0', '--truth', '/truth',
                '--json', tmp_path / 'figures.json', *words]
        assert evaluate([str(arg) for arg in args]) == 0
        figures = json.loads((tmp_path / 'figures.json').read_text())['estimators']['anchored']
        largest_deg.append(figures['geodesic_deg']['max'])
    assert largest_deg[0] < 0.5 and largest_deg[1] > 5


@pytest.mark.parametrize('recording, args, message', [
    ('turning_bag', (), 'no IMU to level by'), ('turning_video', (), 'no IMU to level by'),
    ('turning_bag', ('--imu-topic', '/imu'), 'no IMU on /imu')])
def test_without_an_imu_nothing_is_levelled_by_it(request, tmp_path, capsys, recording, args,
                                                  message):
    """That is a failure, said before anything is begun."""
    call(request.getfixturevalue(recording), '--trajectory', tmp_path / 'out.tum',
         '-p', 'level:=imu', *args, expect=1)
    error, = capsys.readouterr().err.splitlines()
    assert message in error
    assert not list(tmp_path.iterdir())


def test_a_video_shows_any_of_the_views_as_it_is_described(turning_bag, tmp_path):
    """Size and direction are those of the parameters."""
    (tmp_path / 'robot.yaml').write_text(
        '/**: {ros__parameters: {views: [front, rear], front: {width: 200, height: 100}, '
        'rear: {width: 100, height: 80, yaw_deg: 180.0}}}')
    args = turning_bag, '--force', '--max-frames', 2, '--params-file', tmp_path / 'robot.yaml'
    call(*args, tmp_path / 'front.mp4', '--view', 'front')
    call(*args, tmp_path / 'rear.mp4', '--view', 'rear')
    call(turning_bag, tmp_path / 'same.mp4', '--max-frames', 2, '--view', '180,0,0,90',
         '-p', 'view.width:=100', '-p', 'view.height:=80')
    front, rear, same = (frames_of(tmp_path / f'{name}.mp4') for name in ('front', 'rear', 'same'))
    assert front[0].shape == (100, 200, 3)
    assert np.array_equal(rear, same) and rear[0].shape == (80, 100, 3)


def test_a_video_shows_the_front_where_it_is_wanted(turning_bag, tmp_path):
    """In views, or in the sphere too; elsewhere pictures are as without it."""
    def picture(*args):
        call(turning_bag, tmp_path / 'out.mp4', '--force', '--max-frames', 1, *args)
        return frames_of(tmp_path / 'out.mp4')[0].astype(int)

    def marked_px(marker, *args):
        marked = picture('-p', f'front_marker:={marker}', *args)
        return np.argwhere((abs(marked - picture(*args)) > 80).any(axis=2))

    view = '--view', '0,0,0,90'
    assert not marked_px('none').size and not marked_px('views').size
    assert not marked_px('none', *view).size
    for args, centre in (((), (63.5, 127.5)), (view, (239.5, 319.5))):
        assert marked_px('all', *args).mean(axis=0) == pytest.approx(centre, rel=0.1)
    ahead, aside = (marked_px('views', *view, '-p', f'front_yaw_deg:={deg}').mean(axis=0)
                    for deg in (0, 30))
    # To the left by the tangent of 30 degrees.
    assert (ahead - aside)[1] == pytest.approx(320 * np.tan(np.pi / 6), rel=0.15)
