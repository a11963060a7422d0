# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Run estimators over a recording and compare their orientations with ground truth."""

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from time import perf_counter
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from sph_stab_ros.config import StabilizerConfig
from sph_stab_ros.evaluation.alignment import align_trajectories, Alignment, EvaluationError
from sph_stab_ros.evaluation.injection import injected_rotations, ShakenStabilizer
from sph_stab_ros.evaluation.orientation_errors import compare, Errors
from sph_stab_ros.evaluation.report import Figures
from sph_stab_ros.evaluation.telemetry_truth import align_gyro, without_bias
from sph_stab_ros.geometry.trajectory import Trajectory
from sph_stab_ros.images.appearance_watch import PictureWatch
from sph_stab_ros.images.frame import Frame
from sph_stab_ros.recording import Recording
from sph_stab_ros.stabilization.imu import ImuSample
from sph_stab_ros.stabilization.pipeline import Stabilizer
from sph_stab_ros.stabilization.recorded_imu import RecordedImu
from sph_stab_ros.stabilization.recording_loop import stabilize_recording
from sph_stab_ros.stabilization.stabilized_frame import StabilizedFrame
from sph_stab_ros.tracking import make_tracker, MakeTracker, TrackingStatus
from sph_stab_ros.tracking.offline import TwoPasses

# Passes on the frames that the estimator of a name is given, and may tell of it.
Progress: TypeAlias = Callable[[str, Iterator[Frame]], Iterable[Frame]]


class Run:
    """A Stabilizer that keeps the orientations it finds, and how long each took."""

    def __init__(self, config: StabilizerConfig,
                 make_tracker: MakeTracker = make_tracker) -> None:
        self._stabilizer = Stabilizer(config, make_tracker)
        self._stamps_ns: list[int] = []
        self._rotations: list[Rotation] = []
        self._times_s: list[float] = []
        self._lost = 0
        # What was done before the first frame.
        self.prepared_s = 0.

    def add_imu(self, sample: ImuSample) -> None:
        """Take in an ImuSample."""
        self._stabilizer.add_imu(sample)

    def process(self, frame: Frame) -> StabilizedFrame:
        """Return the StabilizedFrame of a Frame."""
        # Which is not the estimator's work.
        frame.load()
        start_s = perf_counter()
        stabilized = self._stabilizer.process(frame)
        self._times_s.append(perf_counter() - start_s)
        self._stamps_ns.append(stabilized.stamp_ns)
        self._rotations.append(stabilized.R_world_camera)
        self._lost += stabilized.status is not TrackingStatus.OK
        return stabilized

    @property
    def spent_s(self) -> float:
        """Return how long it took."""
        return self.prepared_s + sum(self._times_s)

    def trajectory(self) -> Trajectory:
        """Return the Trajectory found; frames whose stamps go back are left out."""
        return increasing(self._stamps_ns, Rotation.concatenate(self._rotations))

    def true_trajectory(self, rotations: Rotation) -> Trajectory:
        """Return the Trajectory of other orientations of the same frames."""
        return increasing(self._stamps_ns, rotations)

    def summary(self, errors: Errors) -> Figures:
        """
        Return the figures of the run and its Errors.

        Predicted and held frames count as lost; not evaluated are those without truth and those
        whose stamps go back.
        """
        return errors.summary() | {
            'ms_per_frame': 1000 * self.spent_s / len(self._times_s),
            'lost_frames': self._lost,
            'frames_not_evaluated': len(self._times_s) - len(errors.time_s)}


def offline_run(config: StabilizerConfig, read: Callable[[Run], Any]) -> Run:
    """Return a Run of the frames that ``read`` has processed, which are known to it by then."""
    passes = TwoPasses()
    first = Run(config, passes.first_tracker)
    read(first)
    start_s = perf_counter()
    passes.finish()
    run = Run(config, passes.known_tracker)
    run.prepared_s = first.spent_s + perf_counter() - start_s
    return run


def evaluate_against_truth(
        recording: Recording, configs: Mapping[str, StabilizerConfig], truth: Trajectory,
        R_body_camera: Rotation | None = None, clock_offset_ns: int | None = 0,
        max_frames: int | None = None, progress: Progress = lambda name, frames: frames,
        imu_topic: str | None = None, watch: PictureWatch | None = None,
        offline: Collection[str] = (), of_gyro: bool = False
        ) -> tuple[Alignment, dict[str, Errors], dict[str, Figures]]:
    """
    Evaluate StabilizerConfigs, by name, against the Trajectory of a recording's truth.

    Each is fed the samples of an IMU where ``imu_topic`` names one; ``watch`` sees the pictures.
    Of the names in ``offline`` the orientations are those found with the whole recording known.
    A truth ``of_gyro`` is rid of its bias.

    Mount and clock offset, where they are None, are those that the estimator gives which follows
    the truth best: they belong to the recording, and a bad estimator must neither suffer from nor
    profit by its own. Returns the Alignment, and by name Errors and summaries of figures.
    """
    runs = {}
    for name, config in configs.items():
        def read(run: Run) -> None:
            stabilize_recording(recording, run, max_frames=max_frames,
                                progress=lambda frames: progress(name, frames),
                                imu=RecordedImu(recording, imu_topic) if imu_topic else None,
                                watch=watch)
        runs[name] = offline_run(config, read) if name in offline else Run(config)
        read(runs[name])
    align = align_gyro if of_gyro else align_trajectories
    found, failures = [], []
    for run in runs.values():
        try:
            found.append(align(truth, run.trajectory(), R_body_camera, clock_offset_ns))
        except EvaluationError as error:
            failures.append(error)
    if not found:
        raise failures[0]
    alignment = min(found, key=lambda one: one.residual_rad)
    if alignment.gyro_bias_rad_s is not None:
        truth = without_bias(truth, alignment.gyro_bias_rad_s)
    errors = {name: compare(truth, run.trajectory(), alignment) for name, run in runs.items()}
    return alignment, errors, {name: run.summary(errors[name]) for name, run in runs.items()}


def evaluate_injected(
        recording: Recording, configs: Mapping[str, StabilizerConfig], seed: int, frames: int,
        body: str = '', progress: Progress = lambda name, frames: frames,
        offline: Collection[str] = ()) -> tuple[dict[str, Errors], dict[str, Figures]]:
    """
    Evaluate StabilizerConfigs, by name, on so many frames turned by the rotations of a seed.

    The ``body`` (as ``load_mask`` takes it) stays where it is. Of the names in ``offline`` the
    orientations of both clips are those found with the whole of them known.

    Returns by name Errors and summaries of figures, to which ``clip_turn_deg`` is added: the
    largest angle from the first frame in the clip as it is.
    """
    errors, figures = {}, {}
    for name, config in configs.items():
        def read(clip_tracker: MakeTracker, shaken: Run) -> ShakenStabilizer:
            both = ShakenStabilizer(Stabilizer(config, clip_tracker), shaken,
                                    injected_rotations(seed, frames), body)
            stabilize_recording(recording, both, max_frames=frames,
                                progress=lambda frames: progress(name, frames))
            return both
        if name in offline:
            clip = TwoPasses()
            shaken = offline_run(config, lambda run: read(clip.first_tracker, run))
            clip.finish()
            both = read(clip.known_tracker, shaken)
        else:
            shaken = Run(config)
            both = read(make_tracker, shaken)
        errors[name] = compare(shaken.true_trajectory(both.true_rotations()), shaken.trajectory(),
                               Alignment(Rotation.identity()))
        figures[name] = shaken.summary(errors[name]) | {
            'clip_turn_deg': float(np.rad2deg(both.clip_rotations().magnitude().max()))}
    return errors, figures


def increasing(stamps_ns: ArrayLike, rotations: Rotation) -> Trajectory:
    """Return the Trajectory of those of N orientations that are later than all before."""
    given_ns = np.asarray(stamps_ns, np.int64)
    latest_ns = np.maximum.accumulate(given_ns)
    later = np.append(True, given_ns[1:] > latest_ns[:-1])
    return Trajectory(given_ns[later], rotations[later])
