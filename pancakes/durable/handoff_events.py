"""The events that go into the hand-off's core, and the effects that come out. Pure.

Effects are carried out strictly in the order listed, and a crash may fall between any two: the promises of the
protocol rest on that order. Timers are events that the core itself has put off (`After`). Each names its offer, so a
timer that fires late, twice or never does no harm, and none has to be cancelled.
"""

from __future__ import annotations

import random
from typing import NamedTuple

import msgspec

from pancakes.control import Refusal
from pancakes.durable.messages import Commit, HandOffMessage, Solicit
from pancakes.durable.record import NO_EPOCH, Epoch, GuardianId, Guards, Phase, Record, Volatile, Wanted


class Times(msgspec.Struct, frozen=True):
    """How long each step of a hand-off may take, and how often it is repeated.

    No safety hangs on any of them: a timer may fire at any time, early, late or never.

    Attributes:
        bid_window_s: how long a source waits for other answers to its SOLICIT where a neighbour has bid.
        patience_s: how long it waits where none has: a neighbour may import the task's class first.
        reserve_s: how long it waits for RESERVED before it asks the next bidder.
        slot_s: how long a destination keeps the slot of a reservation.
        prepare_s: how long a source waits, frozen, for PREPARED; the transfer's own time is added.
        rate_bytes_per_s: the slowest transfer that is waited for.
        resend_s: the first pause before a message is sent again.
        spread: each pause is drawn from `1 - spread` to `1 + spread` times its length.
        back_off_s: the longest pause of what never times out.
        warn_s: after this time in doubt a person is told.
        retry_write_s: how long after a failed write to the journal a frozen source tries again.
    """

    bid_window_s: float = 0.5
    patience_s: float = 8.0
    reserve_s: float = 1.0
    slot_s: float = 5.0
    prepare_s: float = 2.0
    rate_bytes_per_s: float = 1024.0 * 1024.0
    resend_s: float = 0.2
    spread: float = 0.5
    back_off_s: float = 5.0
    warn_s: float = 5.0
    retry_write_s: float = 1.0

    def transfer_s(self, size_bytes: int) -> float:
        """Returns how long a snapshot may be on its way."""
        return size_bytes / self.rate_bytes_per_s

    def pause_s(self, attempt: int) -> float:
        """Returns the pause after the sending number `attempt` (from 0) of what never times out."""
        # 2 ** 30 times the first pause is beyond any `back_off_s`, and cannot overflow.
        return min(self.resend_s * 2.0 ** min(attempt, 30), self.back_off_s)


class PacketId(NamedTuple):
    """Names a packet that its sender keeps until it is acknowledged: its stream, and its number there."""

    stream: str
    seq: int


# What the agent's own services say.


class Born(msgspec.Struct, frozen=True):
    """The task is started for the first time in its life, on its birthplace.

    Attributes:
        snapshot: how it is to begin, encoded.
        guardian: of a guarded task: this agent as a guardian, its first one; None: it is not guarded.
    """

    snapshot: bytes
    guardian: GuardianId | None = None


class RunAsked(msgspec.Struct, frozen=True):
    """The task is to run: it is asked for, or its service starts it again after a failure.

    Attributes:
        again: a restart by its service; the actor that ran before is gone.
    """

    again: bool = False


class Ended(msgspec.Struct, frozen=True):
    """The task's actor has ended for good: stopped because that was asked for, or given up on; or never began.

    Attributes:
        wanted: what is wanted of it from now on, STOPPED or FAILED; RUNNING where only its start was refused.
        snapshot: what it was at the end, encoded; empty where it could not say (the checkpoint stands then).
    """

    wanted: Wanted
    snapshot: bytes = b""


class Checkpoint(msgspec.Struct, frozen=True):
    """The running task has been written down.

    Attributes:
        epoch: the epoch that it runs under.
        incarnation: which start of it under that epoch this is.
        snapshot: what it is, encoded.
        consumed: the packets that this snapshot contains the effects of, and that wait to be acknowledged.
    """

    epoch: Epoch
    incarnation: int
    snapshot: bytes
    consumed: tuple[PacketId, ...] = ()


class Arrived(msgspec.Struct, frozen=True):
    """A packet addressed to the task has come to this agent."""


class AdoptionAsked(msgspec.Struct, frozen=True):
    """A person says that the other side is gone for good, and that the task shall run here after all.

    The one event that can make two of a task, namely where that person is wrong. Of a task that two agents own, it says
    that the one here lives.

    Attributes:
        snapshot: where the agent that owned the task is lost, or this one has lost its record of it, or was told to
            forget it: how the task is to begin, encoded; empty: as the snapshot says that is here.
        seen: the highest number of an epoch that is known of the task besides the record.
        jump: by how much the new epoch is to be higher than all that is known.
        guardian: as in `Born`.
    """

    snapshot: bytes = b""
    seen: int = 0
    jump: int = 1
    guardian: GuardianId | None = None


class ForgettingAsked(msgspec.Struct, frozen=True):
    """A person says that the task is not to run here.

    This agent has lost its record, another owns it too, or another has brought it and is gone.

    Attributes:
        seen: the highest epoch that is known of it.
        owner: the agent that is to have it; empty: that is not known.
        offer: of the hand-off in doubt that is to be dropped; `NO_EPOCH`: none is.
    """

    seen: Epoch
    owner: str = ""
    offer: Epoch = NO_EPOCH


class RemovalAsked(msgspec.Struct, frozen=True):
    """A task that no configuration file names is to be nowhere from now on; it stands still already."""


class ClaimHeard(msgspec.Struct, frozen=True):
    """Another agent says that it owns the task, or the guardians of the task follow another owner.

    Attributes:
        peer: that agent; empty: the guardians follow an epoch of this agent's own, under which it never owned the task.
        epoch: the epoch under which it owns it.
    """

    peer: str
    epoch: Epoch


# What its guardians make of a guarded task (docs/protocol.md, guardians).


class PermitGiven(msgspec.Struct, frozen=True):
    """More than half of the guardians have granted the owner a lease: the task may act from now on."""


class GuardsChosen(msgspec.Struct, frozen=True):
    """The task is to have other guardians.

    Attributes:
        sets: as in `Guards`.
        jump: where a person says that more than half of the guardians are gone for good: by how much the new epoch is
            to be higher than all that is known; 0: the epoch stays, and the guardians are asked.
        seen: as in `AdoptionAsked`.
    """

    sets: tuple[tuple[GuardianId, ...], ...]
    jump: int = 0
    seen: int = 0


class Seized(msgspec.Struct, frozen=True):
    """More than half of the guardians have pledged themselves to this agent: it owns the task from now on.

    Attributes:
        epoch: the epoch that they have pledged themselves to, of this agent's making.
        guards: the newest guards that any of them knows.
        snapshot: the newest checkpoint that any of them has.
        wanted: what that checkpoint says is wanted of the task.
        source: the agent that gives the task away; empty: the task was taken over.
        offer: of that hand-off.
    """

    epoch: Epoch
    guards: Guards
    snapshot: bytes
    wanted: Wanted
    source: str
    offer: Epoch


class PersistFailed(msgspec.Struct, frozen=True):
    """The journal could not write the record. Nothing that was to follow has happened.

    Attributes:
        reason: what the operating system said.
        record: what should have been written.
    """

    reason: str
    record: Record


class WriteAgain(msgspec.Struct, frozen=True):
    """Time to try a write again that failed, of a task that does not run here.

    Attributes:
        old: the record that was to be replaced; where another has come since, or the task runs, nothing is done.
        record: what should have been written.
    """

    old: Record
    record: Record


# The source's side of a hand-off.


class Award(msgspec.Struct, frozen=True):
    """The bids are compared, and `peer` is next.

    Attributes:
        peer: the agent to ask for a reservation.
        request: what it bid on.
    """

    peer: str
    request: Solicit


class Frozen(msgspec.Struct, frozen=True):
    """The task has stopped at a tick boundary, and its actuators are in their safe hold.

    Attributes:
        offer: the hand-off that it was stopped for.
        snapshot: what it is, encoded.
        sequel: what is to be done here once it has gone, an encoded `Sequel`.
    """

    offer: Epoch
    snapshot: bytes
    sequel: bytes = b""


class FreezeFailed(msgspec.Struct, frozen=True):
    """The task could not be stopped or written down; it goes on (or its service restarts it).

    Attributes:
        offer: the hand-off that it should have been stopped for.
        reason: why not.
    """

    offer: Epoch
    reason: str


class Concluded(msgspec.Struct, frozen=True):
    """What was to follow the hand-over has been done."""


# Messages and timers.


class Received(msgspec.Struct, frozen=True):
    """A message came from another agent.

    Attributes:
        peer: the agent that sent it.
        message: what it says; a snapshot is whole.
        refusal: why this agent cannot do what a RESERVE or a TRANSFER asks of it, found out before the core
            is asked: the host lacks something, or the object could not be built. None if it can.
    """

    peer: str
    message: HandOffMessage
    refusal: Refusal | None = None


class ReservationExpired(msgspec.Struct, frozen=True):
    """`peer` was asked for a reservation, long ago."""

    peer: str
    offer: Epoch


class GiveUp(msgspec.Struct, frozen=True):
    """A frozen task has waited long enough for its destination, or the link to it is gone.

    Attributes:
        reason: for the ledger.
    """

    offer: Epoch
    reason: str


class Resend(msgspec.Struct, frozen=True):
    """Time to say it again.

    Attributes:
        offer: the hand-off that it belongs to.
        phase: the phase that it belongs to.
        attempt: how often it was said, less one.
    """

    offer: Epoch
    phase: Phase
    attempt: int


class InDoubt(msgspec.Struct, frozen=True):
    """A hand-off has stood undecided for so long that a person should know."""

    offer: Epoch
    phase: Phase


Event = (
    Born
    | RunAsked
    | Ended
    | Checkpoint
    | Arrived
    | AdoptionAsked
    | ForgettingAsked
    | RemovalAsked
    | ClaimHeard
    | PermitGiven
    | GuardsChosen
    | Seized
    | PersistFailed
    | WriteAgain
    | Award
    | Frozen
    | FreezeFailed
    | Concluded
    | Received
    | ReservationExpired
    | GiveUp
    | Resend
    | InDoubt
)


class Persist(msgspec.Struct, frozen=True):
    """Put the record on disk. What follows waits until it is there for good."""

    record: Record


class Remember(msgspec.Struct, frozen=True):
    """Replace the volatile part."""

    volatile: Volatile


class Send(msgspec.Struct, frozen=True):
    """Send a message. It may be lost."""

    peer: str
    message: HandOffMessage


class StartTask(msgspec.Struct, frozen=True):
    """Start the task from a snapshot, and raise the fence to its epoch.

    What follows waits until its first handler has run or its start has failed; a failed start is its
    service's to repeat, the ownership stands. An actor of the task that is still there is ended first.

    Attributes:
        epoch: the right under which it runs.
        incarnation: which start under that epoch this is; its checkpoints say it.
        snapshot: what it begins from, encoded.
        fresh: whether it goes on exactly where it stood still on its former host: nothing of it has run since.
    """

    epoch: Epoch
    incarnation: int
    snapshot: bytes
    fresh: bool = False


class Freeze(msgspec.Struct, frozen=True):
    """Stop the task at a tick boundary and bring its actuators to their safe hold.

    To be answered, once, by `Frozen` with what it then is, or by `FreezeFailed`. The actor is kept as it is
    for a `Resume`; packets that come for it wait.
    """

    offer: Epoch


class Resume(msgspec.Struct, frozen=True):
    """Let the frozen task go on as it stands, under the right it had; where its actor is gone, from the snapshot.

    Attributes: as in `StartTask`.
    """

    epoch: Epoch
    incarnation: int
    snapshot: bytes


class Seize(msgspec.Struct, frozen=True):
    """Ask the guardians of a task for their pledges, which its owner has given away; see `Seized`.

    Attributes:
        source: the agent that gives it away.
        commit: what that agent says.
    """

    source: str
    commit: Commit


class LookForOwner(msgspec.Struct, frozen=True):
    """Look whether another agent owns a guarded task that was offered to this one; see `ClaimHeard`."""


class GiveWay(msgspec.Struct, frozen=True):
    """Stop the task for good: another agent owns it too.

    Attributes:
        reason: why, as a sentence.
    """

    reason: str


class Discard(msgspec.Struct, frozen=True):
    """Let go of the object that stands still here: a frozen task that was given away, or a dormant one."""


class Ack(msgspec.Struct, frozen=True):
    """Tell the sender of a packet that its effect is on disk."""

    packet: PacketId


class Deliver(msgspec.Struct, frozen=True):
    """Give the packet that has arrived to the task, which runs here."""


class Forward(msgspec.Struct, frozen=True):
    """Send the packet that has arrived on to where its task went, and tell its sender so.

    Attributes:
        peer: the agent to which the task was handed over.
        epoch: the highest epoch that this agent knows of; a later one is fresher news.
    """

    peer: str
    epoch: Epoch


class After(msgspec.Struct, frozen=True):
    """Feed `event` to the core in `delay_s` seconds of host time.

    Attributes:
        delay_s: the middle of the delay.
        event: what to feed.
        spread: the delay is drawn from `1 - spread` to `1 + spread` times `delay_s`, so that agents that
            were cut off together do not speak all at once when the network heals.
    """

    delay_s: float
    event: Event
    spread: float = 0.0

    def drawn_s(self, source: random.Random) -> float:
        """Returns the delay, drawn with a source of random numbers."""
        if not self.spread:
            return self.delay_s
        return self.delay_s * source.uniform(1.0 - self.spread, 1.0 + self.spread)


class Warn(msgspec.Struct, frozen=True):
    """Tell people, on `log`."""

    text: str


class Decline(msgspec.Struct, frozen=True):
    """Refuse what an event of this agent's own services asked for; nothing has changed.

    Attributes:
        reason: a sentence for the asker.
    """

    reason: str


class AttemptFailed(msgspec.Struct, frozen=True):
    """The hand-off to `peer` came to nothing, and the task goes on here: the next bidder may be tried.

    Attributes:
        refusal: why, for the ledger: what the peer answered, or what happened here.
    """

    peer: str
    refusal: Refusal


class HandedOver(msgspec.Struct, frozen=True):
    """`peer` owns the task, and has said so: what is to follow, as the record's sequel says, may be done now.

    It comes again after a restart of the agent, until `Concluded` says that all of it was done.

    Attributes:
        epoch: the epoch that it runs under there.
    """

    peer: str
    epoch: Epoch


OfHost = Send | Seize | LookForOwner | Ack | After | Warn | AttemptFailed
"""What the host of a task does, whatever the task itself does meanwhile."""

OfLife = Persist | Remember | StartTask | Freeze | Resume | GiveWay | Discard | Decline | HandedOver
"""What means something for the life of the task, or waits for it."""

OfPackets = Deliver | Forward
"""What becomes of a packet for the task."""

Effect = OfHost | OfLife | OfPackets
