# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Packets are left out where they come faster than they are decoded, and only there."""

import pytest
from sph_stab_ros.live.connection import Backlog

PERIOD_S = 0.033
MS = 1_000_000


def left_out(seconds, decoding_s, overhead_s=0., is_late=False):
    """Return for each packet of a stream whether it is left out; reading costs something."""
    backlog, now_s, found, late_s, worked_s = Backlog(), 1000., [], 0., 0.
    start_s = now_s
    for index in range(round(seconds / PERIOD_S)):
        backlog.begin(now_s, worked_s)
        now_s = max(now_s, start_s + index * PERIOD_S) + overhead_s
        late_s = now_s - start_s - index * PERIOD_S
        found.append(backlog.is_too_long(now_s, round(
            1000 * MS * (10 if is_late else late_s))))
        worked_s = 0. if found[-1] else decoding_s
        now_s += worked_s
    assert late_s < 2.
    return found


@pytest.mark.parametrize('decoding_s, is_late', [
    (0.001, False), (0.001, True), (0.015, True), (0.022, False)])
def test_who_keeps_up_leaves_out_nothing(decoding_s, is_late):
    """Where there is half the time left whatever the times of the stream say."""
    assert not any(left_out(20, decoding_s, is_late=is_late))


@pytest.mark.parametrize('overhead_s', [0., 0.012])
@pytest.mark.parametrize('decoding_s', [0.04, 0.1])
def test_who_does_not_keep_up_leaves_out_what_it_must(decoding_s, overhead_s):
    """Also where reading itself waits for other threads; it never falls far behind."""
    found = left_out(60, decoding_s, overhead_s)
    assert 0.1 < sum(found) / len(found) < 0.99


def test_a_burst_after_a_stall_is_decoded():
    backlog, now_s = Backlog(), 1000.
    for late_ms in range(900, 0, -20):
        backlog.begin(now_s, 0.013)
        now_s += 0.001
        assert not backlog.is_too_long(now_s, late_ms * MS)
        now_s += 0.013
