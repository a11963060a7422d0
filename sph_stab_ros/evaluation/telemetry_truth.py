# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""
Truth that a video's camera measured itself.

An orientation that the camera computed is truth as any other. A gyro's rates are integrated: what
it shows at rest, its bias, turns that truth away for good. The constant part of it is found by
comparing turns over a second with an estimate's, and taken out; with it goes a constant drift of
the estimate, which cannot be told from it. What is left still drifts, so that errors over a second
tell more of the estimate than those since the first picture.
"""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from sph_stab_ros.evaluation.alignment import align_trajectories, Alignment, SPAN_S, turns
from sph_stab_ros.geometry.arrays import Stamps, Vector, Vectors
from sph_stab_ros.geometry.conventions import NS_PER_S
from sph_stab_ros.geometry.trajectory import Trajectory
from sph_stab_ros.recording import Recording, RecordingError
from sph_stab_ros.recording.telemetry import Telemetry

# Mount, clock and bias settle together.
ITERATIONS = 4


def is_of_gyro(recording: Recording) -> bool:
    """Tell whether the truth of a Recording is what a gyro measured."""
    return recording.telemetry is not None and recording.telemetry.orientations_rad is None


def telemetry_truth(name: str, telemetry: Telemetry) -> Trajectory:
    """Return the Trajectory ``R_world_body``; RecordingError where nothing tells of turning."""
    if telemetry.orientations_rad is not None:
        stamps_ns, vectors = telemetry.orientations_rad
        return Trajectory(stamps_ns, Rotation.from_rotvec(vectors))
    if telemetry.rates_rad_s is None:
        raise RecordingError(f'{name}: no gyro is in its metadata ({telemetry.source})')
    return integrated(*telemetry.rates_rad_s)


def integrated(stamps_ns: Stamps, rates_rad_s: Vectors) -> Trajectory:
    """Return the Trajectory of a gyro's rates (N, 3), which change evenly from one to the next."""
    elapsed_s = np.diff(stamps_ns)[:, None] / NS_PER_S
    steps = (rates_rad_s[1:] + rates_rad_s[:-1]) / 2 * elapsed_s
    return Trajectory(stamps_ns, _products(steps))


def without_bias(truth: Trajectory, bias_rad_s: Vector) -> Trajectory:
    """Return the Trajectory of the same gyro without what it shows at rest, (3,) on the body."""
    elapsed_s = np.diff(truth.stamps_ns)[:, None] / NS_PER_S
    steps = (truth.rotations[:-1].inv() * truth.rotations[1:]).as_rotvec() - bias_rad_s * elapsed_s
    return Trajectory(truth.stamps_ns, _products(steps))


def align_gyro(truth: Trajectory, estimate: Trajectory, R_body_camera: Rotation | None = None,
               clock_offset_ns: int | None = None) -> Alignment:
    """Return the Alignment of a gyro's truth and an estimate, with the gyro's bias."""
    bias_rad_s: Vector = np.zeros(3)
    for _ in range(ITERATIONS):
        unbiased = without_bias(truth, bias_rad_s)
        alignment = replace(
            align_trajectories(unbiased, estimate, R_body_camera, clock_offset_ns),
            gyro_bias_rad_s=bias_rad_s)
        body, camera, span_s = turns(unbiased, estimate, alignment.clock_offset_ns, SPAN_S)
        # The median, as the estimator may lose its way.
        bias_rad_s = bias_rad_s + np.median(
            body - alignment.R_body_camera.apply(camera), axis=0) / span_s
    return alignment


def _products(steps: Vectors) -> Rotation:
    """Return the products of the first 0, 1, … of N rotation vectors (N, 3), in log N steps."""
    R = Rotation.from_rotvec(np.vstack((np.zeros(3), steps)))
    done = 1
    while done < len(R):
        R = Rotation.concatenate((R[:done], R[:-done] * R[done:]))
        done *= 2
    return R
