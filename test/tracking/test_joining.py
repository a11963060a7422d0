# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Segments that were tracked each for itself, joined on SO(3)."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sph_stab_ros.tracking.base import TrackedOrientation, TrackingStatus
from sph_stab_ros.tracking.offline.joining import join, join_segments, JoiningError, Segment

SURE = np.deg2rad(0.05) ** 2 * np.eye(3)
WORLDS = Rotation.from_rotvec([(0, 0, 0), (0.4, -1., 2.), (1.5, 1, -1)])
PERIOD_NS = 33_333_333
COUNT, OVERLAP = 100, 40


def wandering(count):
    """Return orientations of a camera that turns."""
    times = np.linspace(0, 8, count)[:, None]
    return Rotation.from_rotvec(np.sin(times * (1.1, 0.7, 1.6)))


def segment(first, R, covariance=SURE, status=TrackingStatus.OK):
    """Return orientations from a frame on."""
    return Segment(PERIOD_NS * np.arange(first, first + len(R)),
                   [TrackedOrientation(one, status, covariance) for one in R])


def segments_of(R, errors=None):
    """Return three segments that overlap, each in a world of its own and with its own error."""
    starts = (0, COUNT - OVERLAP, 2 * (COUNT - OVERLAP))
    errors = errors or 3 * [Rotation.identity(COUNT)]
    return [segment(start, world * (error * R[start:start + COUNT]))
            for start, world, error in zip(starts, WORLDS, errors)]


def rotations(joined):
    """Return all orientations."""
    return Rotation.concatenate([one.R_world_camera for one in joined.orientations])


def added_steps_deg(joined, R):
    """Return what is added to the turns from one frame to the next."""
    found = rotations(joined)
    return np.rad2deg(((R[:-1].inv() * R[1:]).inv() * found[:-1].inv() * found[1:]).magnitude())


def test_segments_without_errors_are_the_whole():
    """In the world of the first one, whatever those of the others are."""
    R = wandering(3 * COUNT - 2 * OVERLAP)
    joined = join_segments(segments_of(R))
    np.testing.assert_array_equal(joined.stamps_ns, PERIOD_NS * np.arange(len(R)))
    assert np.rad2deg((R.inv() * rotations(joined)).magnitude()).max() < 1e-5
    assert {one.status for one in joined.orientations} == {TrackingStatus.OK}


def test_at_a_joint_there_is_no_step():
    """However wrong a tracker is at the start, and whatever it drifts away by."""
    R = wandering(3 * COUNT - 2 * OVERLAP)
    start = np.deg2rad(0.3) * np.exp(-np.arange(COUNT) / 5)
    drift = np.deg2rad(0.1) * np.arange(COUNT) / COUNT
    errors = [Rotation.from_rotvec(np.outer(start, a) + np.outer(drift, b)) for a, b in (
        ((0, 0, 0), (0, 1, 0)), ((1, 0, 0), (0, 0, 1)), ((0, 1, 0), (1, 0, 0)))]
    joined = join_segments(segments_of(R, errors))
    behind_start = np.r_[COUNT - OVERLAP:len(R) - 1]
    assert added_steps_deg(joined, R)[behind_start].max() <= 0.02
    assert np.rad2deg((R.inv() * rotations(joined)).magnitude()).max() < 0.3


def test_what_two_segments_differ_by_is_not_known_behind():
    """Nor is what the first one did not know."""
    R = wandering(COUNT)
    disagreeing = Rotation.from_rotvec(np.deg2rad(2) * np.sin(np.arange(60))[:, None] * (0, 1, 0))
    joined = join(segment(0, R[:60]), segment(20, R[20:], status=TrackingStatus.OK))
    assert joined.orientations[-1].covariance == pytest.approx(2 * SURE, rel=1e-3, abs=1e-12)
    assert joined.orientations[-1].status is TrackingStatus.OK
    joined = join(segment(0, disagreeing * R[:60]), segment(20, R[20:]))
    assert joined.orientations[-1].status is TrackingStatus.UNCERTAIN
    assert joined.orientations[10].status is TrackingStatus.OK


def test_where_nothing_was_seen_in_common_all_that_follows_is_uncertain():
    """And what was lost stays lost."""
    R = wandering(COUNT)
    first, second = segment(0, R[:60]), segment(20, R[20:])
    lost = Segment(first.stamps_ns, first.orientations[:20] + [
        TrackedOrientation(R[19], TrackingStatus.LOST) for _ in range(40)])
    statuses = [one.status for one in join(lost, second).orientations]
    assert statuses[:20] == 20 * [TrackingStatus.OK]
    assert set(statuses[60:]) == {TrackingStatus.UNCERTAIN}
    assert TrackingStatus.OK not in statuses[20:]


@pytest.mark.parametrize('stamps_ns, reason', [
    (np.arange(60, 120), 'do not overlap'), (2 * np.arange(20, 80), 'do not overlap'),
    (np.r_[20:50, 49:79], 'do not increase')])
def test_what_does_not_fit_together_is_refused(stamps_ns, reason):
    """It is not guessed."""
    R = wandering(60)
    with pytest.raises(JoiningError, match=reason):
        join_segments([Segment(PERIOD_NS * np.asarray(one), segment(0, R).orientations)
                       for one in (np.arange(60), stamps_ns)])
