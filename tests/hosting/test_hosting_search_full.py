"""No history of any scenario breaks a promise about a hosted task, and the search sees each broken rule."""

from __future__ import annotations

from collections import Counter

import pytest
from hosting.test_hosting_search import never
from model.hosting_convictions import CONVICTED_IN
from model.hosting_mutants import make
from model.hosting_scenarios import SUITE
from model.hosting_search import search

from pancakes.durable.record import Phase
from pancakes.supervision.lifecycle import State

pytestmark = pytest.mark.timeout(900)


def test_hosting_search_keeps_promises_and_meets_each_pair() -> None:
    """Each state goes together with each phase somewhere, except the pairs that no history may come to."""
    met: Counter[tuple[State | None, Phase]] = Counter()
    for name, bounds in SUITE.items():
        result = search(bounds)
        print(f"{result.worlds:>8} {name}")
        assert not result.violation, f"{name}: {result.violation}, after: {', '.join(result.history)}"
        met += result.met
    print_matrix(met)
    assert {(state, phase) for state in (None, *State) for phase in Phase if not met[state, phase]} == never()


def print_matrix(met: Counter[tuple[State | None, Phase]]) -> None:
    """Shows in how many worlds each state goes together with each phase."""
    print(f"{'':12}", *(f"{phase.name:>10}" for phase in Phase))
    for state in (None, *State):
        name = state.name if state is not None else "no place"
        print(f"{name:12}", *(f"{met[state, phase] or '-':>10}" for phase in Phase))


def test_hosting_search_convicts_each_broken_rule() -> None:
    assert [story for story in CONVICTED_IN if not search(SUITE[CONVICTED_IN[story]], make(story)).violation] == []
