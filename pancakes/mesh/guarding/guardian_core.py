"""What a guardian decides: which agent gets a lease on a task, and which one its pledge. Pure.

A register for each task, in the manner of CASPaxos (arXiv 1802.07000), with leases: the owner of a task asks each of
its guardians for a lease again and again, and tells them its newest checkpoint. An agent that is to take the task mints
a higher epoch, and asks them for pledges. A guardian pledges itself once its lease is over, and follows no lower epoch
from then on. More than half of the guardians decide, so at most one agent has their word at any moment
(docs/protocol.md, guardians).

`handle` reads no clock and touches nothing. Its effects are carried out strictly in order, and a crash may fall between
any two of them.
"""

from __future__ import annotations

import msgspec
from msgspec.structs import replace

from pancakes.mesh.guarding.guard_messages import (
    NO_CHECKPOINT,
    SHORTEST_LEASE_S,
    CheckpointBody,
    CheckpointId,
    DenyLease,
    GuardAnswer,
    KeepLease,
    LeaseKept,
    Pledge,
    SeizeTask,
    YieldLease,
)
from pancakes.mesh.migration.epoch import MOST_STEP, NO_EPOCH, Epoch
from pancakes.mesh.migration.guards import NO_GUARDS, GuardianId, Guards, newest
from pancakes.mesh.migration.record import TaskId


class GuardRegister(msgspec.Struct, frozen=True):
    """What a guardian has on disk about one task.

    Attributes:
        task_id: the task.
        type: entry point name of its class.
        promised: it follows no lower epoch than this.
        checkpoint: the newest checkpoint that it has.
        body: that checkpoint; None: it has none.
        guards: the newest guards that it knows of.
        lease_s: how long a lease is that it grants, in host seconds.
    """

    task_id: TaskId
    type: str = ""
    promised: Epoch = NO_EPOCH
    checkpoint: CheckpointId = NO_CHECKPOINT
    body: CheckpointBody | None = None
    guards: Guards = NO_GUARDS
    lease_s: float = SHORTEST_LEASE_S

    @property
    def blank(self) -> bool:
        """Whether it says nothing yet."""
        return self.promised == NO_EPOCH


class Lease(msgspec.Struct, frozen=True):
    """What a guardian has granted, until the next crash.

    Attributes:
        epoch: of the owner that has the lease; None: no lease runs.
        number: the how-manieth it is, so that the end of one is not taken for that of a later one.
        beat: the newest asking of that owner that it was granted on, in this life of the agent.
        boot: which life of the agent this is.
    """

    epoch: Epoch | None = None
    number: int = 0
    beat: int = 0
    boot: int = 0


class LeaseOver(msgspec.Struct, frozen=True):
    """An event: a lease is over.

    Attributes:
        number: which one.
    """

    number: int


class GuardsForgotten(msgspec.Struct, frozen=True):
    """An event: another guardian says that the task was removed.

    Attributes:
        guards: what it was told.
    """

    guards: Guards


GuardEvent = KeepLease | SeizeTask | YieldLease | LeaseOver | GuardsForgotten


class WriteRegister(msgspec.Struct, frozen=True):
    """An effect: put the register on disk. What follows waits until it is there for good."""

    register: GuardRegister


class SetLease(msgspec.Struct, frozen=True):
    """An effect: this lease is the newest; feed its `LeaseOver` once the whole of it has passed.

    Attributes:
        lease: the lease; it may be none.
        lease_s: how long it is, in host seconds.
    """

    lease: Lease
    lease_s: float


class AnswerAsker(msgspec.Struct, frozen=True):
    """An effect: send an answer to the agent that has asked. It may be lost."""

    message: GuardAnswer


GuardEffect = WriteRegister | SetLease | AnswerAsker


def handle(me: GuardianId, register: GuardRegister, lease: Lease, event: GuardEvent) -> list[GuardEffect]:
    """Decides what an event means.

    Args:
        me: this guardian.
        register: what it has on disk about the task.
        lease: its newest lease on it.
        event: what has happened.

    Returns:
        What to do, strictly in this order.
    """
    match event:
        case KeepLease():
            return _keep(me, register, lease, event)
        case SeizeTask():
            return _seize(me, register, lease, event)
        case YieldLease():
            return [SetLease(replace(lease, epoch=None), 0.0)] if _is_yielded(lease, event) else []
        case LeaseOver():
            return [SetLease(replace(lease, epoch=None), 0.0)] if event.number == lease.number else []
        case GuardsForgotten():
            return _forget(register, event.guards)


def recover(register: GuardRegister, boot: int = 0) -> list[GuardEffect]:
    """Decides what to do after a restart: it cannot know what lease it gave, so it waits for a whole one.

    Args:
        register: what is on disk.
        boot: which life of the agent this is.
    """
    if not register.guards.sets:
        return []
    return [SetLease(Lease(register.promised, 1, boot=boot), register.lease_s)]


def _forget(register: GuardRegister, guards: Guards) -> list[GuardEffect]:
    """Keeps of a task that was removed no more than that no lower epoch is followed."""
    if register.blank or guards.epoch < register.promised or guards.stamp <= register.guards.stamp:
        return []
    return [WriteRegister(replace(register, promised=guards.epoch, guards=guards, checkpoint=NO_CHECKPOINT, body=None))]


def _keep(me: GuardianId, register: GuardRegister, lease: Lease, keep: KeepLease) -> list[GuardEffect]:
    if keep.guards.forgotten:
        theirs = keep.guards.epoch == keep.epoch and lease.epoch in (None, keep.epoch)
        return _forget(register, keep.guards) if theirs else []
    if register.guards.forgotten and keep.epoch <= register.guards.epoch:
        return [_deny(me, register, keep.epoch, "it was removed")]
    if me not in keep.guards.members():
        return [_deny(me, register, keep.epoch, f"{me.agent} is none of its guardians")]
    if keep.epoch < register.promised:
        return [_deny(me, register, keep.epoch, f"{me.agent} follows the epoch {register.promised}")]
    if fault := _too_far(register, keep.epoch):
        return [_deny(me, register, keep.epoch, fault)]
    if lease.epoch is not None and lease.epoch.minter != keep.epoch.minter:
        return [_deny(me, register, keep.epoch, _runs(lease))]  # whoever was pledged to is met without a lease
    new = replace(
        register,
        type=register.type or keep.type,
        promised=keep.epoch,
        guards=newest(register.guards, keep.guards),
        lease_s=keep.lease_s,
    )
    if keep.body is not None and keep.checkpoint > register.checkpoint:
        new = replace(new, checkpoint=keep.checkpoint, body=keep.body)
    no = new.checkpoint.no if new.checkpoint.epoch == keep.epoch else -1
    version = new.guards.version if new.guards.epoch == keep.epoch else -1
    write: list[GuardEffect] = [WriteRegister(new)] if new != register else []
    # A KEEP that comes late is older than what was granted before it.
    beat = max(lease.beat, keep.beat) if lease.epoch == keep.epoch else keep.beat
    granted = Lease(keep.epoch, lease.number + 1, beat, lease.boot)
    kept = LeaseKept(keep.task_id, keep.epoch, me, keep.beat, no, version, lease.boot)
    return [*write, SetLease(granted, keep.lease_s), AnswerAsker(kept)]


def _seize(me: GuardianId, register: GuardRegister, lease: Lease, seize: SeizeTask) -> list[GuardEffect]:
    if register.guards.forgotten and seize.guards.epoch <= register.guards.epoch:
        return [_deny(me, register, seize.epoch, "it was removed")]
    if not register.guards.sets and me not in seize.guards.members():
        return [_deny(me, register, seize.epoch, f"{me.agent} knows nothing of it")]
    if seize.epoch == register.promised and _nothing_kept(register):
        return [_pledge(me, register, seize.epoch)]  # again, for it may be lost
    if seize.epoch <= register.promised:
        return [_deny(me, register, seize.epoch, f"{me.agent} follows the epoch {register.promised}")]
    if fault := _too_far(register, seize.epoch):
        return [_deny(me, register, seize.epoch, fault)]
    if lease.epoch is not None:
        return [_deny(me, register, seize.epoch, _runs(lease))]  # only its owner can end it early, by its own word
    new = replace(register, type=register.type or seize.type, promised=seize.epoch)
    return [WriteRegister(new), SetLease(replace(lease, epoch=None), 0.0), _pledge(me, new, seize.epoch)]


def _is_yielded(lease: Lease, said: YieldLease) -> bool:
    """Returns whether the owner has no permit by the lease, nor will have: what comes late is of an earlier life."""
    return said.epoch == lease.epoch and said.beat >= lease.beat and said.boot == lease.boot


def _nothing_kept(register: GuardRegister) -> bool:
    """Returns whether the agent that the guardian has promised itself to has not been heard of as the owner."""
    return max(register.guards.epoch, register.checkpoint.epoch) < register.promised


def _runs(lease: Lease) -> str:
    return f"the lease of the epoch {lease.epoch} runs"


def _too_far(register: GuardRegister, epoch: Epoch) -> str:
    most = register.promised.n + MOST_STEP
    return f"the epoch {epoch} is out of the order: {most} is the highest that may come next" if epoch.n > most else ""


def _pledge(me: GuardianId, register: GuardRegister, epoch: Epoch) -> AnswerAsker:
    held = register.checkpoint, register.guards, register.body
    return AnswerAsker(Pledge(register.task_id, epoch, me, *held))


def _deny(me: GuardianId, register: GuardRegister, epoch: Epoch, reason: str) -> AnswerAsker:
    return AnswerAsker(DenyLease(register.task_id, epoch, me, register.promised, reason))
