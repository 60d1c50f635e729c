"""What two agents say to each other while a task moves between them.

Each is the body of a packet on `network`: those of the bidding from one agent's `network/TaskMigrator` to the
other's, those of the hand-off from the service that hosts the task to the one of the same name. The network
may lose, double, reorder and delay them: the hand-off's core expects that.

`journal` is the id of the receiver's journal as the sender knows it when it writes the message. An agent
whose disk was lost has a new id, and so does not believe what was meant for its former self. The core
leaves it empty; `addressed` fills it in on the way out, and `is_for` checks it on the way in.
"""

from __future__ import annotations

from typing import Protocol, TypeVar

import msgspec
from msgspec.structs import replace

from pancakes.mesh.migration.cost import CostChoice
from pancakes.mesh.migration.epoch import NO_EPOCH, Epoch
from pancakes.mesh.migration.guards import NO_GUARDS, Guards
from pancakes.mesh.migration.record import TaskId
from pancakes.packet import packet_type


@packet_type("migration.solicit")
class Solicit(msgspec.Struct, frozen=True):
    """Asks a neighbour whether it would take a task, and at what cost.

    Attributes:
        task_id: the task.
        ask: number of this asking at the source; the answer repeats it.
        type: entry point name of the task's class.
        version: version of the distribution that it comes from.
        service: name of the service that looks after it, here and there.
        requires: the device types that it depends on.
        cost: name of the cost function to use, or the weight of each of several.
        moves_on_below: battery level below which the task would have to move on at once; None where it has
            no such rule.
        offer: what bidders are told of the task (`Snapshot.offer`), where the cost function is none of the core's.
        journal: see the module's text.
    """

    task_id: TaskId
    ask: int
    type: str
    version: str
    service: str
    requires: tuple[str, ...] = ()
    cost: CostChoice = "tasks"
    moves_on_below: float | None = None
    offer: bytes = b""
    journal: str = ""


@packet_type("migration.bid")
class Bid(msgspec.Struct, frozen=True):
    """Offers to take a task.

    Attributes:
        cost: what it would cost; the cheapest wins.
        terms: what the cost is made of.
    """

    task_id: TaskId
    ask: int
    cost: float
    terms: dict[str, float]
    journal: str = ""


@packet_type("migration.refuse")
class Refuse(msgspec.Struct, frozen=True):
    """Declines to take a task; the reason is for people."""

    task_id: TaskId
    ask: int
    reason: str
    journal: str = ""


@packet_type("migration.reserve")
class Reserve(msgspec.Struct, frozen=True):
    """Tells the winner; it checks again whether it can, and keeps a slot for a few seconds.

    Attributes:
        request: what was solicited, so that the winner needs no memory of having bid.
    """

    task_id: TaskId
    offer: Epoch
    request: Solicit
    journal: str = ""


@packet_type("migration.reserved")
class Reserved(msgspec.Struct, frozen=True):
    """Says that a slot is kept for the task."""

    task_id: TaskId
    offer: Epoch
    journal: str = ""


@packet_type("migration.transfer")
class Piece(msgspec.Struct, frozen=True):
    """A part of a snapshot on its way (see `pieces`).

    Attributes:
        index: which part it is, from 0.
        count: how many there are.
        size_bytes: length of the whole.
        digest: SHA-256 of the whole.
        data: the part's bytes.
    """

    task_id: TaskId
    offer: Epoch
    index: int
    count: int
    size_bytes: int
    digest: bytes
    data: bytes
    journal: str = ""


@packet_type("migration.nak")
class Nak(msgspec.Struct, frozen=True):
    """Declines a reservation or a snapshot; the task stays with its source."""

    task_id: TaskId
    offer: Epoch
    reason: str
    journal: str = ""


@packet_type("migration.prepared")
class Prepared(msgspec.Struct, frozen=True):
    """Says that the snapshot is on the destination's disk, dormant."""

    task_id: TaskId
    offer: Epoch
    journal: str = ""


@packet_type("migration.commit")
class Commit(msgspec.Struct, frozen=True):
    """Gives the task away. The source never takes it back after this.

    Attributes:
        guards: the guardians of a guarded task: the receiver asks them for their pledges before it owns the task.
        yields: of a guarded task: the epoch under which the source had it.
        no: of a guarded task: the number of the checkpoint that was sent.
    """

    task_id: TaskId
    offer: Epoch
    guards: Guards = NO_GUARDS
    yields: Epoch = NO_EPOCH
    no: int = 0
    journal: str = ""


@packet_type("migration.activated")
class Activated(msgspec.Struct, frozen=True):
    """Says that the destination owns the task, on disk."""

    task_id: TaskId
    offer: Epoch
    journal: str = ""


@packet_type("migration.abort")
class Abort(msgspec.Struct, frozen=True):
    """Takes an offer back that was never committed."""

    task_id: TaskId
    offer: Epoch
    journal: str = ""


@packet_type("migration.unknown")
class Unknown(msgspec.Struct, frozen=True):
    """Says that the sender has no memory of an offer that it must have known: its disk was lost."""

    task_id: TaskId
    offer: Epoch
    journal: str = ""


class Transfer(msgspec.Struct, frozen=True):
    """A whole snapshot on its way. It travels as `Piece`s and is put together again by an `Assembly`.

    Attributes:
        snapshot: the encoded snapshot.
    """

    task_id: TaskId
    offer: Epoch
    snapshot: bytes


Message = Solicit | Bid | Refuse | Reserve | Reserved | Piece | Nak | Prepared | Commit | Activated | Abort | Unknown
"""What travels."""

HandOffMessage = Reserve | Reserved | Transfer | Nak | Prepared | Commit | Activated | Abort | Unknown
"""What the hand-off's core sends and receives; each has a `task_id`."""

_M = TypeVar("_M", bound=msgspec.Struct)


class ForJournal(Protocol):
    """A message that is meant for an agent with one journal, and none that it had before."""

    @property
    def journal(self) -> str: ...


def addressed(message: _M, journal: str) -> _M:
    """Returns the message, meant for the agent whose journal has the id `journal`."""
    return replace(message, journal=journal)


def is_for(message: ForJournal, journal: str) -> bool:
    """Returns whether the agent whose journal has the id `journal` may believe the message."""
    return message.journal == journal
