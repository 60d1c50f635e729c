"""What agents say that they own, so that two owners of one task are noticed. Pure."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Final

import msgspec

from pancakes.mesh.migration.epoch import Epoch
from pancakes.mesh.migration.record import Phase, Record, TaskId
from pancakes.packet import packet_type

IN_ONE_PACKET: Final = 256
"""So many claims are told at once."""
MOST: Final = 4096
"""The claims on so many tasks are remembered; of more, the one that was heard first is forgotten."""


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

    claims: tuple[OwnerClaim, ...]


def claims_of(records: Iterable[Record]) -> list[OwnerClaim]:
    """Returns what an agent with these records owns."""
    ours = (Phase.OWNER, Phase.FROZEN)
    return [OwnerClaim(record.task_id, record.epoch) for record in records if record.phase in ours]


def in_packets(claims: list[OwnerClaim]) -> Iterator[Owned]:
    """Yields the bodies of the packets that tell of claims."""
    for first in range(0, len(claims), IN_ONE_PACKET):
        yield Owned(tuple(claims[first : first + IN_ONE_PACKET]))


class Claims:
    """The highest claim of other agents on each task.

    A claim does not grow false: an agent that owns the task later owns it under a higher epoch.
    """

    def __init__(self) -> None:
        self._highest: dict[TaskId, tuple[str, OwnerClaim]] = {}

    def heard(self, peer: str, claim: OwnerClaim) -> None:
        """Learns of a claim."""
        known = self._highest.get(claim.task_id)
        if known is None or known[1].epoch <= claim.epoch:
            self._highest[claim.task_id] = peer, claim
        if len(self._highest) > MOST:
            del self._highest[next(iter(self._highest))]

    def of(self, task_id: TaskId) -> tuple[str, OwnerClaim] | None:
        """Returns the claim on a task and the agent that made it; None: there is none."""
        return self._highest.get(task_id)

    def by_peer(self) -> dict[str, dict[TaskId, OwnerClaim]]:
        """Returns all of them, by the agent that made them."""
        found: dict[str, dict[TaskId, OwnerClaim]] = {}
        for task_id, (peer, claim) in self._highest.items():
            found.setdefault(peer, {})[task_id] = claim
        return found
