"""No history of any scenario of guarded tasks breaks a promise, and the search sees each broken rule."""

from __future__ import annotations

import pytest
from model.guarded_mutants import MUTANTS
from model.guarded_parts import Scenario
from model.guarded_scenarios import SUITE
from model.guarded_search import GuardedSearch

# Seconds each, and minutes if the machine has much else to do.
pytestmark = pytest.mark.timeout(900)


@pytest.mark.parametrize("scenario", SUITE.values(), ids=lambda scenario: scenario.title)
def test_guarded_search_keeps_promises_and_reaches_its_aim(scenario: Scenario) -> None:
    search = GuardedSearch(scenario)
    result = search.run()
    assert result.violation == "", "\n".join([result.violation, *result.trace])
    assert result.complete
    assert search.missed() == []


def test_guarded_search_convicts_each_broken_rule() -> None:
    """And its traces are sentences."""
    results = {mutant.name: GuardedSearch(mutant.scenario, mutant.make()).run() for mutant in MUTANTS}
    assert [name for name, result in results.items() if not result.violation] == []
    for result in results.values():
        assert all(sentence[0].isupper() and sentence.endswith(".") for sentence in result.trace)
