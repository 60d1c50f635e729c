"""Fifty faults of real agents that guard a task, of all kinds: kills, goodbyes, stops, cuts, lost and full disks."""

from __future__ import annotations

from pathlib import Path

import pytest
from torture.guarded_faults import Takeovers
from torture.strokes import KINDS
from torture.takeover_tally import TakeoverTally

UNGATED = """
from pancakes.runtime.kernel.permits import Permits

Permits.may_act = lambda permits, fence: True
"""


@pytest.mark.timeout(900)
def test_no_fault_has_two_act_or_none(tmp_path: Path) -> None:
    tally = Takeovers(tmp_path).run(faults=50, fleets=4)
    print("\n".join(tally.told()))
    assert tally.failures(KINDS) == []
    assert tally.faults.total() == 50 and tally.meanwhile >= 15


@pytest.mark.timeout(400)
def test_agents_that_look_at_no_permit_are_convicted(tmp_path: Path) -> None:
    tally = TakeoverTally()
    for seed in range(1, 4):
        directory = tmp_path / str(seed)
        directory.mkdir()
        kinds = ("cut", "long stop")
        tally.add(Takeovers(directory, seed, UNGATED, calm=True, kinds=kinds).run(faults=6, fleets=2))
        if tally.doubled:
            break
    assert tally.doubled and tally.failures(()), tally.told()
