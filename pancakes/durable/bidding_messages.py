"""Messages between the Task Migrator and the services and guardians of its agent: data.

They never leave the agent. The packets that agents exchange while they bid are in `messages`.
"""

from __future__ import annotations

from typing import Any, Final

import msgspec

from pancakes.control import Refusal
from pancakes.durable.messages import Solicit
from pancakes.durable.record import TaskId
from pancakes.durable.register import Identity
from pancakes.kernel.mailbox import Reference
from pancakes.migration import MigrationReport
from pancakes.supervision.lifecycle import Request

MIGRATOR: Final = "network/TaskMigrator"
"""Where on each agent the Task Migrator is."""

ALLOCATOR: Final = "Allocator"
"""The name of the task of the Network Service that holds the rounds of the team's allocation."""


class AllocationAsked(msgspec.Struct, frozen=True):
    """The Network Service hands on a request for a round; to be answered by `AllocationAnswered`.

    Attributes:
        service: the service.
        request: the request.
        dry_run: whether nothing is moved.
    """

    service: Reference
    request: Request
    dry_run: bool


class AllocationAnswered(msgspec.Struct, frozen=True):
    """The round that was asked for is over, or cannot be held.

    Attributes:
        request: the request.
        refusal: why it cannot be held; None: it was.
        result: its account, as plain values.
    """

    request: Request
    refusal: Refusal | None
    result: Any = None


# What a service tells the Task Migrator.


class Negotiate(msgspec.Struct, frozen=True):
    """Ask the neighbours which of them would take a task.

    Attributes:
        service: the service that owns it.
        request: what they are asked.
        asked_by: as in `MigrationReport`.
        to: the only neighbour to ask; empty: all.
        dry_run: whether nothing is moved.
        lost: the agent that had it and is silent: this agent may take it too; empty: this agent has it.
        cause: as in `MigrationReport`.
    """

    service: Reference
    request: Solicit
    asked_by: str
    to: str
    dry_run: bool
    lost: str = ""
    cause: str = ""


class AttemptOver(msgspec.Struct, frozen=True):
    """The migration to a bidder came to nothing: the next one's turn.

    Attributes:
        service: the service that owns the task.
        task_id: the task.
        peer: the bidder; empty: it cannot be handed over at all just now.
        refusal: why.
        ledger: the account, if the migrator does not know of the negotiation: the other bids are forgotten.
    """

    service: Reference
    task_id: TaskId
    peer: str
    refusal: Refusal
    ledger: MigrationReport | None


class HasMoved(msgspec.Struct, frozen=True):
    """The task has a new owner; to be answered by `MoveOver`.

    Attributes:
        service: the service that owned the task.
        task_id: the task.
        peer: the new owner.
        epoch: the epoch that it runs under there, as text.
        ledger: the account, if the migrator does not know of the negotiation.
        note: what had come between, in that case.
    """

    service: Reference
    task_id: TaskId
    peer: str
    epoch: str
    ledger: MigrationReport | None
    note: str


class MoverBegan(msgspec.Struct, frozen=True):
    """A service has started again, and its mover knows of no move that its predecessor asked for.

    Attributes:
        service: the service.
    """

    service: Reference


# What the Task Migrator tells a service.


class MigratorBegan(msgspec.Struct, frozen=True):
    """The migrator has started again and knows of no negotiation."""


class BidAwarded(msgspec.Struct, frozen=True):
    """The bids are compared: hand the task to this one.

    Attributes:
        task_id: the task.
        heir: the agent that made the lowest bid; it keeps room for the task, if its owner asked.
        ledger: the account so far.
    """

    task_id: TaskId
    heir: Identity
    ledger: MigrationReport

    @property
    def peer(self) -> str:
        """The name of that agent."""
        return self.heir.agent


class MoveOver(msgspec.Struct, frozen=True):
    """A move is over, one way or the other, and its account is kept.

    Attributes:
        task_id: the task.
        reason: why it came to nothing; empty: it has moved.
        result: the account, as plain values; None: it is lost.
    """

    task_id: TaskId
    reason: str
    result: Any
