"""The core keeps its promises in every interleaving, and the search would see it if it did not."""

from __future__ import annotations

from typing import Any

import pytest
from handoff_mutants import MUTANTS, Mutant
from handoff_search import Search

BOUNDS: list[dict[str, Any]] = [
    {"offers": 1, "packets": 2},
    {"offers": 2},
    {"offers": 3, "reserve": False, "refusals": False},
    {"offers": 1, "packets": 2, "durability": "lazy"},
    {"offers": 2, "durability": "lazy", "reserve": False},
    {"agents": 3, "offers": 1, "packets": 2},
    {"agents": 3, "offers": 2, "reserve": False},
    {"offers": 1, "packets": 2, "faults": 2},
    {"offers": 2, "faults": 1, "reserve": False},
    {"offers": 1, "packets": 2, "faults": 2, "durability": "lazy"},
    {"offers": 1, "packets": 2, "restarts": 1},
    {"offers": 1, "restarts": 1, "faults": 1, "durability": "lazy"},
    {"offers": 2, "wipes": 1, "reserve": False},
]


@pytest.mark.parametrize("bounds", BOUNDS, ids=lambda bounds: " ".join(f"{k}={v}" for k, v in bounds.items()))
def test_no_interleaving_breaks_a_promise(bounds: dict[str, Any]) -> None:
    result = Search(**bounds).run()
    assert result.violation == "", "\n".join([result.violation, *result.trace])
    assert result.complete
    assert result.states > 100


@pytest.mark.parametrize("mutant", MUTANTS, ids=lambda mutant: mutant.name)
def test_every_mutant_is_convicted(mutant: Mutant) -> None:
    result = Search(**mutant.bounds, under_test=mutant.make(), strict=False).run()
    assert result.violation, f"{mutant.story}: and nobody noticed, in {result.states} states"
    assert result.trace


def test_a_mutant_whose_text_is_gone_says_so() -> None:
    mutant = Mutant("rotten", "", ((MUTANTS[0].edits[0][0], "a text that nobody wrote", ""),))
    with pytest.raises(LookupError, match="'rotten' finds its text 0 times"):
        mutant.make()
