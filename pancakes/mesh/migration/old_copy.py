"""What becomes of tasks on an agent whose disk is an old copy, as others say: they may be elsewhere by now. Pure."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from enum import Enum
from typing import Final

import msgspec

from pancakes.mesh.migration.epoch import Epoch
from pancakes.mesh.migration.knowledge import TaskFact

ENOUGH: Final = 2
"""So many agents must say so: one alone may have gone wrong. A quorum of guardians is never less."""


class CopyVerdict(Enum):
    """What becomes of a task."""

    GOES_ON = "goes on"
    """Too few say that the disk is an old copy; or those that say so know of no later owner."""
    WAITS = "waits"
    """It stands still until all that say so have told what they know of it."""
    ELSEWHERE = "elsewhere"
    """It went on after the copy was made: it stands still until a person decides."""


class CopiedTask(msgspec.Struct, frozen=True):
    """What becomes of a task, and why.

    Attributes:
        verdict: what becomes of it.
        missing: the agents that have still to tell what they know of it.
        fact: what tells of a later owner; None: nothing does.
    """

    verdict: CopyVerdict
    missing: tuple[str, ...] = ()
    fact: TaskFact | None = None


def copied_task(epoch: Epoch, sayers: Collection[str], told: Collection[str], known: Sequence[TaskFact]) -> CopiedTask:
    """Decides about a task that the disk says is owned here.

    Args:
        epoch: the epoch that the disk has.
        sayers: the agents that say that the disk is an old copy, and are believed.
        told: those that have told what they know of the task.
        known: what they know.
    """
    if len(sayers) < ENOUGH:
        return CopiedTask(CopyVerdict.GOES_ON)
    later = [fact for fact in known if fact.epoch > epoch]
    if later:
        return CopiedTask(CopyVerdict.ELSEWHERE, fact=max(later, key=lambda fact: fact.epoch))
    missing = tuple(sorted(set(sayers) - set(told)))
    return CopiedTask(CopyVerdict.WAITS if missing else CopyVerdict.GOES_ON, missing)
