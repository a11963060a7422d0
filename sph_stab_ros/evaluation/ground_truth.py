# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Ground truth: orientations from the messages of a recording."""

from collections.abc import Callable, Sequence
import logging
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from sph_stab_ros.evaluation.telemetry_truth import telemetry_truth
from sph_stab_ros.evaluation.transforms import composed, Frames, is_static, Sample, Transforms
from sph_stab_ros.geometry.arrays import Choice, Floats, Stamps
from sph_stab_ros.geometry.conventions import stamp_ns
from sph_stab_ros.geometry.trajectory import Trajectory
from sph_stab_ros.recording import Recording, RecordingError
from sph_stab_ros.recording.messages import POSE_WITH_COVARIANCE, QUATERNION, TRANSFORMS
from sph_stab_ros.recording.telemetry import TELEMETRY
from sph_stab_ros.stabilization.recorded_imu import IMU_TYPE

logger = logging.getLogger(__name__)

ORIENTATION_OF: dict[str, Callable[[Any], Any]] = {
    'geometry_msgs/msg/PoseStamped': lambda msg: msg.pose.orientation,
    POSE_WITH_COVARIANCE: lambda msg: msg.pose.pose.orientation,
    QUATERNION: lambda msg: msg.quaternion,
    'geometry_msgs/msg/TransformStamped': lambda msg: msg.transform.rotation,
    'nav_msgs/msg/Odometry': lambda msg: msg.pose.pose.orientation,
    IMU_TYPE: lambda msg: msg.orientation,
}
PATH_TYPE = 'nav_msgs/msg/Path'
# What is taken without being named, only where there is nothing before it: a path may be one that
# is planned, an IMU's heading drifts.
LAST_CHOICES = PATH_TYPE, IMU_TYPE
# Written with four decimals a unit quaternion is off by up to 1e-4.
NORM_TOLERANCE = 1e-3


def find_truth_topic(recording: Recording, frames: Frames | None = None) -> str:
    """
    Return the one topic that can be truth; with ``frames``, the one with transforms.

    RecordingError where the choice is not clear, and of videos: a gyro is truth by request only.
    """
    by_type: dict[str, list[str]] = {}
    for topic, msgtype in usable_topics(recording).items():
        by_type.setdefault(msgtype, []).append(topic)
    transforms = by_type.pop(TRANSFORMS, [])
    if frames:
        topics = transforms
    else:
        last = [by_type.pop(msgtype, []) for msgtype in LAST_CHOICES]
        topics = next(filter(None, (sum(by_type.values(), []), *last)), [])
    if len(topics) == 1:
        return topics[0]
    if topics:
        raise RecordingError(f'{recording.name} has several topics with orientations, choose one '
                             f'with --truth: {", ".join(sorted(topics))}')
    raise RecordingError(f'{recording.name} has no topic with orientations'
                         f'{" between frames" if frames else ""}; {would_do(recording)}')


def usable_topics(recording: Recording) -> dict[str, str]:
    """Return the topics that can be truth, and their types."""
    return {topic: msgtype for topic, msgtype in recording.topics.items()
            if msgtype in ORIENTATION_OF or msgtype == PATH_TYPE
            or msgtype == TRANSFORMS and not is_static(topic)}


def would_do(recording: Recording) -> str:
    """Return a text of what in a Recording can be truth."""
    topics = [f'{topic} (with --truth-frames PARENT:CHILD)' if msgtype == TRANSFORMS else topic
              for topic, msgtype in sorted(usable_topics(recording).items())]
    if recording.telemetry is not None:
        topics.append(TELEMETRY)
    return (f'as truth would do: {", ".join(topics)}' if topics
            else '--inject SEED evaluates without truth')


def read_truth(recording: Recording, topic: str, frames: Frames | None = None) -> Trajectory:
    """
    Return the Trajectory of a topic; of one with transforms, of ``frames`` (parent, child).

    Header stamps, or times of receipt where those are zero. Messages in the wrong order are
    sorted, of equal stamps the first is kept, quaternions are normalised; each is said in the log.
    RecordingError where nothing is left, or the topic is of another kind.
    """
    if topic == TELEMETRY and recording.telemetry is not None and frames is None:
        return telemetry_truth(recording.name, recording.telemetry)
    if topic not in recording.topics:
        raise RecordingError(f'{recording.name} has no topic {topic}; {would_do(recording)}')
    if topic not in usable_topics(recording):
        raise RecordingError(f'{topic} in {recording.name} is of type {recording.topics[topic]}; '
                             f'{would_do(recording)}')
    if recording.topics[topic] == TRANSFORMS:
        return _of_frames(recording, topic, frames)
    if frames:
        raise RecordingError(f'{topic} in {recording.name} holds no transforms between frames, '
                             f'leave out --truth-frames; {would_do(recording)}')
    if recording.topics[topic] == PATH_TYPE:
        return _cleaned(topic, _of_path(recording, topic))
    return _cleaned(topic, _of_messages(recording, topic))


def _of_messages(recording: Recording, topic: str) -> list[Sample]:
    """Return what is said by messages with an orientation each."""
    msgtype = recording.topics[topic]
    samples = []
    for received_ns, msg in recording.messages(topic):
        # The message's way to say that it has no orientation.
        if msgtype == IMU_TYPE and msg.orientation_covariance[0] == -1:
            continue
        q = ORIENTATION_OF[msgtype](msg)
        samples.append((stamp_ns(msg.header.stamp) or received_ns, (q.x, q.y, q.z, q.w)))
    return samples


def _of_path(recording: Recording, topic: str) -> list[Sample]:
    """Return the poses of all paths; they grow and are corrected, so the last word counts."""
    latest = {}
    for _, msg in recording.messages(topic):
        for pose in msg.poses:
            q = pose.pose.orientation
            latest[stamp_ns(pose.header.stamp)] = q.x, q.y, q.z, q.w
    # Nothing else tells the time of a pose in a path.
    if latest.pop(0, None):
        if not latest:
            raise RecordingError(f'the poses in {topic} have no stamps; {would_do(recording)}')
        logger.warning('%s: poses without a stamp, left out', topic)
    return sorted(latest.items())


def _of_frames(recording: Recording, topic: str, frames: Frames | None) -> Trajectory:
    """Return the Trajectory of a frame in another, along the chain that joins them."""
    transforms = Transforms(recording, topic)
    if frames is None:
        raise RecordingError(f'{topic} in {recording.name} holds transforms, choose two frames '
                             f'with --truth-frames PARENT:CHILD: {transforms.listed()}')
    links: list[Trajectory | Rotation] = []
    for link, is_inverted in transforms.chain(*frames):
        name = f'{topic}, {":".join(link)}'
        if link in transforms.static:
            fixed = _cleaned(name, [transforms.static[link]]).rotations[0]
            links.append(fixed.inv() if is_inverted else fixed)
        else:
            moving = _cleaned(name, transforms.moving[link])
            links.append(Trajectory(moving.stamps_ns, moving.rotations.inv())
                         if is_inverted else moving)
    try:
        return composed(links)
    except ValueError as error:
        raise RecordingError(
            f'{recording.name}, --truth-frames {":".join(frames)}: {error}') from None


def _cleaned(topic: str, samples: Sequence[Sample]) -> Trajectory:
    """Return the Trajectory of what is left of samples."""
    stamps_ns: Stamps = np.array([stamp_ns for stamp_ns, _ in samples], np.int64)
    quaternions: Floats = np.array([q for _, q in samples], float).reshape(-1, 4)
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
