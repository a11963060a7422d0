# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""
How far estimated orientations are off the truth.

All errors are of orientations relative to the first frame evaluated. Roll, pitch and yaw are those
of the camera's own REP 103 body (x forward along the image centre, y left, z up), not of the
truth's, whose axes point anywhere on a motion-capture rigid body.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from sph_stab_ros.evaluation.alignment import (
    Alignment, check_overlap, EvaluationError, has_truth)
from sph_stab_ros.evaluation.report import Figures
from sph_stab_ros.geometry.arrays import Choice, Stamps, Values, Vectors
from sph_stab_ros.geometry.conventions import NS_PER_S, R_BODY_CAMERA, R_CAMERA_BODY
from sph_stab_ros.geometry.trajectory import Trajectory


@dataclass(frozen=True)
class Errors:
    """
    Errors of N orientations over time, each relative to the first.

    ``truth`` and ``estimate`` are the Trajectories of R_first_camera, with the images' stamps;
    ``time_s`` (N,) starts at zero; ``truth_rpy_deg`` and ``estimate_rpy_deg`` (N, 3) are roll,
    pitch and yaw, without jumps; ``geodesic_deg`` (N,) is the angle of the rotation between truth
    and estimate; ``per_frame_deg`` (≤ N − 1,) that between their turns from one frame to the next,
    ``per_second_deg`` that over a second, or over all if that is shorter; ``drift_deg_per_min``
    the constant angular velocity that fits the error best.
    """

    truth: Trajectory
    estimate: Trajectory
    time_s: Values
    truth_rpy_deg: Vectors
    estimate_rpy_deg: Vectors
    geodesic_deg: Values
    per_frame_deg: Values
    per_second_deg: Values
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
            'per_frame_deg': _spread(self.per_frame_deg),
            'per_second_deg': _spread(self.per_second_deg),
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
           consecutive: Choice | None = None) -> Errors:
    """
    Return the Errors of N orientations of the camera, true and estimated, in any two worlds.

    ``consecutive`` (N − 1,) bool tells which neighbours are consecutive frames; all by default.
    """
    if consecutive is None:
        consecutive = np.ones(len(stamps_ns) - 1, bool)
    time_s = (stamps_ns - stamps_ns[0]) / NS_PER_S
    truth, estimate = (Trajectory(stamps_ns, R).relative_to_first()
                       for R in (R_mocap_camera, R_world_camera))
    true, estimated = (R_BODY_CAMERA * one.rotations * R_CAMERA_BODY for one in (truth, estimate))
    error = (estimated * true.inv()).as_rotvec(degrees=True)
    return Errors(
        truth, estimate, time_s,
        roll_pitch_yaw_deg(truth.rotations), roll_pitch_yaw_deg(estimate.rotations),
        np.linalg.norm(error, axis=1), _of_turns_deg(true, estimated, consecutive, 1),
        _of_turns_deg(true, estimated, consecutive, _frames_in_a_second(time_s, consecutive)),
        # Least squares of error(t) = drift · t, in the world, where a bias of the estimator adds
        # up.
        float(np.linalg.norm(time_s @ error) / (time_s @ time_s) * 60))


def roll_pitch_yaw_deg(R_world_camera: Rotation) -> Vectors:
    """
    Return roll, pitch and yaw (N, 3) in degrees of N orientations, without jumps of 360°.

    They are of the body that looks where the camera does, ``R = R_z(yaw) R_y(pitch) R_x(roll)``.
    """
    R_world_body = R_BODY_CAMERA * R_world_camera * R_CAMERA_BODY
    return np.unwrap(R_world_body.as_euler('ZYX', degrees=True)[:, ::-1], axis=0, period=360)


def _frames_in_a_second(time_s: Values, consecutive: Choice) -> int:
    """Return how many frames a second has, of consecutive ones only, or how many there are."""
    in_a_row = np.diff(np.flatnonzero(np.concatenate(([True], ~consecutive, [True]))))
    wanted = round(1 / max(float(np.median(np.diff(time_s))), 1e-3))
    return int(np.clip(wanted, 1, in_a_row.max() - 1))


def _of_turns_deg(true: Rotation, estimated: Rotation, consecutive: Choice, span: int) -> Values:
    """Return the angles between true and estimated turns over so many consecutive frames."""
    true_turns, estimated_turns = (R[:-span].inv() * R[span:] for R in (true, estimated))
    breaks = np.concatenate(([0], np.cumsum(~consecutive)))
    whole = breaks[span:] == breaks[:-span]
    return np.rad2deg((true_turns.inv() * estimated_turns).magnitude()[whole])


def _spread(values: Values) -> dict[str, float]:
    return {'median': float(np.median(values)), 'p95': float(np.percentile(values, 95)),
            'max': float(values.max())}
