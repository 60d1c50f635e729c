"""Fifty SIGKILLs of real agents while their tasks move; a thousand are run by `scripts/torture kills`."""

from __future__ import annotations

from torture.kills import run_fleets


def test_no_kill_doubles_a_task_or_loses_one() -> None:
    tally = run_fleets(kills=50, seed=1, fleets=2)
    assert tally.kills >= 50 and tally.moves > 10 and tally.ticks > 500
    assert (tally.doubled, tally.lost, tally.backwards) == ([], [], [])
    # A checkpoint each second, and the disk may be slow: what a crash takes is bounded.
    assert tally.worst_step_back < 50 * 5
