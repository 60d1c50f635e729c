"""Searches the machine of a hosted task exhaustively: its life joined with its hand-off, within bounds.

The world is the place of one task on one agent: its life, its record in memory and on disk, its actor, the timers and
the requests. The other agent sends all that the protocol allows it to send, early, late, doubled or never. The answers
of the service come in the order in which it is asked, before anything else; writes, timers, messages and news of the
actor come in any order.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Mapping
from typing import Final

import msgspec
from model.hosting_promises import check
from model.hosting_rim import Rim, Step
from model.hosting_steps import Steps
from model.hosting_world import Bounds, Violation, World

from pancakes.durable.record import Phase
from pancakes.durable.state_machine import handle
from pancakes.supervision.lifecycle import State


class Result(msgspec.Struct, frozen=True):
    """What a search has found.

    Attributes:
        worlds: how many worlds there are.
        steps: how many steps were taken between them.
        met: in how many of them each state of a life goes together with each phase of a hand-off.
        violation: the promise that is broken; empty: none is.
        history: what leads to that.
    """

    worlds: int
    steps: int
    met: Counter[tuple[State | None, Phase]]
    violation: str = ""
    history: tuple[str, ...] = ()


MOST_WORLDS: Final = 20_000
"""A search that finds more is not bounded as it should be."""


def search(bounds: Bounds, machine: Step = handle, at_most: int = MOST_WORLDS) -> Result:
    """Searches all histories within bounds.

    Args:
        bounds: what may happen.
        machine: the machine, or a variant of it.
        at_most: that there are more worlds breaks a promise.
    """
    steps = Steps(Rim(machine, bounds), bounds)
    met: Counter[tuple[State | None, Phase]] = Counter()
    seen: dict[World, tuple[World | None, str]] = {}
    waiting: deque[World | None] = deque([None])
    taken = 0
    while waiting:
        world = waiting.popleft()
        steps.what = ""
        try:
            for what, following in steps.begin() if world is None else steps.after(world):
                taken += 1
                if following in seen:
                    continue
                seen[following] = (world, what)
                met[following.life.state if following.life is not None else None, following.standing.record.phase] += 1
                check(following)
                if len(seen) > at_most:
                    raise Violation("there is no end of worlds")
                waiting.append(following)
        except Violation as violation:
            last = [*history(seen, world), steps.what]
            return Result(len(seen), taken, met, str(violation), tuple(step for step in last if step))
    return Result(len(seen), taken, met)


def history(seen: Mapping[World, tuple[World | None, str]], world: World | None) -> list[str]:
    """Returns what has led to a world."""
    told: list[str] = []
    while world is not None:
        world, what = seen[world]
        told.append(what)
    return told[::-1]
