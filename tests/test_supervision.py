"""When a task that ended is started again: the whole table."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pancakes.supervision import Next, RestartSpec, Supervision


@pytest.mark.parametrize(
    ("policy", "failed", "following"),
    [
        ("permanent", True, Next.RESTART),
        ("permanent", False, Next.RESTART),
        ("transient", True, Next.RESTART),
        ("transient", False, Next.REST),
        ("temporary", True, Next.GIVE_UP),
        ("temporary", False, Next.REST),
    ],
)
def test_the_policy_decides_what_follows_the_first_end(policy, failed, following):
    assert Supervision(RestartSpec(policy)).ended(failed, 0.0) is following


def test_too_many_failures_in_the_time_and_it_is_given_up():
    supervision = Supervision(RestartSpec("permanent", at_most=3, within_s=5.0))
    assert [supervision.ended(True, time_s) for time_s in (0.0, 1.0, 2.0, 3.0)] == [Next.RESTART] * 3 + [Next.GIVE_UP]


def test_failures_that_lie_back_further_do_not_count():
    supervision = Supervision(RestartSpec("permanent", at_most=3, within_s=5.0))
    assert [supervision.ended(True, time_s) for time_s in (0.0, 2.0, 4.0, 5.0, 7.0)] == [Next.RESTART] * 5


def test_none_at_all_may_be_allowed():
    assert Supervision(RestartSpec("permanent", at_most=0)).ended(True, 0.0) is Next.GIVE_UP


def test_a_start_that_was_asked_for_begins_anew():
    supervision = Supervision(RestartSpec("permanent", at_most=1, within_s=5.0))
    assert supervision.ended(True, 0.0) is Next.RESTART
    supervision.forget()
    assert supervision.ended(True, 0.1) is Next.RESTART
    assert supervision.ended(True, 0.2) is Next.GIVE_UP


@given(st.lists(st.floats(0.0, 4.0), max_size=40), st.integers(0, 4), st.floats(0.1, 6.0))
def test_there_are_never_more_restarts_in_the_time_than_allowed(gaps_s, at_most, within_s):
    supervision = Supervision(RestartSpec("permanent", at_most, within_s))
    now_s, restarts = 0.0, []
    for gap_s in gaps_s:
        now_s += gap_s
        if supervision.ended(True, now_s) is Next.RESTART:
            restarts.append(now_s)
        else:
            assert sum(1 for time_s in restarts if time_s > now_s - within_s) >= at_most
    for time_s in restarts:
        assert sum(1 for other in restarts if time_s - within_s < other <= time_s) <= at_most
