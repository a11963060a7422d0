# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""
Run estimators over a recording and compare their orientations with ground truth.

All errors are of orientations relative to the first frame evaluated. Roll, pitch and yaw are those
of the camera's own REP 103 body (x forward along the image centre, y left, z up), not of the
truth's, whose axes point anywhere on a motion-capture rigid body.
"""

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass
from time import perf_counter
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from sph_stab_ros.config import StabilizerConfig
from sph_stab_ros.evaluation.alignment import (
    align_trajectories, Alignment, check_overlap, EvaluationError, has_truth)
from sph_stab_ros.evaluation.injection import injected_rotations, ShakenStabilizer
from sph_stab_ros.evaluation.report import Figures
from sph_stab_ros.geometry.arrays import Choice, Stamps, Values, Vectors
from sph_stab_ros.geometry.conventions import NS_PER_S, R_BODY_CAMERA, R_CAMERA_BODY
from sph_stab_ros.geometry.trajectory import Trajectory
from sph_stab_ros.images.frame import Frame
from sph_stab_ros.images.picture_watch import PictureWatch
from sph_stab_ros.recording import Recording
from sph_stab_ros.stabilization.imu import ImuSample
from sph_stab_ros.stabilization.pipeline import StabilizedFrame, Stabilizer
from sph_stab_ros.stabilization.recorded_imu import RecordedImu
from sph_stab_ros.stabilization.recording_loop import stabilize_recording
from sph_stab_ros.tracking import make_tracker, MakeTracker, TrackingStatus
from sph_stab_ros.tracking.offline import TwoPasses

# Passes on the frames that the estimator of a name is given, and may tell of it.
Progress: TypeAlias = Callable[[str, Iterator[Frame]], Iterable[Frame]]


@dataclass(frozen=True)
class Errors:
    """
    Errors of N orientations over time, each relative to the first.

    ``truth`` and ``estimate`` are the Trajectories of R_first_camera, with the images' stamps;
    ``time_s`` (N,) starts at zero; ``truth_rpy_deg`` and ``estimate_rpy_deg`` (N, 3) are roll,
    pitch and yaw, without jumps; ``geodesic_deg`` (N,) is the angle of the rotation between truth
    and estimate; ``per_frame_deg`` (≤ N − 1,) that between their turns from one frame to the next;
    ``drift_deg_per_min`` the constant angular velocity that fits the error best.
    """

    truth: Trajectory
    estimate: Trajectory
    time_s: Values
    truth_rpy_deg: Vectors
    estimate_rpy_deg: Vectors
    geodesic_deg: Values
    per_frame_deg: Values
    drift_deg_per_min: float

    @property
    def absolute_rpy_deg(self) -> Vectors:
        """Absolute errors (N, 3) of roll, pitch and yaw."""
        difference = self.estimate_rpy_deg - self.truth_rpy_deg
        return np.abs((difference + 180) % 360 - 180)

    def summary(self) -> Figures:
        """Return the figures by name, in degrees, ready for JSON."""
        roll, pitch, yaw = self.absolute_rpy_deg.mean(axis=0).tolist()
        return {
            'frames': len(self.time_s),
            'mean_abs_error_deg': {'roll': roll, 'pitch': pitch, 'yaw': yaw},
            'geodesic_deg': {
                'mean': float(self.geodesic_deg.mean()),
                'max': float(self.geodesic_deg.max()),
                'end': float(self.geodesic_deg[-1])},
            'per_frame_deg': {
                'median': float(np.median(self.per_frame_deg)),
                'p95': float(np.percentile(self.per_frame_deg, 95)),
                'max': float(self.per_frame_deg.max())},
            'drift_deg_per_min': self.drift_deg_per_min,
        }

    def over_time(self, period_s: float) -> dict[str, list[float]]:
        """Return the geodesic error at the frames nearest to each multiple of a period."""
        # The frame that would close the last period need not be there.
        end_s = self.time_s[-1] + np.median(np.diff(self.time_s))
        wanted_s = period_s * np.arange(1, 1 + int(end_s / period_s + 1e-6))
        after = np.clip(np.searchsorted(self.time_s, wanted_s), 1, len(self.time_s) - 1)
        before_is_nearer = 2 * wanted_s < self.time_s[after - 1] + self.time_s[after]
        nearest = after - before_is_nearer
        return {'time_s': self.time_s[nearest].tolist(),
                'geodesic_deg': self.geodesic_deg[nearest].tolist()}


def compare(truth: Trajectory, estimate: Trajectory, alignment: Alignment) -> Errors:
    """
    Return the Errors of the Trajectory ``estimate`` against ``truth`` at the estimate's stamps.

    Frames without truth (outside of it, or in its gaps) are left out; EvaluationError if fewer
    than MIN_FRAMES remain.
    """
    stamps_ns = estimate.stamps_ns + alignment.clock_offset_ns
    check_overlap(truth, stamps_ns)
    known = has_truth(truth, stamps_ns)
    R_mocap_camera = truth.at(stamps_ns[known]) * alignment.R_body_camera
    consecutive = np.diff(np.flatnonzero(known)) == 1
    if not consecutive.any():
        raise EvaluationError('no two consecutive frames have truth')
    return errors(
        estimate.stamps_ns[known], R_mocap_camera, estimate.rotations[known], consecutive)


def errors(stamps_ns: Stamps, R_mocap_camera: Rotation, R_world_camera: Rotation,
           consecutive: Choice | slice = slice(None)) -> Errors:
    """
    Return the Errors of N orientations of the camera, true and estimated, in any two worlds.

    ``consecutive`` (N − 1,) bool tells which neighbours are consecutive frames.
    """
    time_s = (stamps_ns - stamps_ns[0]) / NS_PER_S
    truth, estimate = (Trajectory(stamps_ns, R).relative_to_first()
                       for R in (R_mocap_camera, R_world_camera))
    true, estimated = (R_BODY_CAMERA * one.rotations * R_CAMERA_BODY for one in (truth, estimate))
    error = (estimated * true.inv()).as_rotvec(degrees=True)
    true_turns, estimated_turns = (R[:-1].inv() * R[1:] for R in (true, estimated))
    per_frame_rad = (true_turns.inv() * estimated_turns).magnitude()[consecutive]
    return Errors(
        truth, estimate, time_s, _roll_pitch_yaw_deg(true), _roll_pitch_yaw_deg(estimated),
        np.linalg.norm(error, axis=1), np.rad2deg(per_frame_rad),
        # Least squares of error(t) = drift · t, in the world, where a bias of the estimator adds
        # up.
        float(np.linalg.norm(time_s @ error) / (time_s @ time_s) * 60))


def _roll_pitch_yaw_deg(R_first_body: Rotation) -> Vectors:
    """Return (N, 3) degrees of ``R = R_z(yaw) R_y(pitch) R_x(roll)``, without jumps of 360°."""
    return np.unwrap(R_first_body.as_euler('ZYX', degrees=True)[:, ::-1], axis=0, period=360)


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
        offline: Collection[str] = ()) -> tuple[Alignment, dict[str, Errors], dict[str, Figures]]:
    """
    Evaluate StabilizerConfigs, by name, against the Trajectory of a recording's truth.

    Each is fed the samples of an IMU where ``imu_topic`` names one; ``watch`` sees the pictures.
    Of the names in ``offline`` the orientations are those found with the whole recording known.

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
    found, failures = [], []
    for run in runs.values():
        try:
            found.append(align_trajectories(
                truth, run.trajectory(), R_body_camera, clock_offset_ns))
        except EvaluationError as error:
            failures.append(error)
    if not found:
        raise failures[0]
    alignment = min(found, key=lambda one: one.residual_rad)
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
