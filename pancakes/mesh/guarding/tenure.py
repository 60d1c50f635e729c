"""What the owner of a guarded task has of its guardians. Pure.

A crash forgets it. That is safe: an owner that has begun anew acts once its guardians have answered it again.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final

import msgspec
from msgspec.structs import replace

from pancakes.mesh.guarding.guard_messages import (
    CheckpointBody,
    CheckpointId,
    DenyLease,
    KeepLease,
    LeaseKept,
    YieldLease,
)
from pancakes.mesh.migration.epoch import NO_EPOCH, Epoch
from pancakes.mesh.migration.event import ClaimHeard, GuardsChosen, PacketId
from pancakes.mesh.migration.guards import GuardianId, Guards
from pancakes.mesh.migration.record import Record

BEATS_OF_BOOT: Final = 2**44
"""A life of an agent has so many beats: one for each 0.1 ms of 55 years."""

PATIENCE: Final = 8
"""A guardian that has granted none of so many askings, those of two leases, follows the owner no more."""

Owed = tuple[CheckpointId, PacketId]
"""A packet, and the checkpoint with its effect."""


class LastAnswer(msgspec.Struct, frozen=True):
    """What one guardian has said last to the owner of an epoch.

    Attributes:
        guardian: the guardian.
        beat: the newest asking that it has granted; 0: none.
        no: the newest checkpoint of that epoch that it has; -1: none.
        version: the newest version of the guards of that epoch that it has; -1: none.
        boot: in which life of its agent it said so; -1: it has granted nothing.
        promised: where it has denied the lease since: the epoch that it follows.
    """

    guardian: GuardianId
    beat: int = 0
    no: int = -1
    version: int = -1
    boot: int = -1
    promised: Epoch = NO_EPOCH


class Tenure(msgspec.Struct, frozen=True):
    """What an owner has of its guardians.

    Attributes:
        epoch: under which it owns the task.
        beat: the number of its newest asking for leases; no earlier one has a higher number.
        since: the number of its first asking under that epoch.
        answers: what each guardian has said last.
        behind: whether a guardian has, or was told of, a later checkpoint of the epoch than the owner had when it heard
            so: the owner's disk is an old copy. It asks for no lease any more, so the guardians look for another owner.
        original: where the owner's disk is a copy: the epoch under which the original owned the task. It may have given
            the task away since, by a word that the copy does not know, so the copy asks for no lease under it.
    """

    epoch: Epoch = NO_EPOCH
    beat: int = 0
    since: int = 0
    answers: tuple[LastAnswer, ...] = ()
    behind: bool = False
    original: Epoch = NO_EPOCH

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

    def have(self, guards: Guards, no: int) -> bool:
        """Returns whether a quorum has these guards and the checkpoint of this number on its disks."""
        know = {one.guardian for one in self.answers if one.version == guards.version}
        return guards.has_quorum(know) and self.replicated_no(guards) >= no

    def outvoted_by(self, guards: Guards) -> Epoch:
        """Returns the latest epoch that guardians follow; `NO_EPOCH`: those that may follow the owner are a quorum.

        One that says nothing for long follows it no more: else an owner that one guardian has left, and whose other one
        is gone for good, would ask for ever, and hold the lease of the third.
        """
        against = [one for one in self.answers if one.promised > self.epoch]
        if not against:
            return NO_EPOCH
        names = {one.guardian for one in against}
        if guards.has_quorum([it for it in guards.members() if it not in names and not self._is_silent(it)]):
            return NO_EPOCH
        return max(one.promised for one in against)

    def _is_silent(self, guardian: GuardianId) -> bool:
        return max(self.of(guardian).beat, self.since) + PATIENCE < self.beat


def _named(answers: Iterable[LastAnswer], beat: int) -> set[GuardianId]:
    return {one.guardian for one in answers if one.beat >= beat}


def begun(boot: int, now_s: float, original: Epoch = NO_EPOCH) -> Tenure:
    """Returns what an owner has that begins: an answer to its predecessor is older than every beat of its own.

    Args:
        boot: which life of the agent this is; the host clock may begin anew with each.
        now_s: host time.
        original: see `Tenure`.
    """
    return Tenure(beat=boot * BEATS_OF_BOOT + int(now_s * 1e4), original=original)


def may_ask(tenure: Tenure, record: Record) -> bool:
    """Returns whether the owner asks for leases: one whose disk is an old copy does not."""
    return not (tenure.behind and tenure.epoch == record.epoch) and tenure.original != record.epoch


def asked_again(tenure: Tenure, record: Record) -> Tenure:
    """Returns what the owner has as it asks for leases once more."""
    if tenure.epoch != record.epoch:
        return Tenure(record.epoch, tenure.beat + 1, tenure.beat + 1, original=tenure.original)
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
    known, told = tenure.of(answer.guardian), -1
    if isinstance(answer, DenyLease):
        new = replace(known, promised=max(known.promised, answer.promised))
    elif answer.beat < known.beat or answer.beat > tenure.beat or answer.boot < known.boot:
        return tenure
    else:
        no, version = answer.no, answer.version
        if answer.boot == known.boot:  # one that has begun anew may have an old copy of its disk: it has what it says
            no, version = max(known.no, no), max(known.version, version)
        new, told = LastAnswer(answer.guardian, answer.beat, no, version, answer.boot), answer.told
    others = (one for one in tenure.answers if one.guardian != answer.guardian)
    behind = tenure.behind or (tenure.epoch == record.epoch and max(new.no, told) > record.no)
    return replace(tenure, answers=(*others, new), behind=behind)


def conclusion(tenure: Tenure, record: Record, acts: bool, seizes: bool) -> ClaimHeard | GuardsChosen | None:
    """Returns what follows from what guardians have said, besides a permit; None: nothing.

    Args:
        tenure: what they have said.
        record: the record, as it is on disk.
        acts: whether the task has a permit.
        seizes: whether this agent asks for pledges itself.
    """
    if tenure.epoch != record.epoch:
        return None
    later = tenure.outvoted_by(record.guards)
    if later != NO_EPOCH:
        peer = later.minter if later.minter != record.epoch.minter else ""
        return ClaimHeard(peer, later) if not (acts or seizes) else None
    both = record.guards.sets[1:]
    return GuardsChosen(both) if both and not tenure.behind and tenure.have(record.guards, record.no) else None


def kept_packets(tenure: Tenure, record: Record, owed: Iterable[Owed]) -> tuple[list[PacketId], list[Owed]]:
    """Returns the packets whose effects a take-over keeps, and those that wait for that.

    What was owed under another epoch is neither: the task may go on from a state without its effect. Its sender sends
    it again.
    """
    ours = [one for one in owed if one[0].epoch == record.epoch]
    no = tenure.replicated_no(record.guards) if tenure.epoch == record.epoch else -1
    return [packet for at, packet in ours if at.no <= no], [one for one in ours if one[0].no > no]


def yield_lease(tenure: Tenure, record: Record, guardian: GuardianId, given: bool = False) -> YieldLease:
    """Returns what an owner tells a guardian that stops; `given`: that has given the task away."""
    return YieldLease(record.task_id, record.epoch, tenure.beat, tenure.of(guardian).boot, given=given)
