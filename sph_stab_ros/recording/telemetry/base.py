# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What all formats of telemetry are read into."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from sph_stab_ros.geometry.arrays import Floats, Stamps, Values
from sph_stab_ros.geometry.conventions import NS_PER_S
from sph_stab_ros.recording.base import RecordingError

# More than a day of a fast gyro: a damaged file must not fill the memory.
MAX_SAMPLES = 2**24
# Beyond, times are no times: a century.
MAX_TIME_S = 3e9


class Series(NamedTuple):
    """Stamps (N,) in ns that increase strictly, and a vector (N, 3) at each."""

    stamps_ns: Stamps
    vectors: Floats


@dataclass(frozen=True)
class Telemetry:
    """
    What a camera measured while it recorded a video, in the body's axes.

    ``rates_rad_s``, ``forces_m_s2`` (specific: 9.8 m/s² upwards at rest) and
    ``orientations_rad``, rotation vectors ``R_world_body``; each is None where it is not there.
    ``source`` names format and camera.
    """

    source: str
    rates_rad_s: Series | None = None
    forces_m_s2: Series | None = None
    orientations_rad: Series | None = None

    @property
    def is_of_imu(self) -> bool:
        """Tell whether a gyro or an accelerometer measured something."""
        return self.rates_rad_s is not None or self.forces_m_s2 is not None


def series(times_s: Values, vectors: Floats) -> Series | None:
    """
    Return the Series of measurements at times (N,), None where none is left.

    What is not finite is left out; the rest is sorted, and of equal stamps the first is kept.
    """
    usable = np.isfinite(vectors).all(axis=1) & (np.abs(times_s) < MAX_TIME_S)
    stamps_ns, first = np.unique(
        np.round(times_s[usable] * NS_PER_S).astype(np.int64), return_index=True)
    return Series(stamps_ns, vectors[usable][first]) if len(stamps_ns) else None


def single(vectors: Floats) -> Floats:
    """Return vectors with half the bytes; those too large become infinite."""
    with np.errstate(over='ignore', invalid='ignore'):
        return vectors.astype(np.float32)


def check_count(count: int) -> None:
    """Raise RecordingError where there are more samples than can be held."""
    if count > MAX_SAMPLES:
        raise RecordingError(f'more than {MAX_SAMPLES} measurements are in its metadata')
