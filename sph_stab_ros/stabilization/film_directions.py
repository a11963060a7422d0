# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""
Where the virtual camera of a film looks: directions at given times, from a file or from a topic.

In between it turns smoothly: yaw and pitch are monotone cubic splines (F. N. Fritsch and
R. E. Carlson, *Monotone piecewise cubic interpolation*, SIAM J. Numerical Analysis 17, 1980), so
that it passes through each direction, never swings beyond two neighbouring ones, rests where two
are the same, and keeps the horizon level. Before the first and behind the last one it rests.
"""

from collections.abc import Sequence
import logging
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from sph_stab_ros.config import ConfigError
from sph_stab_ros.config.ros_yaml import read_yaml
from sph_stab_ros.geometry.conventions import NS_PER_S, stamp_ns
from sph_stab_ros.geometry.rotations import is_unit_quaternion
from sph_stab_ros.geometry.warp import view_rotation
from sph_stab_ros.images.frame import Frame
from sph_stab_ros.recording import Recording, RecordingError
from sph_stab_ros.recording.messages import QUATERNION
from sph_stab_ros.stabilization.steering import view_angles

logger = logging.getLogger(__name__)

# More are none: 30 years, and a thousand turns.
MAX_TIME_S, MAX_YAW_DEG = 1e9, 360e3
KEYS = {'time_s', 'yaw_deg', 'pitch_deg'}


def read_directions(path: Path) -> list[list[float]]:
    """
    Return N times time, yaw and pitch, in seconds and radians, of a list in a YAML file.

    Each item is ``{time_s: 3.5, yaw_deg: 90, pitch_deg: -10}``, pitch 0 by default. Yaw goes the
    way that the numbers go: from 350 to 370 it is 20 degrees. ConfigError where it is none.
    """
    try:
        items = read_yaml(path)
    except ConfigError as error:
        raise ConfigError(f'{path} cannot be read: {error}') from None
    if not isinstance(items, list) or not items:
        raise ConfigError(f'{path} is not a list of directions')
    rows: list[list[float]] = []
    for number, item in enumerate(items, 1):
        if not isinstance(item, dict) or not {'time_s', 'yaw_deg'} <= {*item} <= KEYS:
            raise ConfigError(f'{path}, direction {number}: time_s, yaw_deg and pitch_deg are it')
        row = [item['time_s'], item['yaw_deg'], item.get('pitch_deg', 0)]
        # Written so that NaN fails too.
        if not all(type(one) in (int, float) and abs(one) <= limit
                   for one, limit in zip(row, (MAX_TIME_S, MAX_YAW_DEG, 90))):
            raise ConfigError(f'{path}, direction {number}: not all are numbers, of 90 degrees of '
                              'pitch at most')
        if rows and row[0] <= rows[-1][0]:
            raise ConfigError(f'{path}, direction {number}: time_s is not later than before')
        rows.append(row)
    return [[time_s, *np.deg2rad(angles_deg).tolist()] for time_s, *angles_deg in rows]


def recorded_directions(recording: Recording, topic: str) -> list[list[float]]:
    """Return the same of a topic of a bag, by stamps; yaw goes the shortest way."""
    if recording.topics.get(topic) != QUATERNION:
        raise RecordingError(f'{recording.name} has no topic {topic} of {QUATERNION}')
    rows: dict[float, tuple[float, float]] = {}
    left_out = 0
    for received_ns, msg in recording.messages(topic):
        q = msg.quaternion
        values = q.x, q.y, q.z, q.w
        # As the node would have.
        if not is_unit_quaternion(values):
            left_out += 1
            continue
        time_s = (stamp_ns(msg.header.stamp) or received_ns) / NS_PER_S
        rows[time_s] = view_angles(Rotation.from_quat(values))[:2]
    if left_out:
        logger.warning('%s: %d messages without a unit quaternion, left out', topic, left_out)
    if not rows:
        raise RecordingError(f'{recording.name} has no directions in {topic}')
    times_s = sorted(rows)
    yaws_rad, pitches_rad = np.array([rows[time_s] for time_s in times_s]).T
    return np.column_stack((times_s, np.unwrap(yaws_rad), pitches_rad)).tolist()


class DirectionPath:
    """
    Where a view looks along a path of time, yaw and pitch, N times.

    Parameters
    ----------
    path
        As ``read_directions`` returns it.
    by_clock
        Whether its times are those of stamps, or count from the first frame asked for.

    """

    def __init__(self, path: Sequence[Sequence[float]], by_clock: bool = False) -> None:
        # An eighth of the time that every replay takes to start, for whoever needs it.
        from scipy.interpolate import PchipInterpolator
        # It rests a second before and behind, so that it sets off and stops smoothly.
        (first_s, *first), (last_s, *last) = path[0], path[-1]
        times_s, *columns = zip((first_s - 1, *first), *path, (last_s + 1, *last))
        self._angles_rad = PchipInterpolator(times_s, np.column_stack(columns))
        self._first_s, self._last_s = first_s, last_s
        self._by_clock = by_clock
        self._begin_ns: int | None = None

    def __call__(self, frame: Frame) -> Rotation:
        """Return R_virtual_view for a Frame."""
        if self._begin_ns is None:
            self._begin_ns = 0 if self._by_clock else frame.time_ns
        time_ns = frame.clock_ns if self._by_clock else frame.time_ns
        return view_rotation(*self._angles_rad(np.clip(
            (time_ns - self._begin_ns) / NS_PER_S, self._first_s, self._last_s)))
