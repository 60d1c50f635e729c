"""No history breaks a promise about a hosted task, and the search sees a rule that is missing or wrong.

The smallest scenario of each kind; all of them, and all broken rules, are in `test_hosting_search_full.py`.
"""

from __future__ import annotations

from collections import Counter

from model.hosting_convictions import CONVICTED_IN
from model.hosting_mutants import make, stories
from model.hosting_scenarios import SUITE
from model.hosting_search import search
from seeded import for_each

from pancakes.durable.record import Phase
from pancakes.supervision.lifecycle import State

NEVER: dict[State | None, str] = {
    None: "FROZEN",
    State.REFUSED: "COMMITTED",
    State.ASKED: "COMMITTED",
    State.CALLED_OFF: "COMMITTED PREPARED",
    State.STARTING: "ABSENT FROZEN COMMITTED PREPARED RELEASED",
    State.RUNNING: "ABSENT COMMITTED PREPARED RELEASED",
    State.RESTARTING: "ABSENT COMMITTED PREPARED RELEASED",
}
"""The pairs of a state and a phase that no history comes to.

An actor begins and runs only if its agent owns the task, and only an actor that runs can be frozen. A frozen task has a
place. A task that was given away is told to end, so that nothing starts it again, refuses it or calls it off; a task
that was removed may begin again.
"""
SMALL = (
    "it comes where another has its name",
    "its disk was wiped, and it comes",
    "its record was lost, it comes, and writes fail",
    "no",
    "it comes, and the agent crashes",
    "on-failure",
    "always, tried again",
    "it comes, and is adopted",
    "it comes, and is asked for",
    "given away at the third attempt",
    "it is removed, and the agent crashes",
    "it sticks",
    "it comes and goes, and the agent crashes",
    "it comes, and the service ends",
    "given away, and writes fail",
    "given away, and it sticks",
    "another owns it, and its service ends",
    "its birth waits, and writes fail",
    "its birth waits, and it follows another",
    "its disk is an old copy, and it went on elsewhere",
    "its disk is an old copy while it is given away",
)
"""A scenario of each kind, of some thousand worlds at most."""
MUTANTS = (
    "AskLeave means nothing",
    "Persist only passes",
    "a record found on disk gives no leave",
    "what was refused is believed to run",
    "what is being adopted is born",
)


def never() -> set[tuple[State | None, Phase]]:
    return {(state, Phase[name]) for state, names in NEVER.items() for name in names.split()}


def test_hosting_search_keeps_promises_in_small_scenarios() -> None:
    met: Counter[tuple[State | None, Phase]] = Counter()

    def check(name: str) -> None:
        nonlocal met
        result = search(SUITE[name])
        assert not result.violation, f"{result.violation}, after: {', '.join(result.history)}"
        met += result.met

    for_each(SMALL, check)
    assert len(met) > 30 and not never() & met.keys()


def test_hosting_search_convicts_some_broken_rules() -> None:
    assert [story for story in MUTANTS if not search(SUITE[CONVICTED_IN[story]], make(story)).violation] == []


def test_hosting_search_has_a_scenario_for_each_mutant() -> None:
    assert sorted(CONVICTED_IN) == sorted(stories())
