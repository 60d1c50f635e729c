"""Whether a task begins on its birthplace, which knows nothing of it: where a disk was lost, it is elsewhere. Pure."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from enum import Enum
from typing import Final

import msgspec

from pancakes.mesh.migration.knowledge import TaskFact

DEFAULT_WAIT_S: Final = 10.0
"""So long the birth of a task waits for agents that have not said what they know of it, in host seconds."""


class Verdict(Enum):
    """What becomes of a birth."""

    BORN = "born"
    """All that were to be asked know nothing of the task."""
    UNASKED = "unasked"
    """It begins although some have not said what they know."""
    WAITS = "waits"
    """Some have not said what they know."""
    RESTS = "rests"
    """It was born before: a person decides."""


class BirthFacts(msgspec.Struct, frozen=True):
    """What is to be known before a task is born.

    Attributes:
        named: the agents that are to be asked, by name; one that was never met, by its address.
        said: the agents that have said what they know.
        known: what they know, and what the own disk says of the task under another name of this agent.
        guardians: of a guarded task, the guardians that its configuration names; None: it is not guarded.
        over: whether the time that it waits is over.
    """

    named: Sequence[str] = ()
    said: Collection[str] = ()
    known: Sequence[TaskFact] = ()
    guardians: Sequence[str] | None = None
    over: bool = False


class Birth(msgspec.Struct, frozen=True):
    """What becomes of a birth, and why.

    Attributes:
        verdict: what becomes of it.
        missing: the agents that have not said what they know.
        fact: the newest that is known of the task; None: nothing.
    """

    verdict: Verdict
    missing: tuple[str, ...] = ()
    fact: TaskFact | None = None


def birth_of(facts: BirthFacts) -> Birth:
    """Decides whether a task begins."""
    missing = tuple(name for name in facts.named if name not in facts.said)
    if facts.known:
        return Birth(Verdict.RESTS, missing, max(facts.known, key=lambda fact: fact.epoch))
    if not missing:
        return Birth(Verdict.BORN)
    enough = facts.guardians is None or _most(facts.guardians, facts.said)
    return Birth(Verdict.UNASKED if facts.over and enough else Verdict.WAITS, missing)


def _most(guardians: Sequence[str], said: Collection[str]) -> bool:
    return 2 * sum(name in said for name in guardians) > len(guardians)
