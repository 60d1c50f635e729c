"""No history of requests, timers, ends and failures breaks a life, and the search sees a rule that does.

Each broken rule is convicted in `test_life_search_full.py`.
"""

import functools

import pytest
from register.life_search import search

from pancakes.supervision.lifecycle import State
from pancakes.supervision.lifecycle_table import TABLE
from pancakes.supervision.restart import RestartSpec

SPECS = {
    "always": RestartSpec("always", at_most=1),
    "always, tried again": RestartSpec("always", at_most=1, again_s=60.0),
    "on-failure": RestartSpec("on-failure", at_most=1),
    "no": RestartSpec("no", at_most=1),
}


@functools.cache
def searched(name):
    return search(SPECS[name])


@pytest.mark.parametrize("name", SPECS)
def test_life_search_finds_no_broken_promise(name):
    worlds, _, violation = searched(name)
    assert not violation
    assert worlds > 500


def test_life_search_meets_every_pair_of_the_table():
    met = set().union(*(searched(name)[1] for name in SPECS))
    never = {pair for pair in TABLE if pair not in met}
    print_matrix(met)
    assert not never


def print_matrix(met):
    """Shows which events were met in which states."""
    events = sorted({kind for _, kind in TABLE}, key=lambda kind: kind.__name__)
    print()
    for state in State:
        print(f"{state.name:<11}", " ".join(kind.__name__ if (state, kind) in met else "·" for kind in events))


def unseen(pairs):
    """Returns the pairs of state and event whose rule may do nothing, and no search sees it."""
    return [
        f"{state.name}, {kind.__name__}"
        for state, kind in pairs
        if not any(search(spec, {**TABLE, (state, kind): nothing})[2] for spec in SPECS.values())
    ]


def nothing(life, event, at):
    return life, []


def rules_that_act():
    does_something = [pair for pair, rule in TABLE.items() if rule.__name__ != "_nothing"]
    return sorted(does_something, key=lambda pair: (pair[0].name, pair[1].__name__))


def test_life_search_sees_some_rules_that_do_nothing():
    """The first rule of each state."""
    first = {state: (state, kind) for state, kind in reversed(rules_that_act())}
    assert unseen(first.values()) == []
