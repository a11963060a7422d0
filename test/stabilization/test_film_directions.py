# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Where the virtual camera of a film looks: through all directions, and nowhere beyond."""

import numpy as np
import pytest

from sph_stab_ros.config import ConfigError
from sph_stab_ros.geometry.conventions import NS_PER_S
from sph_stab_ros.geometry.warp import view_rotation
from sph_stab_ros.images.frame import Frame
from sph_stab_ros.recording import open_recording, RecordingError
from sph_stab_ros.recording.bag_writer import BagWriter
from sph_stab_ros.stabilization.film_directions import (
    DirectionPath, read_directions, recorded_directions)
from sph_stab_ros.stabilization.steering import view_angles
from tiny_recordings import START_NS, textured_sphere

BLACK = np.zeros((8, 16, 3), np.uint8)
KEYS_DEG = [(1, 0, 0), (3, 90, 20), (4, 90, 20), (7, 300, -40), (8, 290, -40)]


def directions(text, tmp_path):
    """Return what a file of this text says."""
    path = tmp_path / 'film.yaml'
    path.write_text(text)
    return read_directions(path)


@pytest.fixture
def path(tmp_path):
    """Return KEYS_DEG as read from a file."""
    return directions(''.join(
        f'- {{time_s: {time_s}, yaw_deg: {yaw}, pitch_deg: {pitch}}}\n'
        for time_s, yaw, pitch in KEYS_DEG), tmp_path)


def seen_deg(path, times_s, start_ns=START_NS, **how):
    """Return yaw, pitch and roll (N, 3) at times from the first frame on; yaw goes on."""
    where = DirectionPath(path, **how)
    angles = [view_angles(where(Frame(BLACK, round(start_ns + time_s * NS_PER_S))))
              for time_s in times_s]
    return np.rad2deg(np.unwrap(angles, axis=0))


def test_it_passes_through_each_and_never_swings_beyond_two(path):
    """It rests before the first, behind the last, and between two that are the same."""
    times_s = np.arange(0, 10, 0.01)
    yaw, pitch, roll = seen_deg(path, times_s).T
    for time_s, *angles in KEYS_DEG:
        at = round(100 * time_s)
        np.testing.assert_allclose((yaw[at], pitch[at]), angles, atol=1e-6)
    for (from_s, *start), (to_s, *end) in zip(KEYS_DEG, KEYS_DEG[1:]):
        part = slice(round(100 * from_s), round(100 * to_s) + 1)
        for angle, *limits in zip((yaw, pitch), start, end):
            assert min(limits) - 1e-6 <= angle[part].min()
            assert angle[part].max() <= max(limits) + 1e-6
    assert np.ptp(yaw[:101]) < 1e-9 and np.ptp(yaw[801:]) < 1e-9 and np.ptp(yaw[301:400]) < 1e-9
    np.testing.assert_allclose(roll, 0, atol=1e-6)


def test_it_turns_without_jerks(path):
    """The rate of turning is continuous: half the interval, half the change of it."""
    def largest_change(step_s):
        yaw, pitch, _ = seen_deg(path, np.arange(0, 9, step_s)).T
        return max(np.abs(np.diff(angle, 2)).max() / step_s for angle in (yaw, pitch))
    assert largest_change(0.001) < 0.2 * largest_change(0.01)


def test_one_direction_is_one_at_all_times(tmp_path):
    """A pitch that is not said is none."""
    path = directions('[{time_s: 5, yaw_deg: 30}]', tmp_path)
    np.testing.assert_allclose(seen_deg(path, (0, 5, 50)), [(30, 0, 0)] * 3, atol=1e-9)


def test_directions_in_a_bag_are_of_the_time_of_their_stamps(tmp_path, caplog):
    """They go the shortest way; what is no direction is left out."""
    with BagWriter(tmp_path / 'bag') as bag:
        bag.write_jpeg('/image/compressed', START_NS, 'camera', textured_sphere())
        for time_s, yaw_deg in ((1, 170), (2, -170), (4, -100)):
            bag.write_orientation('view/direction', START_NS + time_s * NS_PER_S, 'virtual',
                                  view_rotation(np.deg2rad(yaw_deg), 0.1))
        for w in (0., 5., np.nan):
            broken = bag.make('geometry_msgs/msg/Quaternion', x=0., y=0., z=0., w=w)
            bag.write('view/direction', bag.make(
                'geometry_msgs/msg/QuaternionStamped', quaternion=broken,
                header=bag.header(START_NS + 3 * NS_PER_S, 'virtual')), START_NS)
    recording = open_recording(tmp_path / 'bag')
    path = recorded_directions(recording, 'view/direction')
    assert '3 messages without a unit quaternion, left out' in caplog.text
    yaw, pitch, _ = seen_deg(path, (0, 1, 1.5, 2, 4, 9), by_clock=True).T
    np.testing.assert_allclose(yaw[[0, 1, 3, 4, 5]], (170, 170, 190, 260, 260), atol=1e-4)
    assert 170 < yaw[2] < 190
    np.testing.assert_allclose(pitch, np.rad2deg(0.1), atol=1e-4)
    with pytest.raises(RecordingError, match='has no topic other'):
        recorded_directions(recording, 'other')


@pytest.mark.parametrize('text, reason', [
    ('', 'is not a list'), ('{time_s: 1}', 'is not a list'), ('[1]', 'direction 1: time_s'),
    ('[{time_s: 1}]', 'direction 1: time_s'), ('- [', 'not YAML'),
    ('[{time_s: 1, yaw_deg: 0, roll_deg: 1}]', 'direction 1: time_s'),
    ('[{time_s: 1, yaw_deg: left}]', 'not all are numbers'),
    ('[{time_s: 1, yaw_deg: .nan}]', 'not all are numbers'),
    ('[{time_s: 1, yaw_deg: 0, pitch_deg: 91}]', '90 degrees of pitch at most'),
    ('[{time_s: 1e308, yaw_deg: 0}]', 'not all are numbers'),
    ('[{time_s: 1' + 400 * '0' + ', yaw_deg: 0}]', 'not all are numbers'),
    ('[{time_s: 1, yaw_deg: 0}, {time_s: 1, yaw_deg: 1}]', 'direction 2: time_s is not later')])
def test_what_is_no_list_of_directions_is_refused(text, reason, tmp_path):
    """With the number of the one that is wrong."""
    with pytest.raises(ConfigError, match=reason):
        directions(text, tmp_path)
