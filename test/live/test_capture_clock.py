# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Laws of the stamps of a live stream."""

import numpy as np
from sph_stab_ros.live.capture_clock import ARRIVAL, CaptureClock, DEVICE, SENDER

MS = 1_000_000
START_NS = 1_700_000_000_000_000_000
PERIOD_NS = 33_333_333


def stamps(clock, pts_ns, arrivals_ns, told_ns=None):
    """Return (N,) the stamps of pictures, where the sender tells its clock, if it does."""
    found = []
    for pts, arrival in zip(pts_ns, arrivals_ns):
        clock.arrive(int(pts), int(arrival))
        if told_ns is not None:
            clock.hear_sender(int((pts + told_ns) // 1000).to_bytes(16, 'little'), int(pts))
        found.append(clock.stamp_ns(int(pts), int(arrival)))
    return np.array(found)


def jittered(count, seed=0):
    """Return (N,) times by the stream, and arrivals of which many are late by up to 80 ms."""
    late_ns = np.random.default_rng(seed).integers(0, 80 * MS, count)
    late_ns[::7] = 0
    pts_ns = PERIOD_NS * np.arange(count)
    return pts_ns, START_NS + np.maximum.accumulate(pts_ns + late_ns)


def test_delays_on_the_way_are_no_motion():
    pts_ns, arrivals_ns = jittered(300)
    found = stamps(CaptureClock(), pts_ns, arrivals_ns)
    settled = found[30:]
    assert np.abs(np.diff(settled) - PERIOD_NS).max() < MS
    assert np.abs(settled - START_NS - pts_ns[30:]).max() < MS


def test_stamps_go_forward_and_are_never_of_the_future():
    rng = np.random.default_rng(1)
    for seed in range(20):
        pts_ns, arrivals_ns = jittered(200, seed)
        # Streams begin anew, senders pause, clocks are wrong.
        pts_ns[100:] += rng.integers(-10**12, 10**12)
        arrivals_ns[150:] += rng.integers(0, 10**10)
        told_ns = START_NS + rng.integers(-10**10, 10**10) if seed % 2 else None
        found = stamps(CaptureClock(), pts_ns, arrivals_ns, told_ns)
        assert (np.diff(found) > 0).all()
        assert (found <= arrivals_ns + 200).all()


def test_the_senders_clock_wins_where_it_is_set():
    pts_ns, arrivals_ns = jittered(100)
    clock = CaptureClock()
    # A camera that takes 150 ms.
    found = stamps(clock, pts_ns, arrivals_ns, START_NS - 150 * MS)
    assert clock.name == SENDER
    assert np.abs(found - (START_NS - 150 * MS + pts_ns)).max() <= 1000


def test_the_senders_clock_is_come_to_at_half_the_pace():
    pts_ns, arrivals_ns = jittered(200)
    clock = CaptureClock()
    before = stamps(clock, pts_ns[:100], arrivals_ns[:100])
    after = stamps(clock, pts_ns[100:], arrivals_ns[100:], START_NS - 150 * MS)
    steps_ns = np.diff(np.concatenate((before[-1:], after)))
    assert (steps_ns >= PERIOD_NS // 2).all()
    assert abs(after[-1] - (START_NS - 150 * MS + pts_ns[-1])) <= 1000


def test_a_senders_clock_that_is_not_set_is_not_believed():
    pts_ns, arrivals_ns = jittered(100)
    for off_ns in (-10**18, -10**10, 10**9, 10**18):
        clock = CaptureClock()
        found = stamps(clock, pts_ns, arrivals_ns, START_NS + off_ns)
        assert clock.name == ARRIVAL
        assert np.array_equal(found, stamps(CaptureClock(), pts_ns, arrivals_ns))


def test_a_device_tells_by_either_clock_of_the_system():
    boot_ns = 10**15
    for pts_ns in (boot_ns, START_NS):
        clock, arrival_ns = CaptureClock(), START_NS + 20 * MS
        clock.arrive(pts_ns, arrival_ns)
        clock.hear_device(pts_ns, arrival_ns, boot_ns + 20 * MS)
        assert clock.stamp_ns(pts_ns, arrival_ns) == START_NS
        assert clock.name == DEVICE


def test_a_rate_that_is_not_kept_leaves_the_stamps_with_the_arrivals():
    """A stream counts 30 pictures a second, and 27 come."""
    count = 900
    pts_ns, arrivals_ns = PERIOD_NS * np.arange(count), START_NS + 37 * MS * np.arange(count)
    late_ns = arrivals_ns - stamps(CaptureClock(), pts_ns, arrivals_ns)
    assert late_ns.max() < 500 * MS


def test_without_times_pictures_have_those_of_their_arrival():
    clock = CaptureClock()
    assert [clock.stamp_ns(None, START_NS + n * MS) for n in range(3)] == [
        START_NS + n * MS for n in range(3)]
