"""What the hand-off's core asks for. Effects are carried out strictly in the order listed.

A crash may fall between any two of them: the order is what the protocol's promises rest on.
"""

from __future__ import annotations

import random

import msgspec

from pancakes.mesh.migration.epoch import Epoch
from pancakes.mesh.migration.event import Event, PacketId
from pancakes.mesh.migration.messages import Commit, HandOffMessage
from pancakes.mesh.migration.record import Record
from pancakes.mesh.migration.volatile import Volatile


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
        reason: for the ledger.
    """

    peer: str
    reason: str


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
