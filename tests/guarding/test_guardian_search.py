"""No history of an owner, of agents that want its task, and of its guardians breaks a promise; a wrong rule is seen."""

from __future__ import annotations

from collections import Counter

import pytest
from model.guardian_mutants import MUTANTS, SUITE, GuardianMutant
from model.guardian_search import GuardianSearch

MUST_BE_MET = (
    "a acts",
    "b acts",
    "c acts",
    "b takes over",
    "c takes over",
    "a guardian restarts",
    "a checkpoint is held by more than half",
    "a task is given up, and taken",
)


def test_at_most_one_agent_acts_and_nothing_that_was_replicated_is_lost() -> None:
    met: Counter[str] = Counter()
    for bounds in SUITE:
        search = GuardianSearch(bounds)
        broken, history = search.run()
        print(f"{search.worlds:>8} {bounds}")
        assert not broken, f"{broken}, after: {'; '.join(history)}"
        met += search.met
    assert all(met[what] for what in MUST_BE_MET), met


@pytest.mark.parametrize("mutant", MUTANTS, ids=lambda mutant: mutant.story)
def test_a_rule_that_is_wrong_or_left_out_is_seen(mutant: GuardianMutant) -> None:
    broken, _ = mutant.search().run()
    assert broken, "the search does not see it"
