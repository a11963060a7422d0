# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What became of the images: counted, logged without flooding, summed up for /diagnostics."""

from collections import Counter
from collections.abc import Callable, Hashable, Mapping
from threading import Lock
from time import monotonic
from typing import Any

from diagnostic_msgs.msg import DiagnosticStatus, KeyValue
import numpy as np

from sph_stab_ros.config import StabilizerConfig
from sph_stab_ros.geometry.arrays import Covariance, Mask, Vector
from sph_stab_ros.geometry.masks import share_of_sphere
from sph_stab_ros.images.appearance_watch import PictureWatch
from sph_stab_ros.images.frame import Frame
from sph_stab_ros.ros.cpu_meter import CpuMeter
from sph_stab_ros.stabilization.stabilized_frame import StabilizationEvent, StabilizedFrame
from sph_stab_ros.tracking import Tracker, TrackingStatus

LOG_PERIOD_S = 5.0
# What users are told of each status but ok.
NOT_OK = {
    TrackingStatus.UNCERTAIN: 'the orientation has become uncertain: ~/reset would start anew',
    TrackingStatus.PREDICTED: 'no rotation found: predicted',
    TrackingStatus.LOST: 'no rotation found: lost'}


class Diagnostics:
    """
    Counts frames, refused images and events; its methods may be called from any thread.

    ``cpu`` is the CpuMeter of the stages that a frame goes through; ``listens_to_imu`` says
    whether samples of an IMU are expected.

    Parameters
    ----------
    name : str
        The node's name, as the status shows it.
    warn : callable
        Logs a text as a warning.

    """

    def __init__(self, name: str, warn: Callable[[str], Any]) -> None:
        self.cpu = CpuMeter()
        self.listens_to_imu = False
        self._name = name
        self._log = ThrottledLog(warn)
        self._lock = Lock()
        self._frames = 0
        self._imu_samples = self._imu_refused = 0
        # Of the last sample, if it was refused.
        self._imu_error = ''
        self._refused: Counter[str] = Counter()
        self._events: Counter[str] = Counter()
        self._tracking: Counter[TrackingStatus] = Counter()
        self._status: TrackingStatus | None = None
        self._no_gravity = ''
        self._uncertainty_rad: float | None = None
        self._keyframes: int | None = None
        self._body_mask: Mask | None = None
        # The rotation vector in radians, and its covariance.
        self._lens_misalignment: tuple[Vector, Covariance] | None = None
        self._last_refusal: str | None = None
        self._watch = PictureWatch()
        self._start_period()

    def look_at(self, frame: Frame, config: StabilizerConfig) -> None:
        """Say what pictures seem to be that are taken for what they are not; of some Frames."""
        self._watch.config = config
        hint = self._watch.look(frame)
        if hint:
            self.event('other_pictures', hint)

    def count_frame(self, stabilized: StabilizedFrame, tracker: Tracker | None = None) -> None:
        """Count a StabilizedFrame of a Tracker's."""
        with self._lock:
            self._frames += 1
            self._status = stabilized.status
            self._no_gravity = ''
            if StabilizationEvent.NO_GRAVITY in stabilized.events:
                why = self._imu_error or stabilized.why_no_gravity
                self._no_gravity = f'{StabilizationEvent.NO_GRAVITY.value}: {why}'
            self._tracking[stabilized.status] += 1
            self._frames_in_period += 1
            self._uncertainty_rad = stabilized.uncertainty_rad
            self._keyframes = getattr(tracker, 'keyframes_kept', None)
            self._body_mask = getattr(tracker, 'body_mask', None)
            self._lens_misalignment = getattr(tracker, 'lens_misalignment', None)
        for event in stabilized.events:
            self.event(event.name.lower(), self._no_gravity
                       if event is StabilizationEvent.NO_GRAVITY else event.value)
        if stabilized.status is not TrackingStatus.OK:
            self._log.warn(stabilized.status, NOT_OK[stabilized.status])

    def count_latency(self, latency_s: float) -> None:
        """Count a frame of which everything was published so long after its receipt."""
        with self._lock:
            self._latencies_s.append(latency_s)

    def event(self, name: str, text: str) -> None:
        """Count and log something that users should hear of."""
        with self._lock:
            self._events[name] += 1
        self._log.warn(name, text)

    def refuse(self, reason: str, detail: object) -> None:
        """Count an image that cannot be used; ``reason`` is one of few, ``detail`` is logged."""
        with self._lock:
            self._refused[reason] += 1
            self._last_refusal = reason
        self._log.warn(reason, f'image refused, {detail}')

    def count_imu(self, samples: int) -> None:
        """Count samples of the IMU."""
        with self._lock:
            self._imu_samples += samples
            self._imu_samples_in_period += samples
            if samples:
                self._imu_error = ''

    def refuse_imu(self, error: Exception) -> None:
        """Count a message of the IMU's that cannot be used."""
        with self._lock:
            self._imu_refused += 1
            self._imu_error = str(error)
        self._log.warn('imu', f'imu ignored: {error}')

    def status(self, dropped: int, not_drawn: int, why_no_images: str = '',
               source: Mapping[str, Any] = {}) -> DiagnosticStatus:
        """
        Return the DiagnosticStatus of the time since the last call.

        So many frames were ``dropped`` in all, and so many tracked but not drawn;
        ``why_no_images`` says why there have been none for a while, where that is known, and
        ``source`` what there is to say of where they come from.
        """
        with self._lock:
            elapsed_s = monotonic() - self._period_start_s
            latencies_s = self._latencies_s
            level, message = self._judgement(why_no_images)
            values = {
                'tracking': self._status.value if self._status else 'waiting',
                'rate_hz': f'{self._frames_in_period / elapsed_s:.1f}',
                'latency_ms': f'{1e3 * sum(latencies_s) / max(len(latencies_s), 1):.1f}',
                'frames': self._frames,
                **{f'frames: {status.value}': self._tracking[status] for status in TrackingStatus},
                **self._state(),
                **source,
                'dropped': dropped,
                'not_drawn': not_drawn,
                'refused': sum(self._refused.values()),
                **{f'refused: {reason}': n for reason, n in sorted(self._refused.items())},
                **self._of_imu(elapsed_s),
                **{f'notice: {name}': n for name, n in sorted(self._events.items())},
            }
            values.update({f'cpu_percent: {stage}': f'{percent:.1f}'
                           for stage, percent in self.cpu.percentages().items()})
            self._start_period()
        return DiagnosticStatus(
            level=level, name=f'{self._name}: stabilization', message=message,
            values=[KeyValue(key=key, value=str(value)) for key, value in values.items()])

    def _state(self) -> dict[str, Any]:
        """Return what the tracker knew about itself at the last frame."""
        values: dict[str, Any] = {}
        if self._uncertainty_rad is not None:
            values['uncertainty_deg'] = f'{np.rad2deg(self._uncertainty_rad):.3f}'
        if self._keyframes is not None:
            values['keyframes'] = self._keyframes
        if self._body_mask is not None:
            values['still_percent'] = f'{100 * share_of_sphere(self._body_mask):.1f}'
        if self._lens_misalignment is not None:
            apart, covariance = self._lens_misalignment
            values['lens_misalignment_deg'] = ' '.join(f'{one:.3f}' for one in np.rad2deg(apart))
            values['lens_misalignment_sigma_deg'] = ' '.join(
                f'{one:.3f}' for one in np.rad2deg(np.sqrt(np.diag(covariance))))
        return values

    def _of_imu(self, elapsed_s: float) -> dict[str, Any]:
        return {'imu_rate_hz': f'{self._imu_samples_in_period / elapsed_s:.1f}',
                'imu_samples': self._imu_samples,
                'imu_refused': self._imu_refused} if self.listens_to_imu else {}

    def _start_period(self) -> None:
        self._period_start_s = monotonic()
        self._imu_samples_in_period = 0
        self._frames_in_period = 0
        self._latencies_s: list[float] = []
        self._last_refusal = None

    def _judgement(self, why_no_images: str) -> tuple[bytes, str]:
        """Return level and message of the present period."""
        if self._last_refusal:
            return DiagnosticStatus.WARN, ': '.join(filter(None, (
                'images are refused', self._last_refusal, self._watch.hint)))
        if not self._frames_in_period or self._status is None:
            return DiagnosticStatus.WARN, ': '.join(filter(None, ('no images', why_no_images)))
        if self._status is not TrackingStatus.OK:
            return DiagnosticStatus.WARN, NOT_OK[self._status]
        if self._no_gravity:
            return DiagnosticStatus.WARN, self._no_gravity
        if self._watch.hint:
            return DiagnosticStatus.WARN, self._watch.hint
        return DiagnosticStatus.OK, 'ok'


class ThrottledLog:
    """Says each kind of thing at most once in LOG_PERIOD_S, and how often it was not said."""

    def __init__(self, warn: Callable[[str], Any]) -> None:
        self._warn = warn
        self._next_s: dict[Hashable, float] = {}
        self._unsaid: Counter[Hashable] = Counter()

    def warn(self, kind: Hashable, text: str) -> None:
        """Log ``text`` unless something of the same kind was logged just now."""
        if monotonic() < self._next_s.get(kind, 0):
            self._unsaid[kind] += 1
            return
        unsaid = self._unsaid.pop(kind, 0)
        self._next_s[kind] = monotonic() + LOG_PERIOD_S
        self._warn(text + (f' ({unsaid} more of these before)' if unsaid else ''))
