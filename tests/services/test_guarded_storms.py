"""Guarded tasks in drawn storms, and with bad clocks: never do two act, and at the end one does.

A few storms; `test_guarded_storms_full.py` has many more.
"""

import pytest
from torture.storms import DONE, Act, run_storms

from pancakes.durable.record import TaskId
from pancakes.testing import Fleet

ACT = TaskId("a", "Act")
SEEDS = (1, 14, 18)
"""Quick ones in which other agents take over and the task moves."""
CAUGHT = 33
"""A seed in which two agents act if their clocks differ by more than leases allow for."""


def test_guarded_storms_have_one_owner_with_clocks_one_percent_apart():
    ends = list(run_storms(SEEDS, 0.01))
    assert {end.seed: end.violation for end in ends if end.violation} == {}
    assert sum(end.counts["taken"] for end in ends) >= 5


def test_guarded_storms_catch_clocks_ten_percent_apart():
    (end,) = run_storms([CAUGHT], 0.1)
    assert end.two, end.violation


@pytest.mark.parametrize(("apart", "holds"), [(0.01, True), (0.05, True), (0.1, False)])
def test_guarded_task_needs_clocks_five_percent_apart_at_most(apart, holds):
    """A lease is longer than a permit by just that."""
    DONE.clear()
    with Fleet(seed=7, classes={"test.Act": Act}) as fleet:
        task = {"type": Act, "guard": {"copies": 3, "lease_s": 10.0}}
        fleet.start("a", tasks={"Act": task}, clock_rate=1.0 - apart)
        fleet.start("b", clock_rate=1.0 + apart)
        fleet.start("c", clock_rate=1.0 + apart)
        fleet.connect()
        fleet.run_for(9.5)  # the guardians have just answered
        record = fleet.agents["a"].agent.records.get(ACT)
        assert record is not None and len(record.register.sets) == 1 and record.guarded
        fleet.faults.cut("a", for_s=14.0)
        fleet.run_for(30.0)
        epochs = [epoch for _, epoch in DONE]
        assert epochs[-1][0] == 1
        assert (epochs == sorted(epochs)) is holds
