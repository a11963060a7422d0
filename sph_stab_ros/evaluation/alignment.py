# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""
Align ground truth with the camera: the mount rotation and the offset between their clocks.

Truth is the orientation ``R_mocap_body`` of some body in some world, on some clock; the estimate
is ``R_world_camera``. With the constant mount rotation ``R_body_camera``::

    R_mocap_body(t + clock offset) R_body_camera = R_mocap_world R_world_camera(t)

Neither world matters where turns from one moment to another are compared.
"""

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.optimize import minimize_scalar
from scipy.signal import correlate, correlation_lags
from scipy.spatial.transform import Rotation

from sph_stab_ros.geometry.arrays import Choice, Stamps, Values, Vector, Vectors
from sph_stab_ros.geometry.conventions import NS_PER_S, R_BODY_CAMERA
from sph_stab_ros.geometry.trajectory import Trajectory

MIN_FRAMES = 10
# Truth is interpolated over pauses up to this, or up to so many of its own intervals. Slerp errs
# by the angular acceleration times Δt² / 8: by 0.03° over this pause at 100°/s².
MAX_GAP_S = 0.05
MAX_GAP_INTERVALS = 2.5

# Turns over this time are compared to solve for the mount: long enough to exceed the noise by far,
# too short for drift.
SPAN_S = 1.0
# The motion spans two axes if the turns about the second strongest one are at least this (RMS)
# and this fraction of those about the strongest: errors of the turns go into the mount divided by
# the former, and come back multiplied by the strongest.
MIN_SECOND_AXIS_RAD = np.deg2rad(0.5)
MIN_SECOND_AXIS_RATIO = 0.05
ROBUST_ITERATIONS = 10

SPEED_STEP_NS = NS_PER_S // 100
MIN_SPEED_CORRELATION = 0.5
CLOCK_REACH_S = 0.2
CLOCK_TOLERANCE_S = 1e-5
# The truth's noise draws the clock to between its samples, where slerp averages two of them.
CLOCK_SMOOTHING_S = 0.01


class EvaluationError(ValueError):
    """Truth and estimate that cannot be compared, said in one line."""


@dataclass(frozen=True)
class Alignment:
    """
    How truth and camera relate.

    ``mount_solved`` tells whether ``R_body_camera`` comes from the data; ``clock_offset_ns`` is
    the truth's stamp minus the camera's of the same moment. Over SPAN_S the truth turns by
    ``turn_rad`` on average, the estimate differs from that by ``residual_rad``. Of a gyro's truth
    ``gyro_bias_rad_s`` (3,) on the body has been taken out.
    """

    R_body_camera: Rotation
    clock_offset_ns: int = 0
    mount_solved: bool = False
    turn_rad: float = 0.0
    residual_rad: float = 0.0
    gyro_bias_rad_s: Vector | None = None


def align_trajectories(
        truth: Trajectory, estimate: Trajectory, R_body_camera: Rotation | None = None,
        clock_offset_ns: int | None = None) -> Alignment:
    """
    Return the Alignment of two Trajectories, solving for what is None.

    The mount cannot be solved for where the motion does not span two axes; it is then that of a
    camera that looks forward on a REP 103 body, and ``mount_solved`` is False.
    """
    if len(estimate) < MIN_FRAMES:
        raise EvaluationError(f'{len(estimate)} frames are too few, {MIN_FRAMES} are needed')
    if clock_offset_ns is None:
        clock_offset_ns = _refined_clock_offset(
            truth, estimate, _coarse_clock_offset(truth, estimate))
    stamps_ns = estimate.stamps_ns + clock_offset_ns
    check_overlap(truth, stamps_ns)
    body_turns, camera_turns, _ = turns(truth, estimate, clock_offset_ns, SPAN_S)
    mount_solved = R_body_camera is None and spans_two_axes(body_turns)
    if R_body_camera is None:
        R_body_camera = fit_mount(body_turns, camera_turns) if mount_solved else R_BODY_CAMERA
    return Alignment(R_body_camera, clock_offset_ns, mount_solved,
                     float(np.linalg.norm(body_turns, axis=1).mean()),
                     _misfit(body_turns, camera_turns, R_body_camera))


def fit_mount(body_turns: Vectors, camera_turns: Vectors) -> Rotation:
    """
    Return R_body_camera from the same turns (N, 3), as rotation vectors, of body and camera.

    Hand-eye calibration of rotations: ``A X = X B`` for the turns A, B means ``log A = X log B``
    (Park and Martin, 1994), which is Wahba's problem, solved by SVD (Markley, 1988). Reweighted to
    the L1 fit, so that moments at which the estimator lost its way do not count.
    """
    weights = np.ones(len(body_turns))
    for _ in range(ROBUST_ITERATIONS):
        U, _, Vt = np.linalg.svd((weights[:, None] * body_turns).T @ camera_turns)
        R = U @ np.diag((1, 1, np.linalg.det(U) * np.linalg.det(Vt))) @ Vt
        misses = np.linalg.norm(body_turns - camera_turns @ R.T, axis=1)
        weights = 1 / np.maximum(misses, 1e-6)
    return Rotation.from_matrix(R)


def spans_two_axes(turns: Vectors) -> bool:
    """Tell whether turns (N, 3), as rotation vectors, determine a mount rotation."""
    rms = np.linalg.svd(turns, compute_uv=False) / np.sqrt(len(turns))
    return bool(rms[1] >= max(MIN_SECOND_AXIS_RAD, MIN_SECOND_AXIS_RATIO * rms[0]))


def has_truth(truth: Trajectory, stamps_ns: Stamps) -> Choice:
    """Tell at which stamps (M,) the truth may be interpolated: not outside, not in its gaps."""
    if len(truth) < 2:
        return np.zeros(len(stamps_ns), bool)
    intervals_ns = np.diff(truth.stamps_ns)
    longest_ns = max(MAX_GAP_S * NS_PER_S, MAX_GAP_INTERVALS * np.median(intervals_ns))
    # Interval i reaches from sample i to i + 1; stamps equal to a sample lie in either.
    after = np.searchsorted(truth.stamps_ns, stamps_ns)
    interval = np.clip(after - 1, 0, len(intervals_ns) - 1)
    on_sample = truth.stamps_ns[np.minimum(after, len(truth) - 1)] == stamps_ns
    return truth.covers(stamps_ns) & (on_sample | (intervals_ns[interval] <= longest_ns))


def check_overlap(truth: Trajectory, stamps_ns: Stamps) -> None:
    """Raise EvaluationError where the truth says too little at stamps (M,)."""
    known = np.count_nonzero(has_truth(truth, stamps_ns))
    if known >= MIN_FRAMES:
        return
    if not truth.covers(stamps_ns).any():
        away_s = (truth.stamps_ns[0] - stamps_ns[0]) / NS_PER_S
        raise EvaluationError(
            f'truth and images do not overlap in time, the truth starts {away_s:+.1f} s after the '
            'images; are they on different clocks?')
    raise EvaluationError(f'only {known} of {len(stamps_ns)} frames have truth, at least '
                          f'{MIN_FRAMES} are needed')


def turns(truth: Trajectory, estimate: Trajectory, clock_offset_ns: int,
          span_s: float) -> tuple[Vectors, Vectors, float]:
    """
    Return the turns of body and camera, each (N, 3) as rotation vectors, and over which time.

    That is ``span_s`` or, if that is shorter, from one frame to the next.
    """
    stamps_ns = estimate.stamps_ns + clock_offset_ns
    known = has_truth(truth, stamps_ns)
    period_s = float(np.median(np.diff(estimate.stamps_ns))) / NS_PER_S
    span = max(min(round(span_s / period_s), int(np.count_nonzero(known)) // 2), 1)
    body, camera = ((R[:-span].inv() * R[span:]).as_rotvec()
                    for R in (truth.at(stamps_ns[known]), estimate.rotations[known]))
    return body, camera, span * period_s


def _misfit(body_turns: Vectors, camera_turns: Vectors, R_body_camera: Rotation) -> float:
    return float(np.linalg.norm(
        body_turns - R_body_camera.apply(camera_turns), axis=1).mean())


def _coarse_clock_offset(truth: Trajectory, estimate: Trajectory) -> int:
    """
    Return the clock offset in ns at which the angular speeds correlate best, to SPEED_STEP_NS.

    Angular speed depends neither on the worlds nor on the mount.
    """
    window_ns = max(int(np.median(np.diff(estimate.stamps_ns))), SPEED_STEP_NS)
    true, estimated = (_angular_speed(one, window_ns) for one in (truth, estimate))
    if min(len(true), len(estimated)) < 2:
        raise EvaluationError('truth or images are too short to tell the clock offset')
    lags = correlation_lags(len(true), len(estimated))
    lag = lags[np.argmax(correlate(_standardised(true), _standardised(estimated)))]
    true, estimated = true[max(lag, 0):], estimated[max(-lag, 0):]
    overlap = min(len(true), len(estimated))
    correlation = np.mean(_standardised(true[:overlap]) * _standardised(estimated[:overlap]))
    if correlation < MIN_SPEED_CORRELATION:
        raise EvaluationError(
            'the clock offset cannot be told: the angular speeds of truth and estimate correlate '
            f'by no more than {correlation:.2f}')
    return int(truth.stamps_ns[0] - estimate.stamps_ns[0] + lag * SPEED_STEP_NS)


def _refined_clock_offset(truth: Trajectory, estimate: Trajectory, coarse_ns: int) -> int:
    """
    Return the clock offset in ns, near a coarse one, that leaves the least misfit of turns.

    From turns from frame to frame: over 1 s they tell it to several milliseconds only. A vibration
    makes valleys beside the right one and may have led the coarse offset into them: all within
    reach are looked at. On halves of ``bags/drone`` and ``bags/handheld``, at 15 frames per
    second and with 0.05° of noise in the truth, it is found to 0.6 ms, on ``bags/pioneer``, where
    little but the vibration turns two axes, to 1.5 ms.
    """
    truth = _smoothed(truth)

    def misfit(correction_s: float) -> float:
        offset_ns = coarse_ns + round(correction_s * NS_PER_S)
        if np.count_nonzero(has_truth(truth, estimate.stamps_ns + offset_ns)) < MIN_FRAMES:
            return np.pi
        body, camera, _ = turns(truth, estimate, offset_ns, 0)
        # The best mount whether or not it is unique: a wrong one must not shift the clock.
        return _misfit(body, camera, fit_mount(body, camera))

    reach_s = CLOCK_REACH_S + np.median(np.diff(estimate.stamps_ns)) / NS_PER_S
    step_s = SPEED_STEP_NS / NS_PER_S
    start_s = min(np.arange(-reach_s, reach_s, step_s), key=misfit)
    found = minimize_scalar(misfit, bounds=(start_s - step_s, start_s + step_s),
                            method='bounded', options={'xatol': CLOCK_TOLERANCE_S})
    return coarse_ns + round(found.x * NS_PER_S)


def _smoothed(trajectory: Trajectory) -> Trajectory:
    """Return the Trajectory with noise averaged out over CLOCK_SMOOTHING_S, not shifted."""
    q = trajectory.rotations.as_quat()
    signs = np.where(np.einsum('ni,ni->n', q[1:], q[:-1]) < 0, -1, 1)
    q *= np.cumprod(np.append(1, signs))[:, None]
    sigma = CLOCK_SMOOTHING_S * NS_PER_S / np.median(np.diff(trajectory.stamps_ns))
    return Trajectory(trajectory.stamps_ns, Rotation.from_quat(
        gaussian_filter1d(q, sigma, axis=0)))


def _angular_speed(trajectory: Trajectory, window_ns: int) -> Values:
    """Return the angle turned within ``window_ns``, every SPEED_STEP_NS from the start on."""
    starts_ns = np.arange(trajectory.stamps_ns[0], trajectory.stamps_ns[-1] - window_ns,
                          SPEED_STEP_NS)
    return (trajectory.at(starts_ns).inv() * trajectory.at(starts_ns + window_ns)).magnitude()


def _standardised(values: Values) -> Values:
    return (values - values.mean()) / max(values.std(), 1e-12)
