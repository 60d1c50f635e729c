"""No history breaks a promise about a hosted task; and the search would see a rule that is missing or wrong."""

from __future__ import annotations

from collections import Counter

import pytest
from model.hosting_convictions import CONVICTED_IN
from model.hosting_mutant import HostingMutant
from model.hosting_mutants import make, stories
from model.hosting_scenarios import SUITE
from model.hosting_search import search

from pancakes.mesh.migration.record import Phase
from pancakes.runtime.life.life import State

NEVER: dict[State | None, str] = {
    None: "FROZEN",
    State.REFUSED: "COMMITTED",
    State.ASKED: "COMMITTED",
    State.CALLED_OFF: "COMMITTED PREPARED",
    State.STARTING: "ABSENT FROZEN COMMITTED PREPARED RELEASED",
    State.RUNNING: "ABSENT COMMITTED PREPARED RELEASED",
    State.RESTARTING: "ABSENT COMMITTED PREPARED RELEASED",
}
"""The pairs of a state and a phase that are met in no history.

An actor begins and runs only where its agent owns the task, and only one that runs can stand still. What stands still
has a place. What was given away is told to end, so that nothing of it is started again, refused or called off; what was
removed may begin anew.
"""


def test_no_history_breaks_a_promise_and_each_state_is_met_in_each_phase() -> None:
    met: Counter[tuple[State | None, Phase]] = Counter()
    for name, bounds in SUITE.items():
        result = search(bounds)
        print(f"{result.worlds:>8} {name}")
        assert not result.violation, f"{name}: {result.violation}, after: {', '.join(result.history)}"
        met += result.met
    print_matrix(met)
    never = {(state, phase) for state in (None, *State) for phase in Phase if not met[state, phase]}
    assert never == {(state, Phase[name]) for state, names in NEVER.items() for name in names.split()}


def print_matrix(met: Counter[tuple[State | None, Phase]]) -> None:
    """Shows in how many worlds each state goes together with each phase."""
    print(f"{'':12}", *(f"{phase.name:>10}" for phase in Phase))
    for state in (None, *State):
        name = state.name if state is not None else "no place"
        print(f"{name:12}", *(f"{met[state, phase] or '-':>10}" for phase in Phase))


def test_each_variant_has_a_scenario_that_convicts_it() -> None:
    assert sorted(CONVICTED_IN) == sorted(stories())


@pytest.mark.parametrize("story", CONVICTED_IN)
def test_a_rule_that_is_wrong_or_left_out_is_seen(story: str) -> None:
    assert search(SUITE[CONVICTED_IN[story]], make(story)).violation, "the search does not see it"


def test_a_mutant_whose_text_is_gone_says_so() -> None:
    with pytest.raises(LookupError, match="'rotten' finds its text 0 times"):
        HostingMutant("rotten", "a text that nothing has", "").make()
