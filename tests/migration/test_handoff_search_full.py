"""The core of migration keeps its promises within the bounds of `scripts/check-migration`; each mutant is convicted."""

from __future__ import annotations

import pytest
from model.bounds import SUITE
from model.mutants import MUTANTS
from model.parts import Bounds
from model.search import Search

pytestmark = pytest.mark.timeout(900)


@pytest.mark.parametrize("bounds", SUITE, ids=str)
def test_handoff_search_keeps_promises(bounds: Bounds) -> None:
    result = Search(bounds).run()
    assert result.violation == "", "\n".join([result.violation, *result.trace])
    assert result.complete
    assert result.states > 500


def test_handoff_search_convicts_each_broken_rule() -> None:
    """And its traces are sentences."""
    results = {mutant.name: Search(mutant.bounds, mutant.make(), strict=False).run() for mutant in MUTANTS}
    assert [name for name, result in results.items() if not result.violation] == []
    for result in results.values():
        assert result.trace[0].startswith("The task is started on agent A for the first time in its life: A persists")
        assert all(sentence[0].isupper() and sentence.endswith(".") for sentence in result.trace)
