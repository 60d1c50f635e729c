"""What the owner of a guarded task has of its guardians, and what an agent has that is to take one over. Pure.

A crash forgets both. That is safe: an owner that has begun anew acts once its guardians have answered it again, and an
agent that asks for pledges once more gets them only where no other agent was heard of as the owner.
"""

from __future__ import annotations

from collections.abc import Iterable

import msgspec
from msgspec.structs import replace

from pancakes.mesh.guarding.guard_messages import (
    CheckpointBody,
    CheckpointId,
    DenyLease,
    GuardAnswer,
    KeepLease,
    LeaseKept,
    Pledge,
    SeizeTask,
)
from pancakes.mesh.migration.epoch import NO_EPOCH, Epoch
from pancakes.mesh.migration.event import Seized
from pancakes.mesh.migration.guards import GuardianId, Guards, newest
from pancakes.mesh.migration.record import Record, TaskId


class LastAnswer(msgspec.Struct, frozen=True):
    """What one guardian has said last to the owner of an epoch.

    Attributes:
        guardian: the guardian.
        beat: the newest asking that it has granted; 0: none.
        no: the newest checkpoint of that epoch that it has; -1: none.
        version: the newest version of the guards of that epoch that it has; -1: none.
        promised: where it has denied the lease since: the epoch that it follows.
    """

    guardian: GuardianId
    beat: int = 0
    no: int = -1
    version: int = -1
    promised: Epoch = NO_EPOCH


class Tenure(msgspec.Struct, frozen=True):
    """What an owner has of its guardians.

    Attributes:
        epoch: under which it owns the task.
        beat: how often it has asked for leases since it began.
        answers: what each guardian has said last.
    """

    epoch: Epoch = NO_EPOCH
    beat: int = 0
    answers: tuple[LastAnswer, ...] = ()

    def of(self, guardian: GuardianId) -> LastAnswer:
        """Returns what one guardian has said last."""
        return next((one for one in self.answers if one.guardian == guardian), LastAnswer(guardian))

    def granted_beat(self, guards: Guards) -> int:
        """Returns the newest asking that a quorum has granted, each knowing that these are the guards; 0: none."""
        known = [one for one in self.answers if one.version == guards.version]
        beats = sorted({one.beat for one in known}, reverse=True)
        return next((beat for beat in beats if guards.has_quorum(_named(known, beat))), 0)

    def replicated_no(self, guards: Guards) -> int:
        """Returns the newest checkpoint of the epoch that a quorum has, so that a take-over keeps it; -1: none."""
        numbers = sorted({one.no for one in self.answers}, reverse=True)
        return next(
            (no for no in numbers if guards.has_quorum({one.guardian for one in self.answers if one.no >= no})), -1
        )

    def is_behind(self, no: int) -> bool:
        """Returns whether a guardian has a later checkpoint of the epoch: the owner's disk is an old copy."""
        return any(one.no > no for one in self.answers)

    def have(self, guards: Guards, no: int) -> bool:
        """Returns whether a quorum has these guards and the checkpoint of this number on its disks."""
        know = {one.guardian for one in self.answers if one.version == guards.version}
        return guards.has_quorum(know) and self.replicated_no(guards) >= no

    @property
    def passed(self) -> bool:
        """Whether a guardian follows a later epoch."""
        return any(one.promised > self.epoch for one in self.answers)

    def outvoted_by(self, guards: Guards) -> Epoch:
        """Returns the latest epoch that guardians follow; `NO_EPOCH`: those that follow the owner are a quorum."""
        against = [one for one in self.answers if one.promised > self.epoch]
        names = {one.guardian for one in against}
        if guards.has_quorum([it for it in guards.members() if it not in names]):
            return NO_EPOCH
        return max((one.promised for one in against), default=NO_EPOCH)


def _named(answers: Iterable[LastAnswer], beat: int) -> set[GuardianId]:
    return {one.guardian for one in answers if one.beat >= beat}


def asked_again(tenure: Tenure, record: Record) -> Tenure:
    """Returns what the owner has as it asks for leases once more."""
    if tenure.epoch != record.epoch:
        return Tenure(record.epoch, tenure.beat + 1)
    return replace(tenure, beat=tenure.beat + 1)


def keep_lease(tenure: Tenure, record: Record, type: str, lease_s: float, with_body: bool) -> KeepLease:
    """Returns what the owner tells a guardian.

    Args:
        tenure: what it has.
        record: the record, as it is on disk.
        type: entry point name of the task's class.
        lease_s: how long a lease is to be, in host seconds.
        with_body: whether the checkpoint goes along.
    """
    body = CheckpointBody(record.snapshot, record.wanted) if with_body else None
    checkpoint = CheckpointId(record.epoch, record.no)
    return KeepLease(record.task_id, type, record.epoch, tenure.beat, lease_s, checkpoint, record.guards, body)


def answered(tenure: Tenure, record: Record, answer: LeaseKept | DenyLease) -> Tenure:
    """Takes what a guardian says to the owner. A late answer, and that of a stranger, change nothing."""
    if answer.epoch != tenure.epoch or answer.guardian not in record.guards.members():
        return tenure
    known = tenure.of(answer.guardian)
    if isinstance(answer, DenyLease):
        new = replace(known, promised=max(known.promised, answer.promised))
    elif answer.beat < known.beat or answer.beat > tenure.beat:
        return tenure
    else:
        new = LastAnswer(answer.guardian, answer.beat, max(known.no, answer.no), max(known.version, answer.version))
    others = (one for one in tenure.answers if one.guardian != answer.guardian)
    return replace(tenure, answers=(*others, new))


class Seizing(msgspec.Struct, frozen=True):
    """What an agent has that asks the guardians of a task for their pledges.

    Attributes:
        task_id: the task.
        type: entry point name of its class.
        epoch: the epoch that it has minted for itself.
        guards: the newest guards that it knows of.
        yields: the owner of this epoch has stopped for good; `NO_EPOCH`: none has, as far as is known.
        source: the agent that gives the task away; empty: it is taken over.
        offer: of that hand-off.
        checkpoint: the newest checkpoint that it knows of.
        body: that checkpoint; None: it has none yet.
        pledged: the guardians that have pledged themselves.
        denied: what others have said, by guardian.
    """

    task_id: TaskId
    type: str
    epoch: Epoch
    guards: Guards
    checkpoint: CheckpointId
    body: CheckpointBody | None
    yields: Epoch = NO_EPOCH
    source: str = ""
    offer: Epoch = NO_EPOCH
    pledged: tuple[GuardianId, ...] = ()
    denied: tuple[DenyLease, ...] = ()

    def ask(self) -> SeizeTask:
        """Returns what the guardians are asked."""
        return SeizeTask(self.task_id, self.type, self.epoch, self.yields, self.guards)

    def unasked(self) -> list[GuardianId]:
        """Returns the guardians that have not pledged themselves yet."""
        return [one for one in self.guards.members() if one not in self.pledged]

    def result(self) -> Seized | None:
        """Returns what follows once a quorum has pledged itself; None: none has yet, or none has a checkpoint."""
        if self.body is None or not self.guards.has_quorum(self.pledged):
            return None
        body = self.body
        return Seized(self.epoch, self.guards, body.snapshot, body.wanted, self.source, self.offer)

    def promised(self) -> Epoch:
        """Returns the latest epoch that a guardian follows that has denied its pledge."""
        return max((one.promised for one in self.denied), default=NO_EPOCH)


def told(seizing: Seizing, answer: GuardAnswer) -> Seizing:
    """Takes what a guardian says to an agent that has asked for its pledge."""
    if answer.epoch != seizing.epoch:
        return seizing
    if isinstance(answer, DenyLease):
        others = [one for one in seizing.denied if one.guardian != answer.guardian]
        return replace(seizing, denied=(*others, answer))
    if not isinstance(answer, Pledge):
        return seizing
    # A stranger counts for nothing: it is among no guards. Which are the newest, any of them may know.
    seizing = replace(seizing, guards=newest(seizing.guards, answer.guards))
    if answer.guardian not in seizing.pledged:
        seizing = replace(seizing, pledged=(*seizing.pledged, answer.guardian))
    if answer.body is not None and answer.checkpoint > seizing.checkpoint:
        seizing = replace(seizing, checkpoint=answer.checkpoint, body=answer.body)
    return seizing
