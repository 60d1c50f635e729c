"""Messages between the registrar and the services of its agent: data. They never leave the agent."""

from __future__ import annotations

from typing import Any

import msgspec

from pancakes.control import Refusal
from pancakes.durable.messages import Known
from pancakes.durable.reconcile import Outcome
from pancakes.durable.record import Record, TaskId
from pancakes.durable.register import Epoch
from pancakes.durable.rules import Desired
from pancakes.kernel.mailbox import Reference
from pancakes.migration import GuardRule

DEFAULT_WAIT_S = 10.0
"""The birth of a task waits this long for agents that have not said what they know of it, in host seconds."""

# What a service tells the registrar.


class HostBegan(msgspec.Struct, frozen=True):
    """A service that hosts tasks has begun: it is told how its tasks stand, and what other agents know."""

    service: Reference


class HostEnded(msgspec.Struct, frozen=True):
    """A service that hosts tasks has ended: none of its tasks acts any more.

    Attributes:
        service: its name.
        goodbye: whether the agent ends, so that others may take its guarded tasks at once.
    """

    service: str
    goodbye: bool


class Feed(msgspec.Struct, frozen=True):
    """An event for the rules of a task. What becomes of it is told by `Stands`, with its token.

    Attributes:
        task_id: the task.
        event: one of `pancakes.durable.rules`.
        token: names this event to its service.
        service: the service that looks after the task.
        epoch: the epoch under which the service takes the task to be owned: a state of an earlier one is not written.
        sequel: of an `Offer` or a `Want`: what follows once the task has gone, or is stopped, encoded.
        is_checkpoint: whether it is not written if the task may not act when its turn comes.
    """

    task_id: TaskId
    event: Any
    token: int
    service: str
    epoch: Epoch
    sequel: bytes = b""
    is_checkpoint: bool = False


class Guarded(msgspec.Struct, frozen=True):
    """How a task will be guarded from now on; None: it will not.

    Attributes:
        type: entry point name of its class.
        as_of_s: when the task was known last to be as its newest checkpoint says, in host time.
    """

    task_id: TaskId
    type: str
    rule: GuardRule | None
    as_of_s: float


class PermitOver(msgspec.Struct, frozen=True):
    """A task has found its permit over: its members are asked at once."""

    task_id: TaskId


class Concluded(msgspec.Struct, frozen=True):
    """What was to follow a migration is done."""

    task_id: TaskId


class CannotStart(msgspec.Struct, frozen=True):
    """A task is here, and cannot be started: if others guard it, one of them is to have it."""

    task_id: TaskId


class Judged(msgspec.Struct, frozen=True):
    """The answer to `Judge`.

    Attributes:
        number: that of the question.
        refusal: why the task cannot run here; None: it can.
    """

    number: int
    refusal: Refusal | None


class AskAbout(msgspec.Struct, frozen=True):
    """Have the registrar ask neighbours what they know of tasks; the answers come as `KnownCame`.

    Attributes:
        peers: the neighbours; empty: all of them.
        task_ids: the tasks.
    """

    peers: tuple[str, ...]
    task_ids: tuple[TaskId, ...]


# What the registrar tells a service.


class Stands(msgspec.Struct, frozen=True):
    """How a task stands with this agent, and what became of events.

    Attributes:
        task_id: the task.
        record: what is on disk.
        desired: what its actor is to do.
        outcomes: the tokens of events, what became of each, and why.
        taken_from: the agent that had the task, if this one has just taken it over; empty: it has not.
    """

    task_id: TaskId
    record: Record
    desired: Desired
    outcomes: tuple[tuple[int, Outcome, str], ...] = ()
    taken_from: str = ""


class RegistrarBegan(msgspec.Struct, frozen=True):
    """The registrar has started again after a failure: what was fed before and not answered is not known to it."""


class GoodbyeSaid(msgspec.Struct, frozen=True):
    """Members of all guarded tasks of the service were told that its agent ends: it may end."""


class Judge(msgspec.Struct, frozen=True):
    """Says whether a task that an agent offers can run here; to be answered by `Judged`.

    Attributes:
        number: of the question.
        peer: the agent that offers it.
        task_id: the task.
        state: the task, encoded.
    """

    number: int
    peer: str
    task_id: TaskId
    state: bytes


class OfferRefused(msgspec.Struct, frozen=True):
    """The heir declines what it was offered."""

    task_id: TaskId
    peer: str
    refusal: Refusal


class NeighbourCame(msgspec.Struct, frozen=True):
    """Another agent can be asked from now on."""

    peer: str


class KnownCame(msgspec.Struct, frozen=True):
    """Another agent says what it knows of tasks that it was asked about, or what it owns."""

    peer: str
    known: Known


class CopyNoticed(msgspec.Struct, frozen=True):
    """Another agent takes the disk of this one for an old copy."""

    peer: str


News = NeighbourCame | KnownCame | CopyNoticed
