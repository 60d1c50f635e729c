"""What an agent has that is to take a guarded task. Pure.

A crash forgets it. That is safe: an agent that asks for pledges once more gets them only where no other agent was heard
of as the owner.
"""

from __future__ import annotations

import msgspec
from msgspec.structs import replace

from pancakes.mesh.guarding.guard_messages import (
    NO_CHECKPOINT,
    CheckpointBody,
    CheckpointId,
    DenyLease,
    GuardAnswer,
    Pledge,
    SeizeTask,
)
from pancakes.mesh.guarding.taking_over import TakeTask
from pancakes.mesh.migration.epoch import NO_EPOCH, Epoch, is_out_of_reach
from pancakes.mesh.migration.event import Seized
from pancakes.mesh.migration.guards import NO_GUARDS, GuardianId, Guards, newest
from pancakes.mesh.migration.messages import Commit
from pancakes.mesh.migration.record import Phase, Record, TaskId
from pancakes.mesh.migration.volatile import Volatile


class Seizing(msgspec.Struct, frozen=True):
    """What an agent has that asks the guardians of a task for their pledges.

    Attributes:
        task_id: the task.
        type: entry point name of its class.
        epoch: the epoch that it has minted for itself.
        guards: the newest guards that it knows of.
        source: the agent that gives the task away; empty: it is taken over.
        offer: of that hand-off.
        checkpoint: the newest checkpoint that it knows of.
        body: that checkpoint; None: it has none yet.
        pledged: the guardians that have pledged themselves.
        denied: what others have said, by guardian.
        own: the guards that this agent knows as a guardian itself: newer ones that another tells of must not decide
            without them, as it may lie.
    """

    task_id: TaskId
    type: str
    epoch: Epoch
    guards: Guards
    checkpoint: CheckpointId
    body: CheckpointBody | None
    source: str = ""
    offer: Epoch = NO_EPOCH
    pledged: tuple[GuardianId, ...] = ()
    denied: tuple[DenyLease, ...] = ()
    own: Guards = NO_GUARDS

    def ask(self) -> SeizeTask:
        """Returns what the guardians are asked."""
        return SeizeTask(self.task_id, self.type, self.epoch, self.guards)

    def unasked(self) -> list[GuardianId]:
        """Returns the guardians that have not pledged themselves yet."""
        return [one for one in self.members() if one not in self.pledged]

    def members(self) -> list[GuardianId]:
        """Returns all guardians whose word counts."""
        return list(dict.fromkeys((*self.guards.members(), *self.own.members())))

    def result(self) -> Seized | None:
        """Returns what follows once a quorum has pledged itself; None: none has yet, or none has a checkpoint."""
        if self.body is None or not self.guards.has_quorum(self.pledged):
            return None
        if self.own.sets and not self.own.has_quorum(self.pledged):
            return None
        body = self.body
        return Seized(self.epoch, self.guards, body.snapshot, body.wanted, self.source, self.offer)

    def promised(self) -> Epoch:
        """Returns the latest epoch that a guardian follows that has denied its pledge."""
        return max((one.promised for one in self.denied), default=NO_EPOCH)


def told(seizing: Seizing, answer: GuardAnswer) -> Seizing:
    """Takes what a guardian says to an agent that has asked for its pledge; what others say changes nothing."""
    if answer.epoch != seizing.epoch or answer.guardian not in seizing.members():
        return seizing
    if isinstance(answer, DenyLease):
        if is_out_of_reach(answer.promised, seizing.epoch):
            return seizing
        others = [one for one in seizing.denied if one.guardian != answer.guardian]
        return replace(seizing, denied=(*others, answer))
    if not isinstance(answer, Pledge):
        return seizing
    # Which guards are the newest, any of them may know.
    seizing = replace(seizing, guards=newest(seizing.guards, answer.guards))
    if answer.guardian not in seizing.pledged:
        seizing = replace(seizing, pledged=(*seizing.pledged, answer.guardian))
    if answer.body is not None and answer.checkpoint > seizing.checkpoint:
        seizing = replace(seizing, checkpoint=answer.checkpoint, body=answer.body)
    return seizing


def given_away(me: str, record: Record, type: str, source: str, commit: Commit) -> Seizing:
    """Returns how an agent begins to take a task that its owner has given to it, and never acts on again.

    Args:
        me: this agent's name.
        record: the record here, PREPARED.
        type: entry point name of the task's class.
        source: the agent that has given it away.
        commit: what that agent has said.
    """
    checkpoint = CheckpointId(commit.yields, commit.no)
    epoch, body = Epoch(record.seen.n + 1, me), CheckpointBody(record.snapshot)
    parts = record.task_id, type, epoch, commit.guards, checkpoint, body
    return Seizing(*parts, source, commit.offer)


def called(me: str, record: Record, volatile: Volatile, call: TakeTask, own: Guards = NO_GUARDS) -> Seizing | None:
    """Returns how an agent begins to take a task at the word of a guardian; None: it does not.

    Args:
        me: this agent's name.
        record: the record here.
        volatile: what is known besides.
        call: what the guardian says.
        own: the guards that this agent knows as a guardian itself.
    """
    if record.phase is Phase.FROZEN or volatile.running:
        return None
    ours = record.phase in (Phase.OWNER, Phase.COMMITTED) and record.guarded
    checkpoint = CheckpointId(record.epoch, record.no) if ours else NO_CHECKPOINT
    body = CheckpointBody(record.snapshot, record.wanted) if ours else None
    epoch = Epoch(max(record.seen.n, call.promised.n) + 1, me)
    return Seizing(record.task_id, call.type, epoch, newest(own, call.guards), checkpoint, body, own=own)


def is_vain(seizing: Seizing, record: Record) -> bool:
    """Returns whether nothing can come of it any more: the task went another way."""
    return record.seen >= seizing.epoch or (bool(seizing.source) and record.phase is not Phase.PREPARED)


def asked_anew(seizing: Seizing, me: str) -> Seizing:
    """Returns what an agent asks for that asks once more: where another one has asked, a higher epoch.

    One that was called leaves the task to others then.
    """
    promised = seizing.promised()
    if not seizing.source or promised <= seizing.epoch:
        return seizing
    return replace(seizing, epoch=Epoch(promised.n + 1, me), pledged=(), denied=())
