"""The owner of a guarded task is stopped for longer than its lease: hardly anything gets past the gate.

`scripts/torture gate` stops it a hundred times.
"""

from __future__ import annotations

from pathlib import Path

from torture.late_acts import LateTally, run_late_acts

OPENED = """
import pancakes.agent.agent
from pancakes.mesh.session import OPEN
from pancakes.durable.leases import Leases
from pancakes.kernel.permits import Permits

Permits.limited = lambda permits, fence, most_s: fence
pancakes.agent.agent.Gate = lambda *given: OPEN
Leases.may_write = lambda *given: None
"""
"""Agents that look at the permit before each turn, and when a task publishes, and not after that."""


def test_late_acts_of_each_kind_are_one_at_most(tmp_path: Path) -> None:
    tally = run_late_acts(tmp_path, stops=2, fleets=2)
    print(tally.told())
    assert tally.most <= 1 and tally.stops == 4 and tally.acts > 600


def test_late_acts_convict_agents_without_a_gate(tmp_path: Path) -> None:
    tally = LateTally()
    for seed in range(1, 4):
        tally.add(run_late_acts(tmp_path / str(seed), stops=4, fleets=2, seed=10 * seed, spoilt_by=OPENED))
        if tally.most > 1:
            break
    assert tally.most > 1, tally.told()
