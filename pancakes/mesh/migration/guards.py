"""The guardians of a task: a few agents that together remember which agent may run it. Pure."""

from __future__ import annotations

from collections.abc import Collection
from itertools import chain
from typing import Annotated, Final, NamedTuple

import msgspec

from pancakes.mesh.migration.epoch import NO_EPOCH, AgentName, Epoch

MOST_GUARDIANS: Final = 5
"""So many guardians a set has at most: more are slower, and survive nothing that is likely."""


class GuardianId(NamedTuple):
    """A guardian. An agent whose disk was lost, or is a copy, has forgotten pledges, and so is another guardian.

    Attributes:
        agent: the agent's name.
        journal: the id of its journal.
        copy: which copy of that journal it has; empty: the original.
    """

    agent: AgentName
    journal: Annotated[str, msgspec.Meta(max_length=64)]
    copy: Annotated[str, msgspec.Meta(max_length=64)] = ""


GuardianSet = Annotated[tuple[GuardianId, ...], msgspec.Meta(min_length=1, max_length=MOST_GUARDIANS)]


class Guards(msgspec.Struct, frozen=True):
    """The guardians of a task, as its owner has chosen them.

    Attributes:
        epoch: the epoch of the owner that wrote this.
        version: how often that owner has changed them.
        sets: one set of guardians; two, while the second takes over from the first; none: the task is not guarded.
    """

    epoch: Epoch = NO_EPOCH
    version: Annotated[int, msgspec.Meta(ge=0)] = 0
    sets: Annotated[tuple[GuardianSet, ...], msgspec.Meta(max_length=2)] = ()

    def has_quorum(self, members: Collection[GuardianId]) -> bool:
        """Returns whether these are more than half of each set."""
        return bool(self.sets) and all(2 * sum(it in members for it in one) > len(one) for one in self.sets)

    @property
    def forgotten(self) -> bool:
        """Whether these are no guardians any more, as the task was removed."""
        return not self.sets and self.epoch != NO_EPOCH

    def members(self) -> list[GuardianId]:
        """Returns all guardians, each once."""
        return list(dict.fromkeys(chain.from_iterable(self.sets)))

    @property
    def stamp(self) -> tuple[Epoch, int]:
        """Orders the guards of one task: the later is the newer, and those of a later owner always are."""
        return self.epoch, self.version


NO_GUARDS: Final = Guards()
LAST_VERSION: Final = 2**53
"""Of the guards of a task that was removed: an owner changes them less often under one epoch."""


def forgotten_guards(epoch: Epoch) -> Guards:
    """Returns what its guardians are told of a task that was removed; `epoch`: of its last owner."""
    return Guards(epoch, LAST_VERSION)


def newest(*guards: Guards) -> Guards:
    """Returns the newest of several."""
    return max(guards, key=lambda one: one.stamp)
