"""Guarded tasks in many drawn storms: never do two act, and at the end one does."""

import pytest
from torture.storms import run_storms

SEEDS = 200
AT_A_TIME = 50


@pytest.mark.parametrize("first", range(0, SEEDS, AT_A_TIME))
def test_guarded_storms_have_one_owner_with_clocks_one_percent_apart_full(first):
    """All of a part run in one test, which names every seed that fails; the parts can run beside each other."""
    ends = list(run_storms(range(first, first + AT_A_TIME), 0.01))
    assert {end.seed: end.violation for end in ends if end.violation} == {}
    assert sum(end.counts["taken"] for end in ends) > 15
