"""Guarded tasks in drawn storms, and with bad clocks: whatever happens, never do two act; at the end one does."""

import pytest
from torture.storms import DONE, Act, run_storms

from pancakes.mesh.migration.record import TaskId
from pancakes.testing import FleetInTest

ACT = TaskId("a", "Act")
SEEDS = 200
CAUGHT = 33
"""A seed in which two agents act where their clocks differ by more than leases allow for."""


@pytest.mark.parametrize("first", range(0, SEEDS, 20))
def test_never_do_two_act_and_at_the_end_one_does_with_clocks_that_are_wrong_by_one_percent(first):
    ends = list(run_storms(range(first, first + 20), 0.01))
    assert {end.seed: end.violation for end in ends if end.violation} == {}
    assert sum(end.counts["taken"] for end in ends) > 5


def test_two_act_in_a_storm_where_clocks_are_wrong_by_ten_percent():
    (end,) = run_storms([CAUGHT], 0.1)
    assert end.two, end.violation


@pytest.mark.parametrize(("apart", "holds"), [(0.01, True), (0.05, True), (0.1, False)])
def test_clocks_may_differ_by_five_percent_and_by_no_more_than_a_lease_is_longer_than_a_permit(apart, holds):
    DONE.clear()
    with FleetInTest(seed=7, classes={"test.Act": Act}) as fleet:
        task = {"type": Act, "guard": 3, "lease_s": 10.0}
        fleet.start("a", tasks={"Act": task}, clock_rate=1.0 - apart)
        fleet.start("b", clock_rate=1.0 + apart)
        fleet.start("c", clock_rate=1.0 + apart)
        fleet.connect()
        fleet.run_for(9.5)  # the guardians have just answered
        record = fleet.agents["a"].agent.records.get(ACT)
        assert record is not None and record.guards.version == 2
        fleet.faults.cut("a", for_s=14.0)
        fleet.run_for(30.0)
        epochs = [epoch for _, epoch in DONE]
        assert epochs[-1][0] == 1
        assert (epochs == sorted(epochs)) is holds
