"""What can happen to a task that moves: the events that go into the hand-off's core.

Timers are events that the core itself has put off (see `effect.After`). They name the offer they belong
to, so that one that comes late, twice or never does no harm, and none has to be cancelled.
"""

from __future__ import annotations

from typing import NamedTuple

import msgspec

from pancakes.mesh.migration.epoch import NO_EPOCH, Epoch
from pancakes.mesh.migration.guards import GuardianId, Guards
from pancakes.mesh.migration.messages import HandOffMessage, Solicit
from pancakes.mesh.migration.record import Phase, Record, Wanted


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
            is asked: the host lacks something, or the object could not be built. Empty where it can.
    """

    peer: str
    message: HandOffMessage
    refusal: str = ""


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
