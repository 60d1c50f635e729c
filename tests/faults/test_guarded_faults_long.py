"""Faults of real agents that guard a task: kills, goodbyes, stops, cuts, lost and full disks."""

from __future__ import annotations

from pathlib import Path

from torture.guarded_faults import Takeovers
from torture.strokes import KINDS
from torture.takeover_tally import TakeoverTally

UNGATED = """
from pancakes.kernel.permits import Permits

Permits.may_act = lambda permits, fence: True
"""


def test_guarded_faults_never_have_two_act_or_none(tmp_path: Path) -> None:
    tally = Takeovers(tmp_path).run(faults=len(KINDS), fleets=3)
    print("\n".join(tally.told()))
    # A kind that does not fit when its turn comes is replaced by another.
    assert tally.failures(()) == [] and len(tally.faults) >= 8
    assert tally.faults.total() == len(KINDS) and tally.meanwhile >= 2


def test_guarded_faults_convict_agents_that_ignore_permits(tmp_path: Path) -> None:
    tally = TakeoverTally()
    for seed in range(1, 4):
        directory = tmp_path / str(seed)
        directory.mkdir()
        kinds = ("cut", "long stop")
        tally.add(Takeovers(directory, seed, UNGATED, calm=True, kinds=kinds).run(faults=6, fleets=2))
        if tally.doubled:
            break
    assert tally.doubled and tally.failures(()), tally.told()
