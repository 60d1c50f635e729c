"""Fifty SIGKILLs of real agents while their tasks move; a thousand are run by `scripts/torture kills`."""

from __future__ import annotations

from pathlib import Path

import pytest
from torture.kills import Kills, plan, run_fleets
from torture.points import NAMES, POINTS
from torture.roads import ROADS, Routers, over_zenoh
from torture.tally import Tally


def check(tally: Tally) -> None:
    assert (tally.doubled, tally.lost, tally.backwards, tally.missed) == ([], [], [], [])
    assert tally.moves > 10 and tally.ticks > 500 and tally.packets > 50
    # A checkpoint each second, and the disk may be slow, or kept from the agent: what a crash takes is bounded.
    assert tally.worst_step_back < 50 * (5 + tally.longest_no_disk_s)


@pytest.mark.timeout(300)
@pytest.mark.parametrize("over", ["tcp", "local"])
def test_no_kill_doubles_a_task_or_loses_one(over: str) -> None:
    """At each point between the effects of the protocol once, and the rest of the fifty at random moments."""
    tally = run_fleets(50 - len(NAMES), POINTS, seed=1, fleets=2, make_roads=ROADS[over])
    check(tally)
    assert tally.kills >= 50 and sorted(tally.points) == sorted(NAMES)


@pytest.mark.timeout(300)
def test_no_kill_of_an_agent_or_a_router_doubles_a_task_or_loses_one() -> None:
    tally = run_fleets(24, [], seed=4, fleets=1, make_roads=over_zenoh)
    check(tally)
    assert tally.kills + tally.roads.total() == 24 and set(tally.roads) == set(Routers.faults)


def test_a_plan_divides_kills_and_goes_to_each_point_in_turn() -> None:
    assert plan(10, "random") == (10, [])
    assert plan(len(NAMES), "effects") == (0, list(POINTS))
    random_kills, points = plan(2 * len(NAMES), "both")
    assert (random_kills, points) == (len(NAMES), list(POINTS))


FORGETFUL = """
from pancakes.mesh.migration import core, source
from pancakes.mesh.migration.record import Phase

recover = core.recover
core.recover = lambda record, *others: recover(
    source.taken_back(record) if record.phase is Phase.COMMITTED else record, *others
)
"""


def test_agents_that_take_back_what_they_have_given_away_are_convicted(tmp_path: Path) -> None:
    points = [point for point in POINTS if point.name == "source: after it sent COMMIT"]
    tally = Kills(tmp_path, seed=1, spoilt_by=FORGETFUL).run(0, points)
    assert tally.kills == 1 and any("runs beside another" in sentence for sentence in tally.doubled)
