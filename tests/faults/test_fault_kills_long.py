"""Twenty SIGKILLs of real agents while their tasks move; `scripts/torture kills` kills a thousand times."""

from __future__ import annotations

from pathlib import Path

from torture.kills import Kills, run_fleets
from torture.points import POINTS
from torture.tally import Tally


def check(tally: Tally, kills: int) -> None:
    """Judge some kills: no task is doubled or lost, and enough has happened."""
    assert (tally.doubled, tally.lost, tally.backwards, tally.missed) == ([], [], [], [])
    assert tally.moves > kills // 5 and tally.ticks > 10 * kills and tally.packets > kills
    # A checkpoint each second, and the disk may be slow, or kept from the agent: what a crash takes is bounded.
    assert tally.worst_step_back < 50 * (5 + tally.longest_no_disk_s)


def test_fault_kills_double_and_lose_no_task() -> None:
    """At every sixth point between the effects of the protocol, and at random moments."""
    points = [point for point in POINTS if point.then is None][::6]
    tally = run_fleets(20 - len(points), points, seed=1, fleets=2)
    check(tally, 20)
    assert tally.kills >= 20 and sorted(tally.points) == sorted(point.name for point in points)


FORGETFUL = """
from pancakes.durable import rules
from pancakes.durable.register import NOBODY

recover = rules.recover


def forgetful(place, all_beats):
    register = place.register
    if register.owner == place.me and register.promised > register.epoch:
        return [rules.Persist(register._replace(no=register.no + 1, heir=NOBODY, promised=register.epoch))]
    return recover(place, all_beats)


rules.recover = forgetful
rules.RULES[rules.Known] = lambda place, event: []
"""


def test_fault_kills_convict_agents_that_take_back_a_task(tmp_path: Path) -> None:
    """They take back what they have given away, and believe nobody who has it."""
    points = [point for point in POINTS if point.name == "source: after it sent PROMISE"]
    tally = Kills(tmp_path, seed=1, spoilt_by=FORGETFUL).run(0, points)
    assert tally.kills == 1 and any("runs beside another" in sentence for sentence in tally.doubled)
