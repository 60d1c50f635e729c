"""The join of a register with the life of its actor, walked in larger worlds: minutes."""

from __future__ import annotations

import pytest
from register.joined import Bounds, Joined

from pancakes.supervision.restart import RestartSpec

LARGE: dict[str, Bounds] = {
    "two moves, two requests": Bounds(moves=2, requests=2),
    "it comes back, the agent crashes": Bounds(moves=1, requests=1, visits=1, crashes=1),
    "it comes back, writes fail": Bounds(moves=1, requests=1, visits=1, faults=1),
    "it is started again, writes fail": Bounds(
        requests=2, faults=1, ends=1, errors=True, restart=RestartSpec("always", at_most=1)
    ),
    "it is started again while it moves": Bounds(
        requests=1, ends=1, errors=True, moves=1, restart=RestartSpec("on-failure", at_most=1, again_s=60.0)
    ),
    "two owners while it moves, writes fail": Bounds(disputes=1, requests=1, moves=1, faults=1),
    "its service ends while it moves, writes fail": Bounds(closes=True, moves=1, requests=1, faults=1),
    "it is removed, writes fail": Bounds(requests=2, removals=1, faults=1),
    "there and back, twice": Bounds(visits=2, moves=2, spawns=3),
    "no room": Bounds(spawns=1, requests=2, moves=1, visits=1),
    "guarded, two requests": Bounds(guarded=True, requests=2, lapses=2),
    "guarded, it moves, writes fail": Bounds(guarded=True, moves=1, requests=1, faults=1),
    "guarded, it moves, the agent crashes": Bounds(guarded=True, moves=1, requests=1, crashes=1),
    "guarded, two requests while it moves, writes fail": Bounds(guarded=True, moves=1, requests=2, faults=1),
    "guarded, it comes back": Bounds(guarded=True, moves=1, visits=1, requests=1),
    "its place goes with it, writes fail": Bounds(
        moves=1, requests=1, visits=1, faults=1, ends=1, errors=True, configured=False
    ),
    "its place goes with it, its service ends": Bounds(
        closes=True, moves=1, requests=1, visits=1, removals=1, configured=False
    ),
    "guarded, its place goes with it": Bounds(guarded=True, moves=1, requests=1, visits=1, configured=False),
    "guarded, its service ends": Bounds(closes=True, guarded=True, moves=1, visits=1),
}


@pytest.mark.parametrize("name", LARGE)
def test_walk_keeps_promises_in_large_worlds(name: str) -> None:
    found = Joined(LARGE[name]).run()
    assert not found.violation, f"{found.violation}, after: {', '.join(found.history)}"
