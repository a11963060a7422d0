# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Two passes over a recording: how they are fused, and what they find in a painted room."""

from errno import ENOSPC
from itertools import accumulate
from operator import mul

import numpy as np
from painted_room import errors_deg, flight, PERIOD_NS, room, tracked, WIDTH
import pytest
from scipy.spatial.transform import Rotation

from sph_stab_ros.config import TrackerConfig
from sph_stab_ros.tracking.base import no_gyro, TrackedOrientation, TrackingStatus
from sph_stab_ros.tracking.offline import grey_spool, TwoPasses
from sph_stab_ros.tracking.offline.fusion import fuse
from sph_stab_ros.tracking.offline.grey_spool import GreySpool

SURE = np.deg2rad(0.05) ** 2 * np.eye(3)
BLACK = np.zeros((WIDTH // 2, WIDTH), np.uint8)
OTHER_WORLD = Rotation.from_rotvec((0.4, -1., 2.))


def told(rotations, covariance=SURE, status=TrackingStatus.OK):
    """Return orientations as a pass tells them."""
    return [TrackedOrientation(R, status, covariance) for R in rotations]


def wandering(count=60):
    """Return orientations that begin somewhere."""
    times = np.linspace(0, 5, count)[:, None]
    return Rotation.from_rotvec(np.sin(times * (1.1, 0.7, 1.6) + (1, 2, 3)))


def test_passes_that_agree_are_what_they_say_from_the_first_frame_on():
    """In whatever world the backward pass is."""
    R = wandering()
    fused = fuse(told(R), told(OTHER_WORLD * R))
    assert errors_deg(fused, R).max() < 1e-6
    assert {one.status for one in fused} == {TrackingStatus.OK}


def test_opposite_errors_cancel():
    """As those of first looks do, which either pass has the other way round."""
    R = wandering()
    error = Rotation.from_rotvec(0.01 * np.sin(np.linspace(0, 9, len(R)))[:, None] * (1, 2, -1))
    fused = fuse(told(error * R), told(OTHER_WORLD * error.inv() * R))
    assert errors_deg(fused, R).max() < 0.01 < errors_deg(told(error * R), R).max()


def test_time_may_run_backwards():
    """The other pass first, the last frame first: the same turns."""
    R = wandering()
    error = Rotation.from_rotvec(np.random.default_rng(0).normal(scale=0.003, size=(len(R), 3)))
    forward, backward = told(error * R), told(OTHER_WORLD * R)
    there = Rotation.concatenate([one.R_world_camera for one in fuse(forward, backward, 20)])
    back = Rotation.concatenate(
        [one.R_world_camera for one in fuse(backward[::-1], forward[::-1], 20)])[::-1]
    assert ((there[0].inv() * there).inv() * (back[0].inv() * back)).magnitude().max() < 1e-5


def test_who_had_no_hindsight_yet_has_less_say():
    """At the start the forward pass counts twice, at the end the backward one."""
    R = Rotation.concatenate([Rotation.identity()] * 60)
    error = Rotation.from_rotvec(np.outer(0.003 * np.cos(np.arange(60)), (0, 1, 0)))
    found = [one.R_world_camera for one in fuse(told(error * R), told(R), 10)]
    shares = [(found[i] * found[30].inv()).as_rotvec()[1] for i in range(60)]
    known = (error * error[30].inv()).as_rotvec()[:, 1]
    assert shares[28] == pytest.approx(known[28] / 2, rel=1e-2)
    absolute = np.array(shares) + error[30].as_rotvec()[1] / 2
    assert absolute[0] == pytest.approx(error[0].as_rotvec()[1] * 2 / 3, rel=0.1)
    assert absolute[-1] == pytest.approx(error[-1].as_rotvec()[1] / 3, rel=0.1)


def test_who_is_lost_has_no_say():
    """A pass that had to begin anew and does not know how it is turned since."""
    R = wandering()
    off = Rotation.concatenate([Rotation.identity()] * 30
                               + [Rotation.from_rotvec((0, 1, 0))] * 30)
    fused = fuse(told(R[:30]) + told((off * R)[30:], np.eye(3)), told(OTHER_WORLD * R))
    assert errors_deg(fused, R).max() < 0.2
    assert {one.status for one in fused} == {TrackingStatus.OK}


def test_what_two_passes_disagree_about_is_uncertain():
    """By half of it at least, however sure either of them is."""
    R = wandering()
    off = Rotation.concatenate([Rotation.identity()] * 40
                               + [Rotation.from_rotvec((0, np.deg2rad(3), 0))] * 20)
    fused = fuse(told(R), told(OTHER_WORLD * off * R))
    assert {one.status for one in fused[:40]} == {TrackingStatus.OK}
    assert {one.status for one in fused[40:]} == {TrackingStatus.UNCERTAIN}
    assert all(one.covariance.trace() > np.deg2rad(1.4) ** 2 for one in fused[40:])


def test_what_neither_has_seen_is_bridged_from_both_sides():
    """Each pass goes on as it was; the nearer one to what it has seen counts more."""
    R = wandering()
    held = Rotation.concatenate([R[19]] * 10), Rotation.concatenate([R[30]] * 10)
    blind = [told(one, None, TrackingStatus.PREDICTED) for one in held]
    fused = fuse(told(R[:20]) + blind[0] + told(R[30:]), told(R[:20]) + blind[1] + told(R[30:]))
    gap = Rotation.concatenate([one.R_world_camera for one in fused[19:31]])
    steps = (gap[:-1].inv() * gap[1:]).magnitude()
    np.testing.assert_allclose(steps, (R[19].inv() * R[30]).magnitude() / 11, rtol=1e-3)
    assert {one.status for one in fused[20:30]} == {TrackingStatus.PREDICTED}
    assert errors_deg(fused[:20] + fused[30:], R[np.r_[:20, 30:60]]).max() < 1e-6


@pytest.mark.parametrize('seen', (slice(10, 60), slice(0, 50), slice(0, 0)))
def test_what_comes_before_and_after_all_that_is_seen_is_held(seen):
    """The world is the first camera that has seen something."""
    R = wandering()
    statuses = np.full(60, TrackingStatus.LOST, object)
    statuses[seen] = TrackingStatus.OK
    passes = [[TrackedOrientation(one, status, SURE if status is TrackingStatus.OK else None)
               for one, status in zip(R, statuses)] for _ in range(2)]
    fused = fuse(*passes)
    assert [one.status for one in fused] == list(statuses)
    if seen != slice(0, 0):
        assert errors_deg(fused[seen], R[seen]).max() < 1e-6


def offline(images, gyro_rotation=no_gyro):
    """Return what the forward pass says live, and the orientations of both passes."""
    passes = TwoPasses()
    live = tracked(images, passes.first_tracker(TrackerConfig(), WIDTH, gyro_rotation))
    passes.finish()
    return live, tracked(images, passes.known_tracker())


def per_frame_deg(results, R):
    """Return the errors of the turns from one frame to the next."""
    found = Rotation.concatenate([one.R_world_camera for one in results])
    return np.rad2deg(((R[:-1].inv() * R[1:]).inv() * found[:-1].inv() * found[1:]).magnitude())


def test_steps_are_truer_than_live_and_known_however_often_they_are_asked_for():
    """From one frame to the next by half, on a flight whose pictures show walls near by."""
    R, p = flight(40)
    passes = TwoPasses()
    images = list(map(room, R, p))
    live = tracked(images, passes.first_tracker(TrackerConfig(), WIDTH, no_gyro))
    passes.finish()
    first, second = (tracked(images, passes.known_tracker()) for _ in range(2))
    assert per_frame_deg(first, R).mean() < 0.75 * per_frame_deg(live, R).mean()
    assert errors_deg(first, R).mean() < 1.1 * errors_deg(live, R).mean()
    assert {one.status for one in first} == {TrackingStatus.OK}
    for a, b in zip(first, second):
        np.testing.assert_array_equal(a.R_world_camera.as_quat(), b.R_world_camera.as_quat())


def test_a_dark_stretch_is_bridged_from_both_sides():
    """Where the camera begins to turn in the dark the live tracker cannot know."""
    angles = np.deg2rad(np.r_[np.zeros(25), np.arange(25)])
    R = Rotation.from_rotvec(np.outer(angles, (0, 1, 0)))
    _, p = flight(50)
    dark = slice(20, 30)
    images = [BLACK if 20 <= i < 30 else room(R[i], p[i]) for i in range(50)]
    live, known = offline(images)
    assert errors_deg(known[:20] + known[30:], R[np.r_[:20, 30:50]]).max() < 0.1
    assert {one.status for one in known[dark]} == {TrackingStatus.PREDICTED}
    assert errors_deg(known, R)[dark].max() < 0.6 * errors_deg(live, R)[dark].max()


def test_the_backward_pass_has_a_gyro_too():
    """Both bridge a dark stretch by what it saw, one of them from behind."""
    turns = Rotation.from_rotvec(np.random.default_rng(3).normal(scale=0.02, size=(45, 3)))
    rotations = list(accumulate(turns, mul))

    def gyro_rotation(from_ns, to_ns):
        i, j = from_ns // PERIOD_NS, to_ns // PERIOD_NS
        # What it saw long ago is forgotten.
        assert 0 <= i < j <= i + 12
        return rotations[i].inv() * rotations[j]
    images = [BLACK if 15 <= i < 25 else room(R) for i, R in enumerate(rotations)]
    _, known = offline(images, gyro_rotation)
    assert errors_deg(known, Rotation.concatenate(rotations)).max() < 0.2


def test_a_spool_gives_back_what_was_put_in_the_last_one_first():
    """But for what JPEG takes away."""
    images = [room(R) for R in flight(3)[0]]
    spool = GreySpool()
    for image in images:
        spool.add(image)
    assert len(spool) == 3
    back = list(spool.backwards())[::-1]
    for a, b in zip(images, back, strict=True):
        assert np.abs(a.astype(int) - b).mean() < 2


def test_a_spool_that_does_not_fit_says_so(monkeypatch):
    """In one line, with the folder that has no room."""
    class Full:

        def write(self, data):
            raise OSError(ENOSPC, 'No space left on device')
    monkeypatch.setattr(grey_spool, 'TemporaryFile', Full)
    with pytest.raises(grey_spool.SpoolError, match='takes no more .* No space left on device'):
        GreySpool().add(BLACK)
