"""When what ended is started again, and how long that waits: the whole table."""

import itertools
import random

import pytest
from hypothesis import given
from hypothesis import strategies as st
from seeded import for_each

from pancakes.supervision.restart import DeviceRestartSpec, Next, Restarts, RestartSpec, tries


def longest(low, high):
    """Draws the longest pause each time."""
    return high


def fail_at_start(restarts, now_s, draw=longest):
    """Each try fails at once, until none is due; yields when, what follows, and what is remembered then."""
    due_s = now_s
    while due_s is not None:
        following, restarts = restarts.ended(True, due_s, draw)
        yield due_s, following, restarts
        due_s = restarts.due_s


def fail_after(restarts, ran_s, now_s=0.0):
    """It starts at `now_s` and fails after it has run for so long; returns what follows, and what is remembered."""
    return restarts.began(now_s).ended(True, now_s + ran_s, longest)


def test_restart_policy_after_first_end():
    def check(case):
        (policy, failed, following, due), again_s = case
        found, restarts = Restarts(RestartSpec(policy, again_s=again_s)).ended(failed, 0.0, longest)
        assert found is following
        assert (restarts.due_s is not None) is due

    for_each(
        itertools.product(
            [
                ("always", True, Next.RESTART, True),
                ("always", False, Next.RESTART, True),
                ("on-failure", True, Next.RESTART, True),
                ("on-failure", False, Next.REST, False),
                ("no", True, Next.GIVE_UP, False),
                ("no", False, Next.REST, False),
            ],
            [0.0, 60.0],
        ),
        check,
    )


@pytest.mark.parametrize("policy", ["always", "on-failure", "no"])
def test_an_end_that_was_no_fault_of_its_own_is_started_again_and_not_counted(policy):
    restarts = Restarts(RestartSpec(policy, at_most=1, pause_s=0.1)).began(0.0)
    for time_s in (1.0, 2.0, 3.0):
        following, restarts = restarts.began(time_s - 0.5).ended(True, time_s, longest, blameless=True)
        assert (following, restarts.due_s) == (Next.RESTART, time_s + 0.1)
    assert (restarts.failures, restarts.restarts_s, restarts.ran_s) == (0, (), 1.5)


def test_each_pause_is_twice_the_one_before_up_to_the_longest():
    tried = list(fail_at_start(Restarts(RestartSpec(pause_s=0.1, pause_max_s=1.0, at_most=6)), 5.0))
    assert [round(time_s - 5.0, 6) for time_s, _, _ in tried] == [0.0, 0.1, 0.3, 0.7, 1.5, 2.5, 3.5]
    assert [following for _, following, _ in tried] == [Next.RESTART] * 6 + [Next.GIVE_UP]
    assert tried[-1][2].failures == 7


def test_a_fault_that_stays_is_given_up_in_a_sane_time_by_default():
    *_, (given_up_s, following, _) = fail_at_start(Restarts(RestartSpec()), 0.0)
    assert following is Next.GIVE_UP
    assert 10.0 < given_up_s < 30.0


def test_a_fault_that_has_gone_after_a_second_is_outlived_by_default():
    tried = [time_s for time_s, _, _ in fail_at_start(Restarts(RestartSpec()), 0.0)]
    assert min(time_s for time_s in tried if time_s > 1.0) < 2.0


@given(st.integers(), st.integers(0, 12), st.floats(0.0, 1.0), st.floats(0.0, 20.0))
def test_chance_takes_up_to_a_quarter_of_a_pause(seed, number, pause_s, more_s):
    restarts = Restarts(RestartSpec(pause_s=pause_s, pause_max_s=pause_s + more_s, at_most=20))
    for _ in range(number):
        _, restarts = restarts.ended(True, 0.0, longest)
    _, restarts = restarts.ended(True, 0.0, random.Random(seed).uniform)
    whole_s = min(pause_s * 2**number, pause_s + more_s)
    assert 0.75 * whole_s - 1e-9 <= restarts.due_s <= whole_s + 1e-9


def test_the_same_seed_draws_the_same_pauses():
    one, other = (list(fail_at_start(Restarts(RestartSpec()), 0.0, random.Random(7).uniform)) for _ in range(2))
    assert one == other


def test_what_fails_long_after_it_was_started_begins_with_the_first_pause():
    following, restarts = fail_after(Restarts(RestartSpec(at_most=1, within_s=5.0)), 0.0, now_s=0.0)
    assert (following, restarts.due_s) == (Next.RESTART, 0.1)
    following, restarts = fail_after(restarts, 5.0, now_s=1.0)
    assert (following, restarts.due_s, restarts.failures) == (Next.RESTART, 6.1, 1)
    following, restarts = fail_after(restarts, 4.9, now_s=7.0)
    assert (following, restarts.due_s) == (Next.GIVE_UP, None)


def test_only_the_time_in_which_it_runs_counts():
    """However long the pauses are, and however long a start takes to fail, what never runs is given up."""
    spec = RestartSpec(at_most=3, within_s=5.0, pause_s=100.0, pause_max_s=100.0)
    found = [following for _, following, _ in fail_at_start(Restarts(spec), 0.0)]
    assert found == [Next.RESTART] * 3 + [Next.GIVE_UP]

    restarts, slow = Restarts(RestartSpec(at_most=3, within_s=5.0)), []
    for time_s in (10.0, 20.0, 30.0, 40.0):
        following, restarts = restarts.ended(True, time_s, longest)
        slow.append(following)
    assert slow == [Next.RESTART] * 3 + [Next.GIVE_UP]


def test_none_at_all_may_be_allowed():
    assert Restarts(RestartSpec(at_most=0)).ended(True, 0.0, longest)[0] is Next.GIVE_UP


def test_what_would_fail_in_the_same_way_each_time_is_given_up_for_good():
    following, restarts = Restarts(DeviceRestartSpec()).ended(True, 0.0, longest, hopeless=True)
    assert (following, restarts.due_s) == (Next.GIVE_UP, None)


def test_a_device_that_was_given_up_is_tried_again_each_minute_unless_told_otherwise():
    tried = fail_at_start(Restarts(DeviceRestartSpec(at_most=1)), 0.0)
    found = [next(tried) for _ in range(4)]
    assert [(round(time_s, 6), following) for time_s, following, _ in found] == [
        (0.0, Next.RESTART),
        (0.1, Next.GIVE_UP),
        (60.1, Next.GIVE_UP),
        (120.1, Next.GIVE_UP),
    ]
    assert found[-1][2].failures == 4

    told = Restarts(DeviceRestartSpec(at_most=0, again_s=0.0))
    assert [following for _, following, _ in fail_at_start(told, 0.0)] == [Next.GIVE_UP]


def test_what_runs_well_after_it_was_given_up_has_all_its_restarts_again():
    restarts, found = Restarts(RestartSpec(at_most=1, within_s=5.0, again_s=60.0)), []
    for ran_s in (0.0, 1.0, 1.0, 6.0):
        following, restarts = fail_after(restarts, ran_s)
        found.append(following)
    assert found == [Next.RESTART, Next.GIVE_UP, Next.GIVE_UP, Next.RESTART]


def test_a_start_that_was_asked_for_begins_anew():
    _, restarts = Restarts(RestartSpec(at_most=1, within_s=5.0)).ended(True, 0.0, longest)
    restarts = restarts.forgotten()
    assert (restarts.failures, restarts.due_s) == (0, None)
    following, restarts = restarts.ended(True, 0.1, longest)
    assert following is Next.RESTART
    assert restarts.ended(True, 0.2, longest)[0] is Next.GIVE_UP


def test_a_try_that_is_made_or_called_off_is_due_no_more_and_still_counts():
    _, restarts = Restarts(RestartSpec(at_most=1)).ended(True, 0.0, longest)
    assert restarts.tried().due_s is None
    assert restarts.tried().ended(True, 0.1, longest)[0] is Next.GIVE_UP


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
    restarts = Restarts(RestartSpec())
    assert restarts.describe(0.0) == {"failures": 0, "next_try_s": None}
    _, restarts = restarts.ended(True, 5.0, longest)
    assert restarts.describe(5.0) == {"failures": 1, "next_try_s": pytest.approx(0.1)}
    assert restarts.describe(6.0)["next_try_s"] == 0.0


@given(st.lists(st.floats(0.0, 4.0), max_size=40), st.integers(0, 4), st.floats(0.1, 6.0))
def test_there_are_never_more_restarts_in_the_time_than_allowed(runs_s, at_most, within_s):
    restarts = Restarts(RestartSpec("always", at_most, within_s))
    ran_s, when_s = 0.0, []
    for one_s in runs_s:
        ran_s += one_s
        following, restarts = fail_after(restarts, one_s)
        if following is Next.RESTART:
            when_s.append(ran_s)
        else:
            assert sum(1 for time_s in when_s if time_s > ran_s - within_s) >= at_most
    for time_s in when_s:
        assert sum(1 for other in when_s if time_s - within_s < other <= time_s) <= at_most
