"""What the hand-off's core asks for. Effects are carried out strictly in the order listed.

A crash may fall between any two of them: the order is what the protocol's promises rest on.
"""

from __future__ import annotations

import random
from dataclasses import dataclass

from pancakes.migration.event import Event, PacketId
from pancakes.migration.messages import HandOffMessage
from pancakes.migration.record import Epoch, Record
from pancakes.migration.volatile import Volatile


@dataclass(frozen=True, slots=True)
class Persist:
    """Put the record on disk. What follows waits until it is there for good."""

    record: Record


@dataclass(frozen=True, slots=True)
class Remember:
    """Replace the volatile part."""

    volatile: Volatile


@dataclass(frozen=True, slots=True)
class Send:
    """Send a message. It may be lost."""

    peer: str
    message: HandOffMessage


@dataclass(frozen=True, slots=True)
class StartTask:
    """Start the task from a snapshot, and raise the fence to its epoch.

    What follows waits until its first handler has run or its start has failed; a failed start is its
    service's to repeat, the ownership stands. An actor of the task that is still there is ended first.

    Attributes:
        epoch: the right under which it runs.
        incarnation: which start under that epoch this is; its checkpoints say it.
        snapshot: what it begins from, encoded.
    """

    epoch: Epoch
    incarnation: int
    snapshot: bytes


@dataclass(frozen=True, slots=True)
class Freeze:
    """Stop the task at a tick boundary and bring its actuators to their safe hold.

    To be answered, once, by `Frozen` with what it then is, or by `FreezeFailed`. The actor is kept as it is
    for a `Resume`; packets that come for it wait.
    """

    offer: Epoch


@dataclass(frozen=True, slots=True)
class Resume:
    """Let the frozen task go on as it stands, under the right it had; where its actor is gone, from the snapshot.

    Attributes: as in `StartTask`.
    """

    epoch: Epoch
    incarnation: int
    snapshot: bytes


@dataclass(frozen=True, slots=True)
class Discard:
    """Let go of the object that stands still here: a frozen task that was given away, or a dormant one."""


@dataclass(frozen=True, slots=True)
class Ack:
    """Tell the sender of a packet that its effect is on disk."""

    packet: PacketId


@dataclass(frozen=True, slots=True)
class Deliver:
    """Give the packet that has arrived to the task, which runs here."""


@dataclass(frozen=True, slots=True)
class Forward:
    """Send the packet that has arrived on to `peer`."""

    peer: str


@dataclass(frozen=True, slots=True)
class After:
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


@dataclass(frozen=True, slots=True)
class Warn:
    """Tell people, on `log`."""

    text: str


@dataclass(frozen=True, slots=True)
class Decline:
    """Refuse what an event of this agent's own services asked for; nothing has changed.

    Attributes:
        reason: a sentence for whoever asked.
        moved_to: where the task is, as far as known here; empty where it did not move.
    """

    reason: str
    moved_to: str = ""


@dataclass(frozen=True, slots=True)
class AttemptFailed:
    """The hand-off to `peer` came to nothing, and the task goes on here: the next bidder may be tried.

    Attributes:
        reason: for the ledger.
    """

    peer: str
    reason: str


@dataclass(frozen=True, slots=True)
class HandedOver:
    """`peer` owns the task, and has said so.

    Attributes:
        epoch: the epoch that it runs under there.
    """

    peer: str
    epoch: Epoch


Effect = (
    Persist
    | Remember
    | Send
    | StartTask
    | Freeze
    | Resume
    | Discard
    | Ack
    | Deliver
    | Forward
    | After
    | Warn
    | Decline
    | AttemptFailed
    | HandedOver
)
