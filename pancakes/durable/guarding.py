"""The rules of guarded tasks: how guardians, the owner and a taker decide who may run a task. Pure.

A guardian is a register for each task in the manner of CASPaxos (arXiv 1802.07000), with leases. The owner asks each
guardian for a lease again and again, and sends its newest checkpoint along. An agent that wants to take the task
mints a higher epoch and asks for pledges. A guardian pledges itself once its lease is over, and follows no lower
epoch from then on. More than half of the guardians decide, so at most one agent has their word at any moment
(docs/protocol.md).

The parts, in order: the guardian's core (`handle`), what an owner has heard of its guardians (`Tenure`), and what a
taker has heard (`Seizing`). A crash forgets the last two, which is safe: both ask again. Effects are carried out
strictly in order, and a crash may fall between any two.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, Final

import msgspec
from msgspec.structs import replace

from pancakes.durable.handoff_events import ClaimHeard, GuardsChosen, PacketId, Seized
from pancakes.durable.messages import (
    NO_CHECKPOINT,
    SHORTEST_LEASE_S,
    CheckpointBody,
    CheckpointId,
    Commit,
    DenyLease,
    GuardAnswer,
    KeepLease,
    LeaseKept,
    Pledge,
    SeizeTask,
    TakeTask,
    YieldLease,
)
from pancakes.durable.record import (
    MOST_STEP,
    NO_EPOCH,
    NO_GUARDS,
    Epoch,
    GuardianId,
    Guards,
    Phase,
    Record,
    TaskId,
    Volatile,
    is_out_of_reach,
    newest,
)
from pancakes.packet import Fence


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


# What is known of the guardians ------------------------------------------------------------------------------------


class GuardNote(msgspec.Struct, frozen=True):
    """How a task is guarded, as its owner knows it. Times are host times.

    Attributes:
        right: the right under which it acts, and which its permit limits.
        number: how many guardians it is to have.
        lease_s: how long a lease is, in host seconds.
        guards: the guardians that it has.
        tenure: what they have said.
        heard_s: when each of them has said something last.
        as_of_s: when the task was known last to be as each of the newest checkpoints says, by number.
    """

    right: Fence
    number: int
    lease_s: float
    guards: Guards
    tenure: Tenure
    heard_s: Mapping[GuardianId, float]
    as_of_s: Mapping[int, float]

    def answering(self, now_s: float) -> int:
        """Returns how many guardians have said something within a lease."""
        return sum(now_s - self.heard_s[one] < self.lease_s for one in self.guards.members())

    def age_s(self, now_s: float) -> float | None:
        """Returns how long ago the task was known to be as the checkpoint says that more than half have."""
        return self._age_s(self.tenure.replicated_no(self.guards), now_s)

    def _age_s(self, checkpoint: int, now_s: float) -> float | None:
        then_s = self.as_of_s.get(checkpoint)
        return now_s - then_s if then_s is not None else None

    def plain(self, now_s: float, permit_s: float | None) -> dict[str, Any]:
        """Returns it as plain values.

        Args:
            now_s: host time.
            permit_s: for how long the task may act yet; None or 0: it stands still.
        """
        return {
            "task_id": self.right.task_id,
            "epoch": str(self.tenure.epoch),
            "guard": self.number,
            "lease_s": self.lease_s,
            "permit_s": permit_s or 0.0,
            "copied": self.tenure.original == self.right.epoch,
            "checkpoint": self.tenure.replicated_no(self.guards),
            "age_s": self.age_s(now_s),
            "answering": self.answering(now_s),
            "guardians": [
                {
                    "agent": one.agent,
                    "checkpoint": self.tenure.of(one).no,
                    "age_s": self._age_s(self.tenure.of(one).no, now_s),
                    "silent_s": now_s - self.heard_s[one],
                }
                for one in self.guards.members()
            ],
        }
