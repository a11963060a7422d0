# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Ground truth: orientations from the messages of a recording."""

from collections.abc import Callable
import logging
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from sph_stab_ros.geometry.arrays import Choice, Floats, Stamps
from sph_stab_ros.geometry.conventions import NS_PER_S
from sph_stab_ros.geometry.trajectory import Trajectory
from sph_stab_ros.recording import Recording, RecordingError

logger = logging.getLogger(__name__)

ORIENTATION_OF: dict[str, Callable[[Any], Any]] = {
    'geometry_msgs/msg/PoseStamped': lambda msg: msg.pose.orientation,
    'geometry_msgs/msg/QuaternionStamped': lambda msg: msg.quaternion,
    'geometry_msgs/msg/TransformStamped': lambda msg: msg.transform.rotation,
    'nav_msgs/msg/Odometry': lambda msg: msg.pose.pose.orientation,
    'sensor_msgs/msg/Imu': lambda msg: msg.orientation,
}
IMU_TYPE = 'sensor_msgs/msg/Imu'
# Written with four decimals a unit quaternion is off by up to 1e-4.
NORM_TOLERANCE = 1e-3


def find_truth_topic(recording: Recording) -> str:
    """
    Return the one topic that can be truth.

    An IMU, whose heading drifts, is taken only where there is nothing better. RecordingError
    where the choice is not clear.
    """
    candidates = {topic: msgtype for topic, msgtype in recording.topics.items()
                  if msgtype in ORIENTATION_OF}
    better = [topic for topic, msgtype in candidates.items() if msgtype != IMU_TYPE]
    topics = sorted(better or candidates)
    if len(topics) == 1:
        return topics[0]
    if topics:
        raise RecordingError(f'{recording.name} has several topics with orientations, choose one '
                             f'with --truth: {", ".join(topics)}')
    raise RecordingError(
        f'{recording.name} has no topic with orientations; --inject SEED evaluates without truth')


def read_truth(recording: Recording, topic: str) -> Trajectory:
    """
    Return the Trajectory of a topic of any type in ORIENTATION_OF.

    Header stamps, or times of receipt where those are zero. Messages in the wrong order are
    sorted, of equal stamps the first is kept, quaternions are normalised; each is said in the log.
    RecordingError where nothing is left.
    """
    msgtype = recording.topics.get(topic, '')
    if msgtype and msgtype not in ORIENTATION_OF:
        raise RecordingError(f'{topic} in {recording.name} is of type {msgtype}, truth is one of '
                             f'{", ".join(ORIENTATION_OF)}')
    stamps_ns, quaternions = [], []
    for received_ns, msg in recording.messages(topic):
        # The message's way to say that it has no orientation.
        if msgtype == IMU_TYPE and msg.orientation_covariance[0] == -1:
            continue
        q = ORIENTATION_OF[msgtype](msg)
        stamp = msg.header.stamp
        stamps_ns.append(stamp.sec * NS_PER_S + stamp.nanosec or received_ns)
        quaternions.append((q.x, q.y, q.z, q.w))
    return _cleaned(topic, np.array(stamps_ns, np.int64), np.array(quaternions).reshape(-1, 4))


def _cleaned(topic: str, stamps_ns: Stamps, quaternions: Floats) -> Trajectory:
    """Return the Trajectory of what is left of stamps (N,) and quaternions (N, 4)."""
    norms = np.linalg.norm(quaternions, axis=1)
    # Written so that NaN fails.
    usable = (norms > 0.5) & (norms < 2)
    if not usable.any():
        raise RecordingError(f'{topic} holds no orientations ({len(stamps_ns)} messages)')
    _warn(topic, ~usable, 'without an orientation, left out')
    stamps_ns, quaternions, norms = stamps_ns[usable], quaternions[usable], norms[usable]
    _warn(topic, np.abs(norms - 1) > NORM_TOLERANCE, 'with a quaternion not of unit length, '
          'normalised')
    _warn(topic, np.diff(stamps_ns) < 0, 'earlier than the one before, sorted')
    unique_ns, first = np.unique(stamps_ns, return_index=True)
    if len(unique_ns) < len(stamps_ns):
        logger.warning('%s: %d messages with the stamp of another, left out', topic,
                       len(stamps_ns) - len(unique_ns))
    return Trajectory(unique_ns, Rotation.from_quat(quaternions[first]))


def _warn(topic: str, concerned: Choice, what: str) -> None:
    if concerned.any():
        logger.warning('%s: %d messages %s', topic, np.count_nonzero(concerned), what)
