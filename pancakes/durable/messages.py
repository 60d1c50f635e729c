"""The packets of bidding, of the hand-off, and between owners, takers and guardians. Pure.

Each is the body of a packet on `network`. Bids go between the `network/TaskMigrator` actors of two agents, hand-off
messages between two services of the same name, and guard messages between such a service and a `kernel/Guardian`. The
network may lose, double, reorder and delay all of them.

`journal` is the id of the receiver's journal, as far as the sender knows it. An agent that lost its disk has a new
journal, so it ignores what was meant for its former self. The pure cores leave the field empty: `addressed` fills it
in on the way out, and `is_for` checks it on the way in. `choose` picks guardians from what neighbours have answered.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable
from typing import Annotated, Final, NamedTuple, Protocol, TypeVar

import msgspec
from msgspec.structs import replace

from pancakes.control import Refusal
from pancakes.durable.record import NO_EPOCH, NO_GUARDS, Epoch, GuardianId, Guards, TaskId, Wanted
from pancakes.migration import CostChoice
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
    """Declines to take a task, and says why."""

    task_id: TaskId
    ask: int
    refusal: Refusal
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
    refusal: Refusal
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


SHORTEST_LEASE_S: Final = 0.5
LONGEST_LEASE_S: Final = 3600.0
MOST_AGE_S: Final = 1e9
LeaseSeconds = Annotated[float, msgspec.Meta(ge=SHORTEST_LEASE_S, le=LONGEST_LEASE_S)]


class CheckpointId(NamedTuple):
    """Names a checkpoint of a task; the later is the newer.

    Attributes:
        epoch: the epoch under which it was written.
        no: the how-manieth it is under that epoch.
    """

    epoch: Epoch
    no: int


NO_CHECKPOINT: Final = CheckpointId(NO_EPOCH, 0)


class CheckpointBody(msgspec.Struct, frozen=True):
    """What a checkpoint consists of.

    Attributes:
        snapshot: the task, encoded.
        wanted: what is wanted of it.
    """

    snapshot: bytes
    wanted: Wanted = Wanted.RUNNING


@packet_type("guard.keep")
class KeepLease(msgspec.Struct, frozen=True):
    """The owner asks a guardian for a lease, and for its memory.

    Attributes:
        task_id: the task.
        type: entry point name of its class.
        epoch: the epoch under which the sender owns it.
        beat: the how-manieth asking this is since the owner began; the answer repeats it.
        lease_s: for so long the guardian lets no other agent take the task, in host seconds from the arrival of this.
        checkpoint: the newest checkpoint.
        guards: the guardians.
        body: that checkpoint; None: the guardian has it, as far as the owner knows.
        age_s: how long ago the owner knew that the task is as that checkpoint says, in host seconds.
        journal: see the module's text.
    """

    task_id: TaskId
    type: str
    epoch: Epoch
    beat: int
    lease_s: LeaseSeconds
    checkpoint: CheckpointId
    guards: Guards
    body: CheckpointBody | None = None
    age_s: Annotated[float, msgspec.Meta(ge=0.0, le=MOST_AGE_S)] = 0.0
    journal: str = ""


@packet_type("guard.kept")
class LeaseKept(msgspec.Struct, frozen=True):
    """The guardian grants the lease; what it names is on its disk.

    Attributes:
        epoch: the epoch of the owner.
        guardian: the guardian that says so.
        beat: which asking this answers.
        no: the newest checkpoint under that epoch that the guardian has; -1: none.
        version: the newest version of the guards of that epoch that it has; -1: none.
        boot: in which life of its agent it says so.
        told: the newest checkpoint under that epoch that it was told of in that life, also where it has no room for it;
            -1: none.
    """

    task_id: TaskId
    epoch: Epoch
    guardian: GuardianId
    beat: int
    no: int
    version: int
    boot: int = 0
    told: int = -1
    journal: str = ""


@packet_type("guard.seize")
class SeizeTask(msgspec.Struct, frozen=True):
    """An agent that is to take the task asks a guardian for its pledge.

    Attributes:
        type: entry point name of the task's class.
        epoch: the epoch under which the sender is to own it; it has minted it itself.
        guards: the guardians, as far as the sender knows them.
    """

    task_id: TaskId
    type: str
    epoch: Epoch
    guards: Guards
    journal: str = ""


@packet_type("guard.pledge")
class Pledge(msgspec.Struct, frozen=True):
    """The guardian follows no lower epoch any more, and tells what it remembers.

    Attributes:
        epoch: the epoch that it has promised itself to.
        guardian: the guardian that says so.
        checkpoint: the newest checkpoint that it has.
        guards: the newest guards that it knows.
        body: that checkpoint; None: it has none.
    """

    task_id: TaskId
    epoch: Epoch
    guardian: GuardianId
    checkpoint: CheckpointId
    guards: Guards
    body: CheckpointBody | None
    journal: str = ""


@packet_type("guard.deny")
class DenyLease(msgspec.Struct, frozen=True):
    """The guardian grants nothing: it has promised itself to a later epoch, or a lease runs. A hint, and no more.

    Attributes:
        epoch: the epoch of which it was asked.
        guardian: the guardian that says so.
        promised: the highest epoch that it has promised itself to.
        reason: why, as a sentence.
    """

    task_id: TaskId
    epoch: Epoch
    guardian: GuardianId
    promised: Epoch
    reason: str
    journal: str = ""


@packet_type("guard.yield")
class YieldLease(msgspec.Struct, frozen=True):
    """The owner does nothing more until it has asked for a lease again, or has given the task away: its lease may end.

    Attributes:
        epoch: the epoch under which it owned the task.
        beat: the number of its last asking; a lease that was granted on a later one does not end.
        boot: in which life of its agent the guardian was heard last; one that has begun anew since cannot know on which
            asking it granted what, so the lease does not end.
        given: whether it has given the task to another agent, or is frozen for one, which is about to ask.
    """

    task_id: TaskId
    epoch: Epoch
    beat: int
    boot: int
    journal: str = ""
    given: bool = False


GuardAnswer = LeaseKept | Pledge | DenyLease
"""What a guardian says."""


LONG_UP_S = 600.0
"""An agent that has been up for so long counts as stable."""


@packet_type("guard.ask")
class MayGuard(msgspec.Struct, frozen=True):
    """The owner of a task asks the guardian of another agent whether it would guard it. Answered by `CanGuard`.

    Attributes:
        type: entry point name of the task's class.
    """

    task_id: TaskId
    type: str
    journal: str = ""


@packet_type("guard.can")
class CanGuard(msgspec.Struct, frozen=True):
    """Says whether an agent would guard a task.

    Attributes:
        guardian: the agent that says so.
        refusal: why not; empty: it would.
        runs_type: whether it could run the task: else it is a witness, which only remembers.
        on_battery: whether it runs on a battery.
        up_s: for how long it has been up, in host seconds.
    """

    task_id: TaskId
    guardian: GuardianId
    refusal: str
    runs_type: bool
    on_battery: bool
    up_s: float
    journal: str = ""


def choose(
    me: GuardianId,
    now: Iterable[GuardianId],
    silent: Collection[GuardianId],
    named: Collection[str],
    number: int,
    answers: Iterable[CanGuard],
) -> tuple[GuardianId, ...] | None:
    """Chooses the guardians of a task.

    Those that are there stay, unless they are silent. Of the others, those that the configuration names come first,
    then those that can run the task, those on mains, and those that have been up for long.

    Args:
        me: the owner, which is one of them.
        now: the guardians as they are.
        silent: those of them that have said nothing for too long.
        named: agents that the configuration names.
        number: how many there are to be.
        answers: what neighbours have said.

    Returns:
        The guardians; None: there are not enough.
    """
    able = [one for one in answers if not one.refusal and one.guardian.agent != me.agent]
    stay = [one for one in now if one not in silent and one.agent != me.agent][: number - 1]
    taken = {me.agent, *(one.agent for one in stay)}
    able.sort(
        key=lambda one: (
            one.guardian.agent not in named,
            not one.runs_type,
            one.on_battery,
            one.up_s < LONG_UP_S,
            one.guardian.agent,
        )
    )
    new = [one.guardian for one in able if one.guardian.agent not in taken][: number - 1 - len(stay)]
    chosen = (me, *stay, *new)
    return chosen if len(chosen) == number else None


@packet_type("guard.poll")
class AskLease(msgspec.Struct, frozen=True):
    """A guardian asks another one whether a lease on a task runs there; answered by `LeaseSeen`, promises nothing."""

    task_id: TaskId
    journal: str = ""


class HeldUntil(msgspec.Struct, frozen=True):
    """The newest checkpoint that a guardian has.

    Attributes:
        checkpoint: which one.
        age_s: how old it was when the owner was heard last, in host seconds; None: that is not known any more. What the
            task has done since is lost.
    """

    checkpoint: CheckpointId = NO_CHECKPOINT
    age_s: float | None = None

    def story(self) -> str:
        """Returns it as a clause."""
        age = f"{self.age_s:.1f} s old" if self.age_s is not None else "of an age that is not known"
        return f"checkpoint {self.checkpoint.epoch}/{self.checkpoint.no}, {age} at its last word"


@packet_type("guard.seen")
class LeaseSeen(msgspec.Struct, frozen=True):
    """Says whether a lease runs at a guardian.

    Attributes:
        guardian: the guardian that says so.
        runs: whether one runs.
        promised: the latest epoch that it follows.
        guards: the newest guards that it knows of.
        held: the newest checkpoint that it has.
    """

    task_id: TaskId
    guardian: GuardianId
    runs: bool
    promised: Epoch
    guards: Guards
    held: HeldUntil = HeldUntil()
    journal: str = ""


@packet_type("guard.call")
class TakeTask(msgspec.Struct, frozen=True):
    """A guardian tells the service of an agent to take a task whose owner is silent. No safety hangs on it.

    Attributes:
        type: entry point name of the task's class.
        promised: the latest epoch that any guardian follows, as far as is known: the next one must be higher.
        guards: the guardians.
        checkpoint: the newest checkpoint that the sender has.
        silent_s: for how long the owner has been silent, in host seconds.
    """

    task_id: TaskId
    type: str
    promised: Epoch
    guards: Guards
    checkpoint: CheckpointId
    silent_s: float = 0.0
    journal: str = ""
