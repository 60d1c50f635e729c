"""The core of migration keeps its promises in every interleaving, and the search sees it if it does not.

Bounds that are as small as their kind can be; those of `scripts/check-migration`, and all broken rules, are in
`test_handoff_search_full.py`.
"""

from __future__ import annotations

from model.bounds import DEEP, SUITE
from model.mutants import MUTANTS
from model.parts import Bounds
from model.search import Search
from seeded import for_each

SMALL = (
    Bounds(offers=1, packets=2),
    Bounds(offers=1, packets=2, durability="lazy"),
    Bounds(reserve=False, refusals=False),
    Bounds(agents=3, offers=1),
    Bounds(offers=1, packets=2, faults=1),
    Bounds(offers=1, packets=2, restarts=1, stops=True),
    Bounds(offers=1, restarts=1, stops=True, durability="lazy"),
    Bounds(offers=1, restarts=1, stops=True, late=True),
    Bounds(offers=1, wipes=1),
    Bounds(offers=1, wipes=1, adopt=True),
)
NAMES = (
    "start on transfer",
    "late NAK believed",
    "tombstone deleted",
    "acknowledged before checkpointed",
    "a failed write believed",
)


def test_handoff_search_keeps_promises_in_small_bounds() -> None:
    def check(bounds: Bounds) -> None:
        result = Search(bounds).run()
        assert result.violation == "", "\n".join([result.violation, *result.trace])
        assert result.complete and result.states > 500

    for_each(SMALL, check)


def test_handoff_search_convicts_some_broken_rules() -> None:
    mutants = {mutant.name: mutant for mutant in MUTANTS}
    assert [
        name for name in NAMES if not Search(mutants[name].bounds, mutants[name].make(), strict=False).run().violation
    ] == []


def test_handoff_search_tells_its_shortest_trace() -> None:
    mutant = next(mutant for mutant in MUTANTS if mutant.name == "commit sent before it is persisted")
    result = Search(mutant.bounds, mutant.make(), strict=False).run()
    assert result.violation == "S1: the task runs on A and on B at the same time"
    assert result.trace[-2:] == (
        "Agent A receives PREPARED 1@A from B: A sends COMMIT 1@A to B, crashes, comes back as FROZEN,"
        " persists OWNER (epoch 0@A), starts the task under epoch 0@A.",
        "Agent B receives COMMIT 1@A from A: B persists OWNER (epoch 1@A), starts the task under epoch 1@A,"
        " sends ACTIVATED 1@A to A.",
    )
    assert len(result.trace) == 8


def test_handoff_search_names_are_unique() -> None:
    names = [*map(str, SUITE), *map(str, DEEP), *(mutant.name for mutant in MUTANTS)]
    assert len(names) == len(set(names))
