"""No history breaks the join of a register with the life of its actor: exhaustive walks of small worlds.

No pair of a life and a course raises: the table of lives has no entry for what cannot happen.
"""

from __future__ import annotations

from collections import Counter
from types import FunctionType, ModuleType

import pytest
from register.edited import edited
from register.joined import Bounds, Joined
from seeded import for_each

from pancakes.durable import reconcile
from pancakes.durable.register import Standing
from pancakes.supervision.lifecycle import State
from pancakes.supervision.restart import RestartSpec

SMALL: dict[str, Bounds] = {
    "two requests": Bounds(requests=2),
    "it moves, and is stopped": Bounds(moves=1, requests=1),
    "it fails, writes fail": Bounds(requests=1, ends=1, errors=True, faults=1),
    "it fails while it moves": Bounds(moves=1, ends=1, errors=True, faults=1),
    "it moves, the agent crashes": Bounds(moves=1, crashes=1),
    "it goes, and comes back": Bounds(moves=1, visits=1),
    "another agent owns it too": Bounds(disputes=1, requests=1),
    "its service ends while it moves": Bounds(closes=True, moves=1),
    "it is removed": Bounds(requests=2, removals=1),
    "it is started again": Bounds(
        requests=1, ends=1, errors=True, restart=RestartSpec("on-failure", at_most=1, again_s=60.0)
    ),
    "guarded, its permit lapses": Bounds(guarded=True, requests=1, lapses=2),
    "guarded, it moves": Bounds(guarded=True, moves=1),
    "its place goes with it": Bounds(moves=1, requests=1, visits=1, configured=False),
}
NEVER: dict[State, set[Standing]] = {
    State.STARTING: {Standing.NONE, Standing.HEIR, Standing.YIELDED, Standing.RELEASED},
    State.RUNNING: {Standing.NONE, Standing.HEIR, Standing.YIELDED, Standing.RELEASED},
    State.REFUSED: {Standing.YIELDED},
}
"""The standings in which no history finds a task that is in a state: its actor begins and runs only if it owns it."""
BROKEN: dict[str, tuple[str, str, str]] = {
    "a task that has left goes on": (
        "it moves, and is stopped",
        "        step.live(lifecycle.StopAsked(reason=reason))\n    if record.in_doubt:",
        "        pass\n    if record.in_doubt:",
    ),
    "an offer is never taken back": (
        "it moves, and is stopped",
        "        step.do(After(wait_s, GiveUpDue(",
        "        (After(wait_s, GiveUpDue(",
    ),
    "an actor that is paused for nothing is left so": (
        "it moves, and is stopped",
        '        _freeze_failed(step, FreezeFailed("it may not act now"))\n        step.do(LetGoOn())',
        '        _freeze_failed(step, FreezeFailed("it may not act now"))',
    ),
    "a start does not wait for the writes before it": (
        "two requests",
        "        step.change(asks=effect.again)  # what is being written may have a later state",
        "        pass",
    ),
    "a stop is answered before it is written": (
        "two requests",
        "        step.change(rests=True, rests_left=step.course.rests_left + 1)\n",
        "        step.live(lifecycle.Written())\n",
    ),
    "a place is cleared before a stop is answered": (
        "its place goes with it",
        "step.life.at_rest and not step.course.rests:",
        "step.life.at_rest:",
    ),
    "a task that another agent owns too goes on": (
        "another agent owns it too",
        "        step.live(lifecycle.StopAsked(reason=reason))\n        if life.state is State.REFUSED:",
        "        if life.state is State.REFUSED:",
    ),
}
"""Broken variants of the join: the walk that convicts each, a text of it, and the text in its place."""


def test_walk_keeps_promises_in_small_worlds() -> None:
    met: Counter[tuple[State | None, Standing]] = Counter()

    def walk(name: str) -> None:
        nonlocal met
        found = Joined(SMALL[name]).run()
        assert not found.violation, f"{found.violation}, after: {', '.join(found.history)}"
        met += found.met

    for_each(SMALL, walk)
    assert len(met) > 25
    assert not [(state, it) for state, standings in NEVER.items() for it in standings if (state, it) in met]


@pytest.mark.parametrize("name", BROKEN)
def test_walk_convicts_a_broken_join(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    walk, *texts = BROKEN[name]
    variant: ModuleType = edited(reconcile, name, (texts[0], texts[1]))
    for table in ("RULES", "OF_LIFE", "OUTCOMES"):
        # By the product's own classes.
        rules = {key: getattr(variant, rule.__name__, rule) for key, rule in getattr(reconcile, table).items()}
        vars(variant)[table] = rules
        monkeypatch.setattr(reconcile, table, rules)
    for rule in [it for it in vars(variant).values() if isinstance(it, FunctionType)]:
        monkeypatch.setattr(reconcile, rule.__name__, rule)
    assert Joined(SMALL[walk]).run().violation not in ("", "unfinished")


def test_walk_that_is_cut_short_says_so() -> None:
    assert Joined(SMALL["it goes, and comes back"], limit=50).run().violation == "unfinished"
