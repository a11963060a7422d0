# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""
The virtual camera of a recording whose end is known: smooth, and never late.

The same targets as the live smoother's are averaged over what was before and what comes after,
by the kernel of its filter run forwards and then backwards::

    k(t) = (1 + |t| / a) exp(−|t| / a) / 4a,    a = τ / 2,    H(ω) = 1 / (1 + (ω τ / 2)²)²

It is even, so that nothing comes late and a steady turn passes unchanged; it is positive, so that
the picture never overshoots; and its variance is τ², so that the picture is off its target by no
more than half of the largest angular acceleration times τ². The mean is that of the manifold: the
orientation from which the weighted rotation vectors to all targets add up to zero (H. Karcher,
*Riemannian center of mass and mollifier smoothing*, Communications on Pure and Applied Mathematics
30, 1977), which does not depend on how the world is turned, nor on the direction of time.
"""

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from sph_stab_ros.config import FOLLOW, LOCK, SmoothingConfig
from sph_stab_ros.geometry.arrays import Values, Vectors
from sph_stab_ros.geometry.conventions import NS_PER_S
from sph_stab_ros.stabilization.level import heading

# Of time constants, beyond which the kernel weighs less than a thousandth.
REACH = 5.
# The mean is found when a step is shorter.
TOLERANCE_RAD = 1e-8
MAX_ITERATIONS = 50


def smooth(config: SmoothingConfig, times_ns: Sequence[int], R_world_camera: Rotation) -> Rotation:
    """
    Return R_world_virtual of N frames from their times and orientations.

    Where the camera looks straight up or down it has no heading, and ``yaw_follow`` goes from the
    one before to the one after. Frames that are not later than those before look like these.
    """
    if config.mode == LOCK:
        return Rotation.identity(len(times_ns))
    if config.mode == FOLLOW:
        known, targets = np.arange(len(times_ns)), R_world_camera
    else:
        headings = {i: R_world_heading for i, one in enumerate(R_world_camera)
                    if (R_world_heading := heading(one)) is not None}
        if not headings:
            return Rotation.identity(len(times_ns))
        known, targets = np.array([*headings]), Rotation.concatenate([*headings.values()])
    latest_ns = np.maximum.accumulate(np.asarray(times_ns, np.int64))
    times_s = (latest_ns - latest_ns[0]) / NS_PER_S
    later = np.append(True, np.diff(times_s[known]) > 0)
    known, targets = known[later], targets[later]
    return averaged(times_s[known], targets, times_s, config.time_constant_s)


def averaged(times_s: Values, targets: Rotation, at_s: Values, time_constant_s: float) -> Rotation:
    """Return the means about times (M,) of N targets at rising times (N,)."""
    times_s, targets = prolonged(times_s, targets, REACH * time_constant_s)
    q = targets.as_quat()
    means = []
    for time_s in at_s:
        first, last = np.searchsorted(
            times_s, (time_s - REACH * time_constant_s, time_s + REACH * time_constant_s))
        first, last = max(first - 1, 0), last + 1
        nearest = min(int(np.searchsorted(times_s[first:last], time_s)),
                      len(times_s[first:last]) - 1)
        means.append(mean(Rotation.from_quat(q[first:last]),
                          kernel_weights(times_s[first:last] - time_s, time_constant_s / 2),
                          nearest))
    return Rotation.concatenate(means)


def prolonged(times_s: Values, targets: Rotation, reach_s: float) -> tuple[Values, Rotation]:
    """
    Return targets that go on beyond both ends as they came: mirrored at the ends, as at points.

    So a turn at the end is a turn to the end; and the mean still never overshoots.
    """
    end_s = times_s[-1]
    while len(times_s) > 1 and times_s[-1] < end_s + reach_s:
        count = 1 + max(np.searchsorted(times_s - times_s[0], reach_s),
                        np.searchsorted(times_s[-1] - times_s[::-1], reach_s))
        (before_s, before), (after_s, after) = (
            (2 * times_s[end] - times_s[near], targets[end] * targets[near].inv() * targets[end])
            for end, near in ((0, slice(count, 0, -1)), (-1, slice(-2, -2 - count, -1))))
        times_s = np.concatenate((before_s, times_s, after_s))
        targets = Rotation.concatenate((before, targets, after))
    return times_s, targets


def kernel_weights(times_s: Values, a: float) -> Values:
    """
    Return the weights (N,) of samples at rising times, of sum 1, in an average about time zero.

    Of ``∫ k(t) u(t) dt`` with u a straight line between samples and constant beyond: second
    differences of that integral G of k which grows like ``|t| / 2``.
    """
    distance = np.abs(times_s)
    G = distance / 2 + (3 * a + distance) * np.exp(-distance / a) / 4
    slopes = np.diff(G) / np.diff(times_s)
    return np.diff(np.concatenate(([-0.5], slopes, [0.5])))


def mean(targets: Rotation, weights: Values, nearest: int) -> Rotation:
    """Return the weighted mean of targets along a path, near one of them."""
    R = targets[nearest]
    for _ in range(MAX_ITERATIONS):
        step = weights @ rotation_vectors(R.inv() * targets, nearest)
        R = R * Rotation.from_rotvec(step)
        if np.linalg.norm(step) < TOLERANCE_RAD:
            break
    return R


def rotation_vectors(path: Rotation, origin: int) -> Vectors:
    """Return rotation vectors (N, 3) along a path, the shortest at its origin, by whole turns."""
    q = path.as_quat()
    q[1:] *= np.cumprod(_signs(q))[:, None]
    # The axis goes on where the angle goes through zero.
    signs = np.append(1, np.cumprod(_signs(q[:, :3])))
    lengths = np.linalg.norm(q[:, :3], axis=1)
    half_angles = np.unwrap(np.arctan2(signs * lengths, q[:, 3]))
    half_angles -= np.pi * np.rint(half_angles[origin] / np.pi)
    return (2 * half_angles * signs / np.maximum(lengths, 1e-12))[:, None] * q[:, :3]


def _signs(rows: Vectors) -> Values:
    """Return the signs (N − 1,) of the products of neighbouring rows, never zero."""
    return np.where(np.einsum('ni,ni->n', rows[1:], rows[:-1]) < 0, -1, 1)
