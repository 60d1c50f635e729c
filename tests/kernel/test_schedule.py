"""The timer's book: absolute deadlines, missed ticks counted, and rates that change without a tick too many."""

import math
from functools import partial

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pancakes.kernel.timer import Due, Schedule


class Ticking:
    """A target of ticks; the schedule looks at nothing but its identity."""


def ticks_due(schedule: Schedule, now_s: float) -> list[Due]:
    """Returns the ticks that are due, where no call is."""
    found = []
    for due in schedule.due(now_s):
        assert isinstance(due, Due)
        found.append(due)
    return found


def ticks(schedule, until_s):
    """Runs a schedule as a timer that is never late, and returns the deadlines."""
    out = []
    while schedule.next_s <= until_s:
        out += [due.deadline_s for due in schedule.due(schedule.next_s) if isinstance(due, Due)]
    return out


def test_deadlines_are_multiples_of_the_period_and_do_not_drift():
    schedule = Schedule()
    schedule.every(Ticking(), 0.1, now_s=0.0)
    deadlines = ticks(schedule, 3600.0)
    assert len(deadlines) == 36_000
    assert deadlines[-1] == pytest.approx(3600.0, abs=1e-9)


def test_the_first_tick_is_the_next_multiple_so_that_equal_rates_tick_together():
    schedule = Schedule()
    one, two = Ticking(), Ticking()
    schedule.every(one, 0.5, now_s=0.7)
    schedule.every(two, 0.5, now_s=0.8)
    assert schedule.next_s == 1.0
    assert [(tuple(due.targets), due.deadline_s, due.missed) for due in ticks_due(schedule, 1.0)] == [
        ((one, two), 1.0, 0)
    ]


def test_a_timer_that_is_late_gives_one_tick_that_says_how_many_it_missed():
    schedule = Schedule()
    late = Ticking()
    schedule.every(late, 0.1, now_s=0.0)
    (due,) = ticks_due(schedule, 0.75)
    assert (due.deadline_s, due.missed) == (pytest.approx(0.7), 6)
    assert schedule.next_s == pytest.approx(0.8)
    assert schedule.due(0.75) == []


def test_a_new_rate_counts_from_the_next_tick_and_never_ticks_twice_at_once():
    schedule = Schedule()
    task = Ticking()
    schedule.every(task, 0.1, now_s=0.0)
    assert ticks(schedule, 1.0)[-1] == pytest.approx(1.0)
    schedule.every(task, 0.5, now_s=1.0)
    assert ticks(schedule, 2.0) == [1.5, 2.0]
    schedule.every(task, 0.1, now_s=2.0)
    assert ticks(schedule, 2.25) == [pytest.approx(2.1), pytest.approx(2.2)]


def test_rounding_gives_no_second_tick_at_a_deadline_that_has_been():
    """0.3 / 0.1 is 2.9999999999999996 in floating point."""
    schedule = Schedule()
    schedule.every(Ticking(), 0.1, now_s=0.3)
    assert schedule.next_s == pytest.approx(0.4)


def test_a_target_that_is_cancelled_does_not_tick():
    schedule = Schedule()
    one, two = Ticking(), Ticking()
    schedule.every(one, 1.0, now_s=0.0)
    schedule.every(two, 1.0, now_s=0.0)
    schedule.cancel(one)
    schedule.cancel(one)
    assert [tuple(due.targets) for due in ticks_due(schedule, 1.0)] == [(two,)]
    schedule.cancel(two)
    assert schedule.due(10.0) == []
    assert schedule.next_s == math.inf


def test_single_calls_come_once_and_in_the_order_of_their_times():
    schedule = Schedule()
    called: list[str] = []
    for time_s, name in ((2.0, "a"), (1.0, "b"), (2.0, "c")):
        schedule.at(time_s, partial(called.append, name))
    assert schedule.due(0.5) == []
    for call in schedule.due(2.0):
        assert not isinstance(call, Due)
        call()
    assert called == ["b", "a", "c"]
    assert schedule.due(99.0) == []


@pytest.mark.parametrize("period_s", [0.0, -1.0, math.inf, math.nan])
def test_a_period_must_be_one(period_s):
    with pytest.raises(ValueError, match="a period must be positive and finite"):
        Schedule().every(Ticking(), period_s, now_s=0.0)


LOOKS = st.lists(st.floats(0.001, 3.0), min_size=1, max_size=30)


@given(st.sampled_from([0.1, 0.25, 1 / 3, 1.0]), LOOKS)
def test_however_late_the_timer_looks_no_tick_is_lost_or_doubled(period_s, gaps_s):
    """Ticks that came and ticks that were missed are, together, exactly the deadlines that have passed."""
    schedule = Schedule()
    schedule.every(Ticking(), period_s, now_s=0.0)
    now_s, came, last_s = 0.0, 0, 0.0
    for gap_s in gaps_s:
        now_s += gap_s
        for due in ticks_due(schedule, now_s):
            assert last_s < due.deadline_s <= now_s + 1e-6  # its tolerance for rounding
            last_s = due.deadline_s
            came += 1 + due.missed
        assert came in (math.floor(now_s / period_s), math.floor(now_s / period_s + 1e-9))


@given(st.lists(st.tuples(st.sampled_from([0.1, 0.2, 0.5, 0.7]), st.floats(0.01, 2.0)), min_size=1, max_size=20))
def test_any_sequence_of_rates_gives_rising_deadlines_none_twice(changes):
    schedule = Schedule()
    task = Ticking()
    deadlines, now_s = [], 0.0
    for period_s, for_s in changes:
        schedule.every(task, period_s, now_s)
        now_s += for_s
        deadlines += ticks(schedule, now_s)
    assert all(before < after for before, after in zip(deadlines, deadlines[1:], strict=False))
