"""SIGKILLs of real agents at each point of a migration, over each kind of link, with routers that fail too."""

from __future__ import annotations

import pytest
from faults.test_fault_kills_long import check
from torture.kills import run_fleets
from torture.points import NAMES, POINTS
from torture.roads import ROADS, Routers, over_zenoh


@pytest.mark.parametrize("over", ["tcp", "local"])
def test_fault_kills_at_each_point_lose_no_task(over: str) -> None:
    """At each point between the effects of the protocol once, and the rest of the fifty at random moments."""
    tally = run_fleets(50 - len(NAMES), POINTS, seed=1, fleets=2, make_roads=ROADS[over])
    check(tally, 50)
    assert tally.kills >= 50 and sorted(tally.points) == sorted(NAMES)


def test_fault_kills_of_agents_and_routers_lose_no_task() -> None:
    tally = run_fleets(24, [], seed=4, fleets=1, make_roads=over_zenoh)
    check(tally, 24)
    assert tally.kills + tally.roads.total() == 24 and set(tally.roads) == set(Routers.faults)
