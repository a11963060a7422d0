# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""An IMU's samples out of a bag: all of them, in order, in time, few at once."""

from types import SimpleNamespace

import numpy as np
import pytest
from sph_stab_ros.recording import open_recording, RecordingError
from sph_stab_ros.recording.bag_writer import BagWriter
from sph_stab_ros.stabilization.imu import ImuSample
from sph_stab_ros.stabilization.recorded_imu import find_imu_topic, MAX_DISORDER, RecordedImu
from tiny_recordings import START_NS, textured_sphere, write_imu

MS = 1_000_000
NOT_MEASURED = np.array([-1.] + 8 * [0.])


def sample(stamp_ns, force=(0., 0., 9.8)):
    return ImuSample(int(stamp_ns), force, (0.1, 0.2, 0.3))


def bag_of(folder, write):
    """Return a recording of a picture and what ``write`` writes besides."""
    with BagWriter(folder / 'bag') as bag:
        bag.write_jpeg('/image/compressed', START_NS, 'camera', textured_sphere())
        write(bag)
    return open_recording(folder / 'bag')


class Messages:
    """A recording of an IMU's messages, which counts how many of them were read."""

    name = 'messages'
    telemetry = None

    def __init__(self, stamps_ns):
        self._stamps_ns = stamps_ns
        self.read = 0

    def messages(self, topic):
        """Yield (time of receipt, message)."""
        for stamp_ns in self._stamps_ns:
            self.read += 1
            sec, nanosec = divmod(stamp_ns, 10**9)
            vector = SimpleNamespace(x=0., y=0., z=9.8)
            yield 1, SimpleNamespace(
                header=SimpleNamespace(stamp=SimpleNamespace(sec=sec, nanosec=nanosec)),
                linear_acceleration=vector, angular_velocity=vector,
                linear_acceleration_covariance=[0.], angular_velocity_covariance=[0.])


def test_all_samples_come_once_and_in_time(tmp_path):
    stamps_ns = START_NS + 5 * MS * np.arange(-20, 40)
    recording = bag_of(tmp_path, lambda bag: [write_imu(bag, '/imu', sample(ns))
                                              for ns in stamps_ns])
    imu = RecordedImu(recording, find_imu_topic(recording))
    found = []
    for picture_ns in START_NS + 33 * MS * np.arange(10):
        samples = list(imu.until(picture_ns))
        assert all(one.stamp_ns <= picture_ns for one in samples)
        found += samples
        assert len(found) == imu.samples == np.count_nonzero(stamps_ns <= picture_ns)
    assert [one.stamp_ns for one in found] == stamps_ns.tolist()
    for one in found:
        assert one.specific_force_m_s2.tolist() == [0, 0, 9.8]
        assert one.angular_velocity_rad_s.tolist() == [0.1, 0.2, 0.3]
    assert not list(imu.until(stamps_ns[-1] + 10**12))


def test_samples_recorded_in_disorder_come_in_order():
    rng = np.random.default_rng(0)
    places = np.arange(1000) + rng.uniform(0, MAX_DISORDER / 2, 1000)
    stamps_ns = [int(1 + ns) for ns in np.argsort(np.argsort(places))]
    assert stamps_ns != sorted(stamps_ns)
    imu = RecordedImu(Messages(stamps_ns), '/imu')
    assert [one.stamp_ns for one in imu.until(10**9)] == sorted(stamps_ns)


def test_few_samples_are_read_ahead():
    messages = Messages(range(1, 10**6))
    imu = RecordedImu(messages, '/imu')
    for picture_ns in (1, 50, 5000):
        for one in imu.until(picture_ns):
            assert messages.read <= one.stamp_ns + 2 * MAX_DISORDER
        assert messages.read <= picture_ns + 2 * MAX_DISORDER


def test_what_is_no_sample_is_left_out_and_named_once(tmp_path, caplog):
    def write(bag):
        for i in range(3):
            write_imu(bag, '/imu', SimpleNamespace(
                stamp_ns=START_NS + i, specific_force_m_s2=(0, 0, i % 2),
                angular_velocity_rad_s=(0, 0, 0)))
        write_imu(bag, '/imu', sample(START_NS + 3), linear_acceleration_covariance=NOT_MEASURED)
        write_imu(bag, '/imu', sample(START_NS + 4), linear_acceleration_covariance=NOT_MEASURED,
                  angular_velocity_covariance=NOT_MEASURED)
        # Without a stamp: of when it was received.
        write_imu(bag, '/imu', sample(0), START_NS + 5)
    recording = bag_of(tmp_path, write)
    imu = RecordedImu(recording, '/imu')
    found = list(imu.until(START_NS + 10))
    assert [one.stamp_ns - START_NS for one in found] == [1, 3, 5]
    assert found[1].specific_force_m_s2 is None
    assert (imu.samples, imu.refused) == (3, 3)
    record, = caplog.records
    assert 'the specific force is zero' in record.message


def test_the_topic_is_the_only_one_or_must_be_chosen(tmp_path):
    def write(bag):
        for topic in ('/b/imu', '/a/imu'):
            write_imu(bag, topic, sample(START_NS))
    recording = bag_of(tmp_path, write)
    with pytest.raises(RecordingError, match='--imu-topic: /a/imu, /b/imu'):
        find_imu_topic(recording)
    assert find_imu_topic(recording, '/b/imu') == '/b/imu'
    for wanted in ('/imu', '/image/compressed'):
        with pytest.raises(RecordingError, match=f'no IMU on {wanted}.*/a/imu, /b/imu'):
            find_imu_topic(recording, wanted)
    (tmp_path / 'none').mkdir()
    with pytest.raises(RecordingError, match='no IMU to level by'):
        find_imu_topic(bag_of(tmp_path / 'none', lambda bag: None))
