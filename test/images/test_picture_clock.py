# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What the times of pictures mean: laws on random sequences of stamps."""

from itertools import accumulate

from hypothesis import assume, given, strategies as st
from sph_stab_ros.images.picture_clock import MAX_JITTER_NS, MAX_PAUSE_NS, PictureClock
from sph_stab_ros.images.picture_time import Stamp, TimeEvent
from sph_stab_ros.recording.picture_times import LOOKAHEAD, PlayingTime

NS_PER_S = 10**9
PERIOD_NS = NS_PER_S // 30
YEAR_NS = 31_556_952 * NS_PER_S
START_NS = 1_700_000_000 * NS_PER_S
LOOKAHEADS = st.sampled_from((0, LOOKAHEAD))
# All that headers can hold: of ROS 2, seconds in 32 bits with sign; of ROS 1, without.
ANY_STAMP = st.none() | st.integers(-2**31 * NS_PER_S, 2**32 * NS_PER_S)


def decide(stamps_ns, received_ns=None, lookahead=LOOKAHEAD, **options):
    """Return the PictureTimes of a sequence of stamps."""
    stamps = list(map(Stamp, stamps_ns, received_ns or len(stamps_ns) * [None]))
    clock = PictureClock(**options)
    return [clock.decide(stamp, stamps[i + 1:i + 1 + lookahead])
            for i, stamp in enumerate(stamps)]


def times_of(decided):
    """Return the times on the timeline."""
    return [one.time_ns for one in decided]


def intervals(times_ns):
    """Return the time from each to the next."""
    return [after - before for before, after in zip(times_ns, times_ns[1:])]


def events(decided):
    """Return what was noticed, and with which picture."""
    return [(i, one.event) for i, one in enumerate(decided) if one.event]


@st.composite
def regular(draw, min_size=12):
    """Return stamps of some rate from some time on, with little jitter, and the period."""
    count = draw(st.integers(min_size, 30))
    period_ns = draw(st.integers(NS_PER_S // 200, NS_PER_S // 2))
    start_ns = draw(st.integers(-YEAR_NS, 100 * YEAR_NS))
    jitter_ns = draw(st.lists(st.integers(0, period_ns // 5), min_size=count, max_size=count))
    return [start_ns + i * period_ns + late for i, late in enumerate(jitter_ns)], period_ns


def received_at(draw, stamps_ns):
    """Return times of receipt, of another clock, each late by up to half a second, or None."""
    if not draw(st.booleans()):
        return None
    offset_ns = draw(st.integers(-50 * YEAR_NS, 50 * YEAR_NS))
    late_ns = [offset_ns + ns + draw(st.integers(0, NS_PER_S // 2)) for ns in stamps_ns]
    return list(accumulate(late_ns, max))


@st.composite
def good(draw):
    """Return increasing stamps with pauses, and times of receipt or None."""
    steps = draw(st.lists(st.integers(1, 10 * NS_PER_S) | st.integers(1, MAX_PAUSE_NS)))
    stamps_ns = list(accumulate(steps, initial=draw(st.integers(-YEAR_NS, 100 * YEAR_NS))))
    return stamps_ns, received_at(draw, stamps_ns)


@given(st.lists(st.tuples(ANY_STAMP, ANY_STAMP)), LOOKAHEADS)
def test_the_timeline_always_goes_forward(stamps, lookahead):
    """Whatever the stamps and the times of receipt are; and no pause is longer than an hour."""
    decided = decide([stamp for stamp, _ in stamps], [receipt for _, receipt in stamps], lookahead)
    assert all(0 < step <= MAX_PAUSE_NS for step in intervals(times_of(decided)))
    for (stamp_ns, _), one in zip(stamps, decided):
        assert stamp_ns is None or one.stamp_ns == stamp_ns


@given(good(), LOOKAHEADS)
def test_good_stamps_stay(sequence, lookahead):
    """Identity, live and with a look ahead, with times of receipt and without."""
    stamps_ns, received_ns = sequence
    for one, ns in zip(decide(stamps_ns, received_ns, lookahead), stamps_ns):
        assert one == (ns, ns, ns, None, 0)


@given(st.lists(ANY_STAMP), LOOKAHEADS)
def test_what_is_decided_stays_decided(stamps_ns, lookahead):
    """A timeline is a good sequence; a writer may decide anew."""
    once = times_of(decide(stamps_ns, None, lookahead))
    assert times_of(decide(once, None, 0)) == once


@given(st.lists(st.tuples(st.none() | st.integers(-10**12, 10**12),
                          st.integers(-10**12, 10**12))),
       st.integers(-50 * YEAR_NS, 50 * YEAR_NS), LOOKAHEADS)
def test_the_epoch_makes_no_difference(stamps, shift_ns, lookahead):
    """Shifted stamps have shifted times, whatever they are, once there is one."""
    assume(stamps and stamps[0][0] is not None)
    received_ns = [receipt for _, receipt in stamps]
    plain = decide([stamp for stamp, _ in stamps], received_ns, lookahead)
    shifted = decide([stamp if stamp is None else stamp + shift_ns for stamp, _ in stamps],
                     received_ns, lookahead)
    assert [ns + shift_ns for ns in times_of(plain)] == times_of(shifted)
    assert events(plain) == events(shifted)


@given(regular(), st.data(), LOOKAHEADS)
def test_between_steps_the_pace_is_kept(sequence, data, lookahead):
    """Of seconds or decades, forward or back; one notice says by how much."""
    stamps_ns, period_ns = sequence
    at = data.draw(st.integers(4, len(stamps_ns) - 4))
    # Forward by less than an hour it could be a pause, which receipts alone can tell.
    step_ns = data.draw(st.integers(-50 * YEAR_NS, -MAX_JITTER_NS - 4 * period_ns)
                        | st.integers(MAX_PAUSE_NS + 1, 50 * YEAR_NS))
    stepped_ns = stamps_ns[:at] + [ns + step_ns for ns in stamps_ns[at:]]
    decided = decide(stepped_ns, None, lookahead)
    steps = intervals(times_of(decided))
    true_steps = intervals(stamps_ns)
    assert steps[:at - 1] + steps[at:] == true_steps[:at - 1] + true_steps[at:]
    assert abs(steps[at - 1] - period_ns) <= period_ns // 2
    (_, event), = events(decided)
    assert event is (TimeEvent.STEP_BACK if step_ns < 0 else TimeEvent.STEP_FORWARD)
    by_ns, = (one.by_ns for one in decided if one.event)
    assert abs(by_ns - step_ns) <= period_ns // 2


@given(regular(), st.data(), LOOKAHEADS)
def test_receipts_tell_a_step_from_a_pause(sequence, data, lookahead):
    """With them a step forward of seconds is found; a pause is one to both clocks."""
    stamps_ns, period_ns = sequence
    at = data.draw(st.integers(4, len(stamps_ns) - 4))
    step_ns = data.draw(st.integers(2 * NS_PER_S, MAX_PAUSE_NS // 2))
    stepped_ns = stamps_ns[:at] + [ns + step_ns for ns in stamps_ns[at:]]
    paused = decide(stepped_ns, [ns + 7 for ns in stepped_ns], lookahead)
    assert times_of(paused) == stepped_ns and not events(paused)
    stepped = decide(stepped_ns, [ns + 7 for ns in stamps_ns], lookahead)
    assert abs(times_of(stepped)[-1] - stamps_ns[-1]) <= period_ns // 2
    assert [event for _, event in events(stepped)] == [TimeEvent.STEP_FORWARD]


@given(regular(), st.data())
def test_a_single_outlier_changes_one_picture_only(sequence, data):
    """Which is shown between its neighbours; the first picture's as well."""
    stamps_ns, period_ns = sequence
    at = data.draw(st.integers(0, len(stamps_ns) - 4))
    # What is off by less may be jitter as well.
    off_ns = data.draw(st.integers(max(3 * period_ns, 2 * MAX_JITTER_NS), 50 * YEAR_NS))
    if at == 0:
        # Before the others it is that of a picture before a pause, unless that is long.
        off_ns += MAX_PAUSE_NS
    off_ns *= data.draw(st.sampled_from((-1, 1)))
    false_ns = stamps_ns[:at] + [stamps_ns[at] + off_ns] + stamps_ns[at + 1:]
    decided = decide(false_ns)
    assert times_of(decided)[:at] + times_of(decided)[at + 1:] == (
        stamps_ns[:at] + stamps_ns[at + 1:])
    assert times_of(decided)[at] < stamps_ns[at + 1]
    (where, event), = events(decided)
    assert where == at
    assert event is TimeEvent.OUTLIER or -MAX_JITTER_NS <= off_ns + period_ns
    assert decided[at].stamp_ns == false_ns[at] and decided[at].clock_ns == times_of(decided)[at]


@given(regular(), st.data())
def test_live_a_single_outlier_changes_one_picture_only(sequence, data):
    """Of more than the delay of receipt, which is all that tells then."""
    stamps_ns, period_ns = sequence
    at = data.draw(st.integers(4, len(stamps_ns) - 4))
    off_ns = data.draw(st.sampled_from((-1, 1))) * data.draw(
        st.integers(2 * NS_PER_S, 50 * YEAR_NS))
    false_ns = stamps_ns[:at] + [stamps_ns[at] + off_ns] + stamps_ns[at + 1:]
    live = decide(false_ns, stamps_ns, 0)
    assert times_of(live)[:at] + times_of(live)[at + 1:] == stamps_ns[:at] + stamps_ns[at + 1:]
    assert [event for _, event in events(live)] == [TimeEvent.OUTLIER]
    offline = decide(false_ns, stamps_ns)
    assert abs(times_of(live)[at] - times_of(offline)[at]) <= period_ns


@given(regular(), st.data())
def test_live_and_offline_agree_about_steps(sequence, data):
    """A step is seen later live, and makes the same timeline."""
    stamps_ns, period_ns = sequence
    at = data.draw(st.integers(4, len(stamps_ns) - 4))
    step_ns = data.draw(st.sampled_from((-1, 1))) * data.draw(
        st.integers(3 * NS_PER_S, 50 * YEAR_NS))
    stepped_ns = stamps_ns[:at] + [ns + step_ns for ns in stamps_ns[at:]]
    live, offline = (decide(stepped_ns, stamps_ns, lookahead) for lookahead in (0, LOOKAHEAD))
    assert times_of(live) == times_of(offline)
    assert live[-1] == offline[-1]


@given(regular(), st.data())
def test_a_missing_stamp_changes_one_picture_only(sequence, data):
    """The first, or any other."""
    stamps_ns, _ = sequence
    at = data.draw(st.integers(0, len(stamps_ns) - 2))
    some_ns = stamps_ns[:at] + [None] + stamps_ns[at + 1:]
    decided = decide(some_ns)
    assert times_of(decided)[:at] + times_of(decided)[at + 1:] == (
        stamps_ns[:at] + stamps_ns[at + 1:])
    assert events(decided) == [(at, TimeEvent.MISSING)]


@given(regular(), st.data())
def test_pictures_before_the_first_stamp_are_of_its_clock(sequence, data):
    """Where it is known; they are apart as they were received."""
    stamps_ns, _ = sequence
    count = data.draw(st.integers(1, len(stamps_ns) - 1))
    received_ns = [ns + START_NS for ns in stamps_ns]
    first = Stamp(stamps_ns[count], received_ns[count])
    decided = decide(count * [None] + stamps_ns[count:], received_ns, first=first)
    assert times_of(decided) == stamps_ns


@given(regular(), LOOKAHEADS)
def test_without_any_stamp_receipts_count_or_the_rate(sequence, lookahead):
    """The second where there is nothing else."""
    received_ns, period_ns = sequence
    nothing = len(received_ns) * [None]
    assert times_of(decide(nothing, received_ns, lookahead)) == received_ns
    assert times_of(decide(nothing, None, lookahead, period_ns=period_ns)) == [
        i * period_ns for i in range(len(nothing))]


@given(regular(), LOOKAHEADS)
def test_stamps_that_stand_still_do_not_stop_the_pictures(sequence, lookahead):
    """They pass as they are received."""
    received_ns, _ = sequence
    decided = decide(len(received_ns) * [START_NS], received_ns, lookahead)
    assert intervals(times_of(decided)) == intervals(received_ns)
    assert {event for _, event in events(decided)} == {TimeEvent.NOT_INCREASING}


@given(st.lists(st.integers(-2**32 * NS_PER_S, 2**32 * NS_PER_S), min_size=1))
def test_playing_never_waits_for_decades_and_never_goes_back(times_ns):
    """After a step it goes on in a second."""
    playing, elapsed_ns = PlayingTime(), 0
    for time_ns, before_ns in zip(times_ns, [times_ns[0], *times_ns]):
        stepped_by_ns = playing.advance(time_ns)
        assert 0 <= playing.elapsed_ns - elapsed_ns <= MAX_PAUSE_NS
        if stepped_by_ns is not None:
            assert playing.elapsed_ns == elapsed_ns + NS_PER_S
        elapsed_ns = playing.elapsed_ns


@given(good())
def test_playing_keeps_the_time_of_good_recordings(sequence):
    """To the nanosecond."""
    times_ns, _ = sequence
    playing = PlayingTime()
    for time_ns in times_ns:
        assert playing.advance(time_ns) is None
        assert playing.elapsed_ns == time_ns - times_ns[0]
