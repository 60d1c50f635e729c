"""No history of owners, takers and guardians breaks a promise, and the search sees a rule that is missing or wrong.

Scenarios that are as small as their kind can be; those of `scripts/check-migration`, and all broken rules, are in
`test_guarded_search_full.py`.
"""

from __future__ import annotations

import pytest
from model.guarded_mutants import MUTANTS
from model.guarded_parts import Scenario
from model.guarded_scenarios import DEEP, SUITE
from model.guarded_search import GuardedSearch

SMALL = (
    Scenario("a taker", takers="B", crashes=""),
    Scenario("a taker that crashes", takers="B", window=1, crashes="B"),
    Scenario("an owner that crashes", takers="B", window=1, crashes="A"),
    Scenario("what was replicated, of two guardians", "AB", guards="AB", takers="B", packets=1, window=1, crashes=""),
    Scenario("a packet, and the owner crashes", takers="", packets=1, window=1, crashes="A"),
    Scenario("a hand-off whose source crashes", owner="B", takers="", moves="A", numbers=2, window=1, crashes="B"),
    Scenario("a hand-off whose destination crashes", owner="B", takers="", moves="A", numbers=2, window=1, crashes="A"),
    Scenario("guardians replaced", "ABCD", swap="ABD", takers="", window=1, crashes=""),
    Scenario("the guard set up, and the owner crashes", guards="A", swap="ABC", takers="", window=1, crashes="A"),
    Scenario("the disk of a guardian lost", wipes="B", takers="C", window=1, crashes=""),
    Scenario("the disk of the owner lost", wipes="A", takers="B", window=1, crashes=""),
    Scenario("the disk of a guardian copied", copies="C", takers="B", window=1, crashes=""),
    Scenario("the disk of the owner copied", copies="A", takers="B", window=1, crashes=""),
    Scenario("stopped and started, of two guardians", "AB", guards="AB", takers="B", stops=True, window=1, crashes=""),
    Scenario("a goodbye", takers="B", goodbyes=1, window=1, crashes=""),
    Scenario("adopted", takers="", moves="B", wipes="BC", adopts=True, numbers=2, window=1, crashes=""),
)
NAMES = (
    "a guardian pledges itself while its lease runs",
    "a guardian does not write down its promise",
    "one guardian gives a permit",
    "a taker is content with one pledge",
    "a destination runs without the guardians",
)


@pytest.mark.parametrize("scenario", SMALL, ids=lambda scenario: scenario.title)
def test_guarded_search_keeps_promises_in_small_scenarios(scenario: Scenario) -> None:
    search = GuardedSearch(scenario)
    result = search.run()
    assert result.violation == "", "\n".join([result.violation, *result.trace])
    assert result.complete and search.missed() == []


@pytest.mark.parametrize("name", NAMES)
def test_guarded_search_convicts_some_broken_rules(name: str) -> None:
    mutants = {mutant.name: mutant for mutant in MUTANTS}
    assert GuardedSearch(mutants[name].scenario, mutants[name].make()).run().violation


def test_guarded_search_names_are_unique() -> None:
    names = [*SUITE, *DEEP, *(mutant.name for mutant in MUTANTS)]
    assert len(names) == len(set(names)) and len(MUTANTS) >= 25
