"""What the registrar keeps of one task, and the events that it deals with."""

from __future__ import annotations

from collections import deque
from typing import Any

import msgspec

from pancakes.durable import messages
from pancakes.durable.deadlines import Deadline
from pancakes.durable.messages import CanGuard
from pancakes.durable.reconcile import Outcome
from pancakes.durable.record import Record
from pancakes.durable.register import BLANK, NOBODY, Epoch, Identity, Register, Stamp, Standing
from pancakes.durable.register_messages import Feed
from pancakes.durable.rules import Desired, Lease, Memory
from pancakes.kernel.permits import PermitEnd
from pancakes.kernel.timer import OneShot
from pancakes.migration import GuardRule
from pancakes.packet import Fence


class Conclude(msgspec.Struct, frozen=True):
    """An event of the registrar's own: what was to follow a migration is done."""


class SayAgain(msgspec.Struct, frozen=True):
    """An event of the registrar's own: it is time to say again what may have been lost."""


class Fed(msgspec.Struct, frozen=True):
    """An event of a task, and where it comes from.

    Attributes:
        event: the event.
        peer: the agent that it comes from; empty: this one.
        feed: what a service fed; None: it comes from elsewhere.
        accept: the packet with an `Accept`, which also says what task it is; None: it is none.
    """

    event: Any
    peer: str = ""
    feed: Feed | None = None
    accept: messages.Accept | None = None


class Held(msgspec.Struct):
    """What the owner of a task knows of its members until the next crash.

    Attributes:
        renewal: asks for leases again.
        end: the end of the permit.
        epoch: under which the task is owned.
        beat: the number of the newest request.
        lost_s: since when, in host time, it may not act.
        rule: how it is guarded; None: it is not.
        until: until when each request would let the task act, by beat.
        told: the write that members were told of last.
        sent: which state each member was sent last, and with which beat.
        has: the newest write that each member has said to have.
        heard_s: when each member has said something last, in host time.
        as_of_s: when the task was known last to be as each of the newest writes says, in host time, by number.
        answers: what neighbours have said that were asked whether they would guard it.
        asked_s: when they were asked last, in host time.
        thin: whether people were told that it has fewer members than it should.
        closed: whether its service has ended, so that no lease is asked for.
    """

    renewal: Deadline
    end: Deadline
    epoch: Epoch
    beat: int
    lost_s: float
    rule: GuardRule | None = None
    until: dict[int, PermitEnd] = {}
    told: Stamp | None = None
    sent: dict[Identity, tuple[int, int]] = {}
    has: dict[Identity, int] = {}
    heard_s: dict[Identity, float] = {}
    as_of_s: dict[int, float] = {}
    answers: dict[str, CanGuard] = {}
    asked_s: float = -1e9
    thin: bool = False
    closed: bool = False

    @property
    def number(self) -> int:
        """How many members the task is to have."""
        return self.rule.copies if self.rule is not None else 1


class Entry(msgspec.Struct):
    """What the registrar keeps of one task.

    Attributes:
        record: what is on disk.
        alarm: the end of the lease that is granted here.
        memory, lease: what is known until the next crash; see `rules`.
        service: the one that fed an event last, or is to run the task here; it may not be on disk yet.
        events: what is still to be dealt with.
        effects: what is still to be carried out of the event that is being dealt with.
        dealing: that event; None: none is.
        before: the memory as it was before that event.
        writing: what is being written; None: nothing is.
        again: what could not be written, and is tried again; None: nothing.
        waits: the events that are written and do not count yet: under which stamp, by token.
        outcomes: what became of events, which the service has still to be told.
        told: what the service was told last.
        held: of a task that this agent owns: what its members have said; None: it owns it not.
        former: the agent from which this one took the task last.
        attempt: how often something was said again.
        reminder: says it again; None: nothing needs to be said.
        reminded: what that timer is about.
        heard_s: when the owner was heard last, in host time.
        as_of_s: when the task was known last to be as its state here says, in host time.
        from_disk: whether the state is from before the registrar began, and so may be older than that.
        newest_told: the newest write that the owner has told of, also if there is no room for it here.
        called: the agent that was called to take the task; empty: none.
        counted: the newest own write that counts.
        taken_from: the agent from which this one has just taken it over; its service has still to be told.
    """

    record: Record
    alarm: Deadline
    memory: Memory = Memory()
    lease: Lease = Lease()
    service: str = ""
    events: deque[Fed] = msgspec.field(default_factory=deque)
    effects: deque[Any] = msgspec.field(default_factory=deque)
    dealing: Fed | None = None
    before: Memory = Memory()
    writing: Record | None = None
    again: Fed | None = None
    waits: list[tuple[Stamp, int]] = msgspec.field(default_factory=list)
    outcomes: list[tuple[int, Outcome, str]] = msgspec.field(default_factory=list)
    told: tuple[Record, Desired] | None = None
    held: Held | None = None
    former: Identity = NOBODY
    attempt: int = 0
    reminder: OneShot | None = None
    reminded: tuple[Standing, Stamp] | None = None
    heard_s: float = 0.0
    as_of_s: float = 0.0
    from_disk: bool = False
    newest_told: Stamp = BLANK.stamp
    called: str = ""
    counted: Stamp = BLANK.stamp
    taken_from: str = ""

    @property
    def register(self) -> Register:
        """What is on disk."""
        return self.record.register

    @property
    def idle(self) -> bool:
        """Whether every event is dealt with."""
        return self.writing is None and not self.events and not self.effects


def right_of(record: Record) -> Fence:
    """Return the right under which a task acts."""
    return Fence(str(record.task_id), (record.epoch.n, record.epoch.minter.agent))
