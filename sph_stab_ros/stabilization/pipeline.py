# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The whole algorithm: track the camera's orientation, take it out of the picture."""

from collections import deque
from collections.abc import Iterator

import numpy as np
from scipy.spatial.transform import Rotation

from sph_stab_ros.config import IMU, StabilizerConfig, ViewConfig
from sph_stab_ros.geometry.arrays import Covariance, Vector
from sph_stab_ros.geometry.conventions import NS_PER_S
from sph_stab_ros.geometry.masks import common
from sph_stab_ros.geometry.projection import Projection
from sph_stab_ros.geometry.projection_factory import projection_of
from sph_stab_ros.geometry.rolling_shutter import readout_shares, RollingShutter
from sph_stab_ros.geometry.rotations import rotate_covariance
from sph_stab_ros.geometry.warp import view_rotation
from sph_stab_ros.images.frame import Frame
from sph_stab_ros.images.lens_matching import LensMatcher
from sph_stab_ros.images.sphere import as_sphere, config_for
from sph_stab_ros.stabilization.imu import ImuSample, ImuSamples, mount_rotation
from sph_stab_ros.stabilization.imu_history import ImuHistory
from sph_stab_ros.stabilization.level import Gravity, Leveler, LevelError, why_no_force
from sph_stab_ros.stabilization.readout_turn import ReadoutTurn
from sph_stab_ros.stabilization.smoothing import Smoother
from sph_stab_ros.stabilization.stabilized_frame import (
    LONG_GAP_S, StabilizationEvent, StabilizedFrame)
from sph_stab_ros.tracking import (
    make_tracker, MakeTracker, TrackedOrientation, Tracker, working_width)

# Two seconds of a fast IMU.
IMU_INBOX_SIZE = 2000


class Stabilizer:
    """
    Takes the camera's rotation out of a stream of frames.

    Parameters
    ----------
    config : StabilizerConfig
    make_tracker : callable
        Returns the Tracker to use, from the same arguments as ``tracking.make_tracker``: the place
        for an estimator of your own. ``seen`` is given where pictures show a part of the sphere
        only, ``readout_shares`` where the shutter rolls.

    """

    def __init__(self, config: StabilizerConfig = StabilizerConfig(),
                 make_tracker: MakeTracker = make_tracker) -> None:
        self._make_tracker = make_tracker
        # Filled by add_imu, in another thread maybe, and emptied by process.
        self._imu_inbox: deque[tuple[int, Vector, Vector]] = deque(maxlen=IMU_INBOX_SIZE)
        self._imu = ImuHistory()
        # The last picture before which something came.
        self._heard_imu_ns: int | None = None
        self._gravity = Gravity()
        self._leveler = Leveler()
        self._smoother = Smoother()
        self._readout_turn = ReadoutTurn()
        self._lens_matcher = LensMatcher()
        self.config = config
        self.reset()

    @property
    def tracker(self) -> Tracker | None:
        """Return the Tracker at work; None before the first frame."""
        return self._tracker

    def reset(self) -> None:
        """Make the next frame's orientation the world's."""
        self._tracker: Tracker | None = None
        self._last: Frame | None = None
        self._clock_ahead_ns = 0
        # The tracker's orientations count from the origin, the world is that made level.
        self._R_origin_start = Rotation.identity()
        self._R_origin_camera = Rotation.identity()
        self._gravity.reset()
        self._leveler.reset()
        self._smoother.reset()
        self._readout_turn.reset()
        # Of the start and of the last frame; None where it is not known.
        self._start_covariance: Covariance | None = np.zeros((3, 3))
        self._covariance: Covariance | None = self._start_covariance

    def reconfigure(self, config: StabilizerConfig) -> None:
        """
        Take on another config.

        A tracker that changes by it starts anew at the last frame, in the orientation reached.
        """
        if config.tracker != self.config.tracker:
            self._tracker = None
        if any(getattr(config, name) != getattr(self.config, name)
               for name in ('projection', 'fisheye', 'crop', 'cubemap', 'layout')):
            self._tracker = self._last = None
        if config.imu != self.config.imu:
            self._imu.clear()
        if (config.imu, config.level) != (self.config.imu, self.config.level):
            self._gravity.reset()
        self.config = config

    def add_imu(self, sample: ImuSample) -> None:
        """Take in a sample; may be called from any thread while frames are processed."""
        self.add_imu_samples(ImuSamples.of((sample,)))

    def add_imu_samples(self, samples: ImuSamples) -> None:
        """Take in samples; may be called from any thread while frames are processed."""
        self._imu_inbox.extend(zip(
            samples.stamps_ns.tolist(), samples.forces_m_s2, samples.rates_rad_s))

    def forget_imu(self) -> None:
        """Forget what was felt so far, because the clock was set back."""
        self._imu.clear()

    def level_here(self) -> None:
        """
        Make the present orientation level, keeping its heading, or raise LevelError.

        May be called from any thread while frames are processed.
        """
        if self.config.level == IMU:
            raise LevelError('the IMU says what is level')
        self._leveler.level_here()

    def process(self, frame: Frame) -> StabilizedFrame:
        """Return the StabilizedFrame of the next Frame, or raise ProjectionError."""
        frame = as_sphere(frame, config := config_for(frame, self.config))
        self._projection = projection_of(frame.size_wh, config)
        frame = self._lens_matcher.matched(frame, self._projection, self.config.fisheye)
        events = tuple(self._events(frame))
        tracker = self._tracker
        if tracker is None or StabilizationEvent.RESIZED in events:
            tracker = self._started(frame, config)
        self._take_in_imu(frame.time_ns)
        tracked = self._track(tracker, frame, self._projection)
        self._R_origin_camera = self._R_origin_start * tracked.R_world_camera
        self._covariance = self._in_origin(tracked.covariance)
        R_world_origin = self._level(frame)
        R_world_camera = R_world_origin * self._R_origin_camera
        covariance = (None if self._covariance is None
                      else rotate_covariance(self._covariance, R_world_origin))
        R_world_virtual = self._smoother.update(
            self.config.smoothing, frame.time_ns, R_world_camera)
        self._last = frame
        why = self._why_no_gravity(frame) if StabilizationEvent.NO_GRAVITY in events else ''
        return StabilizedFrame(frame, R_world_camera, tracked.status, events, covariance,
                               R_world_virtual, self._as_read(frame), why)

    def settle(self) -> None:
        """Do what the last frame did not have to wait for; the next one will do it otherwise."""
        if self._tracker is not None:
            self._tracker.settle()

    def _events(self, frame: Frame) -> Iterator[StabilizationEvent]:
        if self._last is None:
            return
        if frame.size_wh != self._last.size_wh:
            yield StabilizationEvent.RESIZED
        elapsed_s = (frame.time_ns - self._last.time_ns) / NS_PER_S
        if elapsed_s <= 0:
            yield StabilizationEvent.STAMP_NOT_INCREASING
        elif elapsed_s > LONG_GAP_S:
            yield StabilizationEvent.GAP
        if self.config.level == IMU and self._gravity.age_s(frame.clock_ns) > LONG_GAP_S:
            yield StabilizationEvent.NO_GRAVITY

    def _started(self, frame: Frame, config: StabilizerConfig) -> Tracker:
        """Start a tracker for frames of this size, at the last frame and its orientation."""
        width = min(working_width(self.config.tracker), self._projection.sphere_width)
        part = common(self._projection.seen(width),
                      frame.layout.seen(width) if frame.layout else None)
        seen = () if part is None else (part,)
        rolling = {}
        if self.config.tracker.rolling_shutter_s:
            self._readout_shares = readout_shares(
                self._projection, frame.size_wh, self.config)
            rolling['readout_shares'] = self._readout_shares
        self._working_width = width
        tracker = self._tracker = self._make_tracker(
            self.config.tracker, width, self._gyro_rotation, *seen, **rolling)
        self._R_origin_start = self._R_origin_camera
        self._start_covariance = self._covariance
        if self._last is not None:
            # Of another size perhaps: the tracker gets all at its own.
            self._track(tracker, self._last, projection_of(self._last.size_wh, config))
        return tracker

    def _in_origin(self, covariance: Covariance | None) -> Covariance | None:
        """Return a covariance of the tracker's with that of its start added."""
        if covariance is None or self._start_covariance is None:
            return None
        return self._start_covariance + rotate_covariance(covariance, self._R_origin_start)

    def _take_in_imu(self, time_ns: int) -> None:
        rows = [self._imu_inbox.popleft() for _ in range(len(self._imu_inbox))]
        if not rows:
            return
        self._heard_imu_ns = time_ns
        stamps_ns, forces_m_s2, rates_rad_s = map(np.array, zip(*rows))
        imu = self.config.imu
        self._imu.add(ImuSamples(stamps_ns, forces_m_s2, rates_rad_s), mount_rotation(
            *np.deg2rad((imu.roll_deg, imu.pitch_deg, imu.yaw_deg))))

    def _level(self, frame: Frame) -> Rotation:
        """Return R_world_origin."""
        up = None
        if self.config.level == IMU:
            self._gravity.weigh(frame.clock_ns, self._R_origin_camera, self._imu)
            up = self._gravity.up
        return self._leveler.update(frame.time_ns, self._R_origin_camera, up)

    def _as_read(self, frame: Frame) -> Projection:
        """Return how the picture shows the sphere, also where its rows were read in turn."""
        readout_s = self.config.tracker.rolling_shutter_s
        if not readout_s:
            return self._projection
        return RollingShutter(self._projection, self._readout_shares, self._readout_turn.update(
            frame.time_ns, self._R_origin_camera, readout_s))

    def _why_no_gravity(self, frame: Frame) -> str:
        heard_ns = self._heard_imu_ns
        if heard_ns is None or frame.time_ns - heard_ns > LONG_GAP_S * NS_PER_S:
            return 'none is heard'
        return why_no_force(frame.clock_ns, self._imu)

    def _track(
            self, tracker: Tracker, frame: Frame, projection: Projection) -> TrackedOrientation:
        self._clock_ahead_ns = frame.clock_ns - frame.time_ns
        grey = projection.grey_sphere(frame, self._working_width)
        return tracker.track(grey, frame.time_ns)

    def _gyro_rotation(self, from_ns: int, to_ns: int) -> Rotation | None:
        """Return the turn as the gyro saw it between times of frames; its stamps are a clock's."""
        return self._imu.gyro_rotation(
            from_ns + self._clock_ahead_ns, to_ns + self._clock_ahead_ns)


def view_direction(view: ViewConfig) -> Rotation:
    """Return R_virtual_view."""
    return view_rotation(*np.deg2rad((view.yaw_deg, view.pitch_deg, view.roll_deg)))
