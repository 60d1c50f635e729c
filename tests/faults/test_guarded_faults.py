"""Fifty faults of real agents that guard a task: kills, ends, and stops shorter and longer than the lease."""

from __future__ import annotations

from pathlib import Path

import pytest
from torture.guarded_faults import GuardedTally, run_guarded_fleets

UNGATED = """
from pancakes.runtime.kernel.permits import Permits

Permits.holds = lambda permits, address: True
"""


@pytest.mark.timeout(400)
def test_no_fault_has_two_act_or_none(tmp_path: Path) -> None:
    tally = run_guarded_fleets(tmp_path, faults=13, fleets=4)
    print(tally.told())
    assert (tally.standstills, tally.doubled) == ([], 0)
    # A process that is stopped between its look at the clock and the act does that one act late.
    assert tally.late <= tally.faults["long stop"] + tally.faults["short stop"]
    assert sum(tally.faults.values()) >= 50 and len(tally.gaps_s) >= 10


@pytest.mark.timeout(200)
def test_agents_that_look_at_no_permit_are_convicted(tmp_path: Path) -> None:
    tally = GuardedTally()
    for seed in range(1, 4):
        tally.add(run_guarded_fleets(tmp_path / str(seed), faults=4, fleets=3, seed=10 * seed, spoilt_by=UNGATED))
        if tally.doubled:
            break
    assert tally.doubled, tally.told()
