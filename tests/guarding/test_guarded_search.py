"""No history of owners, takers and guardians breaks a promise; and a rule that is wrong or left out is seen."""

from __future__ import annotations

import pytest
from model.guarded_mutants import MUTANTS, GuardedMutant
from model.guarded_parts import Scenario
from model.guarded_scenarios import DEEP, SUITE
from model.guarded_search import GuardedSearch
from model.jobs import GuardedJob

from pancakes.mesh.guarding import guardian_core

# Seconds each, and minutes where the machine has much else to do.
pytestmark = pytest.mark.timeout(900)


@pytest.mark.parametrize("scenario", SUITE.values(), ids=lambda scenario: scenario.title)
def test_no_history_breaks_a_promise_and_each_scenario_comes_to_what_it_is_there_for(scenario: Scenario) -> None:
    search = GuardedSearch(scenario)
    result = search.run()
    assert result.violation == "", "\n".join([result.violation, *result.trace])
    assert result.complete
    assert search.missed() == []


@pytest.mark.parametrize("mutant", MUTANTS, ids=lambda mutant: mutant.name)
def test_a_rule_that_is_wrong_or_left_out_is_seen(mutant: GuardedMutant) -> None:
    result = GuardedSearch(mutant.scenario, mutant.make()).run()
    assert result.violation, f"the search does not see it, in {result.states} states"
    assert all(sentence[0].isupper() and sentence.endswith(".") for sentence in result.trace)


def test_a_scenario_that_does_not_come_to_what_it_is_there_for_is_a_fault(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(SUITE, "vain", Scenario("vain", takers="B", called=0, crashes=""))
    result = GuardedJob("vain").search()
    assert result.violation == "the scenario, which never came to: B acts"


def test_the_search_gives_up_rather_than_believe_itself() -> None:
    result = GuardedSearch(SUITE["a taker, and crashes"], most_states=200).run()
    assert not result.complete and result.violation == ""


def test_a_mutant_whose_text_is_gone_says_so() -> None:
    mutant = GuardedMutant("rotten", ((guardian_core, "a text that nobody wrote", ""),))
    with pytest.raises(LookupError, match="'rotten' finds its text 0 times"):
        mutant.make()


def test_scenarios_and_mutants_have_names_of_their_own() -> None:
    names = [*SUITE, *DEEP, *(mutant.name for mutant in MUTANTS)]
    assert len(names) == len(set(names)) and len(MUTANTS) >= 25
