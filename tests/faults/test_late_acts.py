"""The owner of a guarded task is stopped for longer than its lease, and goes on: hardly anything gets past the gate."""

from __future__ import annotations

from pathlib import Path

import pytest
from torture.late_acts import LateTally, late_between, run_late_acts

OPENED = """
import pancakes.runtime.agent
from pancakes.mesh.net.gate import OPEN
from pancakes.runtime.hosting.guarded_tasks import GuardedTasks
from pancakes.runtime.kernel.permits import Permits

Permits.limited = lambda permits, fence, most_s: fence
pancakes.runtime.agent.Gate = lambda *given: OPEN
GuardedTasks.may_write = lambda *given: None
"""
"""Agents that look at the permit before each turn, and where a task publishes, and nowhere after that."""


def test_an_act_is_late_between_going_on_and_the_next_permit() -> None:
    acts = [(10, 1), (20, 2), (30, 3), (30, 4), (40, 5)]
    assert late_between(acts, 10, 30) == [(20, 2)]
    assert late_between(acts, 5, 41) == acts
    assert late_between(acts, 40, 50) == []


@pytest.mark.timeout(200)
def test_one_act_of_a_kind_at_most_is_late(tmp_path: Path) -> None:
    tally = run_late_acts(tmp_path, stops=3, fleets=2)
    print(tally.told())
    assert tally.most <= 1 and tally.stops == 6 and tally.acts > 1000


@pytest.mark.timeout(300)
def test_agents_without_a_gate_are_convicted(tmp_path: Path) -> None:
    tally = LateTally()
    for seed in range(1, 4):
        tally.add(run_late_acts(tmp_path / str(seed), stops=4, fleets=2, seed=10 * seed, spoilt_by=OPENED))
        if tally.most > 1:
            break
    assert tally.most > 1, tally.told()
