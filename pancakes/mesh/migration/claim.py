"""What agents say that they own, so that two owners of one task are noticed. Pure."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Annotated, Final

import msgspec

from pancakes.mesh.migration.epoch import Epoch
from pancakes.mesh.migration.record import Phase, Record, TaskId
from pancakes.packet import packet_type

IN_ONE_PACKET: Final = 256
"""So many claims are told at once."""
MOST: Final = 4096
"""So many claims of one agent are remembered; of more, the one that was heard first is forgotten."""
MOST_AGENTS: Final = 1024
"""Of so many agents they are; of more, the one that has said nothing for longest is forgotten."""


class OwnerClaim(msgspec.Struct, frozen=True):
    """An agent owns a task.

    Attributes:
        task_id: the task.
        epoch: under which epoch.
    """

    task_id: TaskId
    epoch: Epoch


@packet_type("task.owned")
class Owned(msgspec.Struct, frozen=True):
    """Tells the census of another agent what this one owns: all when a link comes up, and what is new after that.

    Attributes:
        claims: the tasks.
    """

    claims: Annotated[tuple[OwnerClaim, ...], msgspec.Meta(max_length=IN_ONE_PACKET)]


def claims_of(records: Iterable[Record]) -> list[OwnerClaim]:
    """Returns what an agent with these records owns."""
    ours = (Phase.OWNER, Phase.FROZEN)
    return [OwnerClaim(record.task_id, record.epoch) for record in records if record.phase in ours]


def in_packets(claims: list[OwnerClaim]) -> Iterator[Owned]:
    """Yields the bodies of the packets that tell of claims."""
    for first in range(0, len(claims), IN_ONE_PACKET):
        yield Owned(tuple(claims[first : first + IN_ONE_PACKET]))


class Claims:
    """What other agents claim: of each, its highest claim on each task.

    A claim does not grow false: an agent that owns the task later owns it under a higher epoch.
    """

    def __init__(self) -> None:
        self._of: dict[str, dict[TaskId, OwnerClaim]] = {}  # by the agent, the one heard last at the end

    def heard(self, peer: str, claim: OwnerClaim) -> None:
        """Learns of a claim."""
        theirs = self._of[peer] = self._of.pop(peer, {})
        known = theirs.get(claim.task_id)
        if known is None or known.epoch <= claim.epoch:
            theirs[claim.task_id] = claim
        if len(theirs) > MOST:
            del theirs[next(iter(theirs))]
        if len(self._of) > MOST_AGENTS:
            del self._of[next(iter(self._of))]

    def of(self, task_id: TaskId) -> tuple[str, OwnerClaim] | None:
        """Returns the highest claim on a task, of equal ones the latest, and the agent that made it; None: none."""
        found = [(peer, theirs[task_id]) for peer, theirs in self._of.items() if task_id in theirs]
        return max(reversed(found), key=lambda it: it[1].epoch, default=None)

    def by_peer(self) -> dict[str, dict[TaskId, OwnerClaim]]:
        """Returns the highest claim on each task, by the agent that made it."""
        found: dict[str, dict[TaskId, OwnerClaim]] = {}
        for task_id in {task_id: None for theirs in self._of.values() for task_id in theirs}:
            if (highest := self.of(task_id)) is not None:
                found.setdefault(highest[0], {})[task_id] = highest[1]
        return found
