# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""An IMU's samples out of a bag or a video, in time for its pictures."""

from collections.abc import Callable, Iterable, Iterator
from functools import partial
from heapq import heappop, heappush, merge
from itertools import repeat
import logging
from operator import itemgetter

from sph_stab_ros.recording import Recording, RecordingError
from sph_stab_ros.recording.telemetry import TELEMETRY, Telemetry
from sph_stab_ros.stabilization.imu import imu_sample, ImuError, ImuSample

logger = logging.getLogger(__name__)

IMU_TYPE = 'sensor_msgs/msg/Imu'
# By so many messages one may have been recorded before another that is earlier by its stamp.
MAX_DISORDER = 100


def find_imu_topic(recording: Recording, wanted: str | None = None) -> str:
    """
    Return the topic ``wanted``, or the only one of an IMU, or raise RecordingError.

    In a video that is TELEMETRY, where its camera has measured something.
    """
    topics = sorted(topic for topic, msgtype in recording.topics.items() if msgtype == IMU_TYPE)
    if recording.telemetry is not None and recording.telemetry.is_of_imu:
        topics.append(TELEMETRY)
    listed = ', '.join(topics) or 'none'
    if wanted is not None:
        if wanted not in topics:
            raise RecordingError(
                f'{recording.name} has no IMU on {wanted}; topics of type {IMU_TYPE}: {listed}')
        return wanted
    if not topics:
        raise RecordingError(
            f'{recording.name} has no IMU to level by: no topic of type {IMU_TYPE} and no '
            "measurements of the camera's own in the metadata of a video")
    if len(topics) > 1:
        raise RecordingError(f'{recording.name} has several IMUs, choose one with --imu-topic: '
                             f'{listed}')
    return topics[0]


class RecordedImu:
    """
    The ImuSamples of a Recording's topic, handed out in the order of their stamps.

    ``samples`` counts those handed out, ``refused`` the messages that are no samples. Few are
    held at a time. Where stamps go back for good, as when a recording was recorded once more,
    none follow until the pictures have caught up.
    """

    def __init__(self, recording: Recording, topic: str):
        self.topic = topic
        self.samples = self.refused = 0
        self._in_order = _sorted_by_stamp(self._read(recording))
        self._next = next(self._in_order, None)

    def until(self, stamp_ns: int) -> Iterator[ImuSample]:
        """Yield the samples not yet handed out that are no later than a picture's stamp."""
        while self._next is not None and self._next.stamp_ns <= stamp_ns:
            self.samples += 1
            yield self._next
            self._next = next(self._in_order, None)

    def _read(self, recording: Recording) -> Iterator[ImuSample]:
        """Yield the ImuSamples in the order in which they were recorded."""
        samples: Iterator[Callable[[], ImuSample]]
        if recording.telemetry is not None:
            samples = _measured(recording.telemetry)
        else:
            samples = (partial(imu_sample, msg, received_ns)
                       for received_ns, msg in recording.messages(self.topic))
        for sample in samples:
            try:
                yield sample()
            except ImuError as error:
                self.refused += 1
                if self.refused == 1:
                    logger.warning('%s: sample on %s left out, %s (more of these are only '
                                   'counted)', recording.name, self.topic, error)


def _measured(telemetry: Telemetry) -> Iterator[Callable[[], ImuSample]]:
    """Yield what makes an ImuSample of each measurement, in the order of time."""
    kinds = ((one, is_force) for one, is_force in (
        (telemetry.forces_m_s2, True), (telemetry.rates_rad_s, False)) if one is not None)
    for stamp_ns, is_force, vector in merge(
            *(zip(one.stamps_ns.tolist(), repeat(is_force), one.vectors)
              for one, is_force in kinds), key=itemgetter(0)):
        yield partial(ImuSample, stamp_ns, vector) if is_force else partial(
            ImuSample, stamp_ns, None, vector)


def _sorted_by_stamp(samples: Iterable[ImuSample]) -> Iterator[ImuSample]:
    """Yield samples in the order of their stamps, where none is MAX_DISORDER places off."""
    heap: list[tuple[int, int, ImuSample]] = []
    for number, sample in enumerate(samples):
        heappush(heap, (sample.stamp_ns, number, sample))
        if len(heap) > MAX_DISORDER:
            yield heappop(heap)[-1]
    while heap:
        yield heappop(heap)[-1]
