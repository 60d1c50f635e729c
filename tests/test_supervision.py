"""When what ended is started again, and how long that waits: the whole table."""

import random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pancakes.supervision import DeviceRestartSpec, Next, RestartSpec, Supervision, tries


class Most(random.Random):
    """Draws the longest pause each time."""

    def uniform(self, a, b):
        return b


LONGEST = Most()


def fail_at_start(supervision, now_s, source=LONGEST):
    """Each try fails at once, until none is due; yields when, and what follows."""
    due_s = now_s
    while due_s is not None:
        yield due_s, supervision.ended(True, due_s, source)
        due_s = supervision.due_s


def fail_after(supervision, ran_s, now_s=0.0):
    """It is started at `now_s`, and fails after it has run for so long; returns what follows, and the next try."""
    supervision.runs(now_s)
    return supervision.ended(True, now_s + ran_s, LONGEST), supervision.due_s


@pytest.mark.parametrize(
    ("policy", "failed", "following", "due"),
    [
        ("permanent", True, Next.RESTART, True),
        ("permanent", False, Next.RESTART, True),
        ("transient", True, Next.RESTART, True),
        ("transient", False, Next.REST, False),
        ("temporary", True, Next.GIVE_UP, False),
        ("temporary", False, Next.REST, False),
    ],
)
@pytest.mark.parametrize("again_s", [0.0, 60.0])
def test_the_policy_decides_what_follows_the_first_end(policy, failed, following, due, again_s):
    supervision = Supervision(RestartSpec(policy, again_s=again_s))
    assert supervision.ended(failed, 0.0, LONGEST) is following
    assert (supervision.due_s is not None) is due


def test_each_pause_is_twice_the_one_before_up_to_the_longest():
    supervision = Supervision(RestartSpec(pause_s=0.1, pause_max_s=1.0, at_most=6))
    tried = list(fail_at_start(supervision, 5.0))
    assert [round(time_s - 5.0, 6) for time_s, _ in tried] == [0.0, 0.1, 0.3, 0.7, 1.5, 2.5, 3.5]
    assert [following for _, following in tried] == [Next.RESTART] * 6 + [Next.GIVE_UP]
    assert supervision.failures == 7


def test_a_fault_that_stays_is_given_up_in_a_sane_time_by_default():
    *_, (given_up_s, following) = fail_at_start(Supervision(RestartSpec()), 0.0)
    assert following is Next.GIVE_UP
    assert 10.0 < given_up_s < 30.0


def test_a_fault_that_has_gone_after_a_second_is_outlived_by_default():
    tried = [time_s for time_s, following in fail_at_start(Supervision(RestartSpec()), 0.0)]
    assert min(time_s for time_s in tried if time_s > 1.0) < 2.0


@given(st.integers(), st.integers(0, 12), st.floats(0.0, 1.0), st.floats(0.0, 20.0))
def test_chance_takes_up_to_a_quarter_of_a_pause(seed, number, pause_s, more_s):
    spec = RestartSpec(pause_s=pause_s, pause_max_s=pause_s + more_s, at_most=20)
    supervision = Supervision(spec)
    for _ in range(number):
        supervision.ended(True, 0.0, LONGEST)
    supervision.ended(True, 0.0, random.Random(seed))
    whole_s = min(pause_s * 2**number, pause_s + more_s)
    assert 0.75 * whole_s - 1e-9 <= supervision.due_s <= whole_s + 1e-9


def test_the_same_seed_draws_the_same_pauses():
    spec = RestartSpec()
    one, other = (list(fail_at_start(Supervision(spec), 0.0, random.Random(7))) for _ in range(2))
    assert one == other


def test_what_fails_long_after_it_was_started_begins_with_the_first_pause():
    supervision = Supervision(RestartSpec(at_most=1, within_s=5.0))
    assert fail_after(supervision, 0.0, now_s=0.0) == (Next.RESTART, 0.1)
    assert fail_after(supervision, 5.0, now_s=1.0) == (Next.RESTART, 6.1)
    assert supervision.failures == 1
    assert fail_after(supervision, 4.9, now_s=7.0) == (Next.GIVE_UP, None)


def test_only_the_time_in_which_it_runs_counts():
    """However long the pauses are, and however long a start takes to fail, what never runs is given up."""
    supervision = Supervision(RestartSpec(at_most=3, within_s=5.0, pause_s=100.0, pause_max_s=100.0))
    assert [following for _, following in fail_at_start(supervision, 0.0)] == [Next.RESTART] * 3 + [Next.GIVE_UP]

    supervision = Supervision(RestartSpec(at_most=3, within_s=5.0))
    slow = [supervision.ended(True, time_s, LONGEST) for time_s in (10.0, 20.0, 30.0, 40.0)]
    assert slow == [Next.RESTART] * 3 + [Next.GIVE_UP]


def test_none_at_all_may_be_allowed():
    assert Supervision(RestartSpec(at_most=0)).ended(True, 0.0, LONGEST) is Next.GIVE_UP


def test_what_would_fail_in_the_same_way_each_time_is_given_up_for_good():
    supervision = Supervision(DeviceRestartSpec())
    assert supervision.ended(True, 0.0, LONGEST, hopeless=True) is Next.GIVE_UP
    assert supervision.due_s is None


def test_a_device_that_was_given_up_is_tried_again_each_minute_unless_told_otherwise():
    supervision = Supervision(DeviceRestartSpec(at_most=1))
    tried = fail_at_start(supervision, 0.0)
    found = [next(tried) for _ in range(4)]
    assert [(round(time_s, 6), following) for time_s, following in found] == [
        (0.0, Next.RESTART),
        (0.1, Next.GIVE_UP),
        (60.1, Next.GIVE_UP),
        (120.1, Next.GIVE_UP),
    ]
    assert supervision.failures == 4

    told = Supervision(DeviceRestartSpec(at_most=0, again_s=0.0))
    assert [following for _, following in fail_at_start(told, 0.0)] == [Next.GIVE_UP]


def test_what_runs_well_after_it_was_given_up_has_all_its_restarts_again():
    supervision = Supervision(RestartSpec(at_most=1, within_s=5.0, again_s=60.0))
    assert fail_after(supervision, 0.0)[0] is Next.RESTART
    assert fail_after(supervision, 1.0)[0] is Next.GIVE_UP
    assert fail_after(supervision, 1.0)[0] is Next.GIVE_UP
    assert fail_after(supervision, 6.0)[0] is Next.RESTART


def test_a_start_that_was_asked_for_begins_anew():
    supervision = Supervision(RestartSpec(at_most=1, within_s=5.0))
    assert supervision.ended(True, 0.0, LONGEST) is Next.RESTART
    supervision.forget()
    assert (supervision.failures, supervision.due_s) == (0, None)
    assert supervision.ended(True, 0.1, LONGEST) is Next.RESTART
    assert supervision.ended(True, 0.2, LONGEST) is Next.GIVE_UP


def test_a_try_that_was_called_off_does_not_come():
    supervision = Supervision(RestartSpec())
    supervision.ended(True, 0.0, LONGEST)
    called_off_s = supervision.due_s
    supervision.cancel()
    assert not supervision.take(called_off_s)
    supervision.ended(True, 1.0, LONGEST)
    assert not supervision.take(called_off_s)
    assert supervision.take(supervision.due_s)
    assert supervision.due_s is None


@pytest.mark.parametrize(
    ("described", "text"),
    [
        ({"failures": 3, "next_try_s": 3.21}, "failed 3 times, next try in 3.2 s"),
        ({"failures": 1, "next_try_s": 60.0}, "failed once, next try in 60.0 s"),
        ({"failures": 0, "next_try_s": 0.1}, "next try in 0.1 s"),  # it stops itself, and is to run all the time
        ({"failures": 3, "next_try_s": None}, ""),
        ({}, ""),  # an agent of a version that does not say
    ],
)
def test_people_are_told_when_the_next_try_is(described, text):
    assert tries(described) == text


def test_what_is_described_is_how_often_it_failed_and_how_long_the_next_try_waits():
    supervision = Supervision(RestartSpec())
    assert supervision.describe(0.0) == {"failures": 0, "next_try_s": None}
    supervision.ended(True, 5.0, LONGEST)
    assert supervision.describe(5.0) == {"failures": 1, "next_try_s": pytest.approx(0.1)}
    assert supervision.describe(6.0)["next_try_s"] == 0.0


@given(st.lists(st.floats(0.0, 4.0), max_size=40), st.integers(0, 4), st.floats(0.1, 6.0))
def test_there_are_never_more_restarts_in_the_time_than_allowed(runs_s, at_most, within_s):
    supervision = Supervision(RestartSpec("permanent", at_most, within_s))
    ran_s, restarts = 0.0, []
    for one_s in runs_s:
        ran_s += one_s
        if fail_after(supervision, one_s)[0] is Next.RESTART:
            restarts.append(ran_s)
        else:
            assert sum(1 for time_s in restarts if time_s > ran_s - within_s) >= at_most
    for time_s in restarts:
        assert sum(1 for other in restarts if time_s - within_s < other <= time_s) <= at_most
