"""The guardian: remembers the owners of tasks, and has tasks taken over whose owners are silent.

The guardian belongs to no service: an agent that hosts no tasks may guard those of others. `Takeovers` asks the other
guardians whether the owner is silent there too, then all neighbours for bids, and calls the winner. The rules are in
`guarding`. For people it also lists the checkpoints that this agent holds, and how much it keeps for each peer.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterable, Iterator
from functools import partial
from typing import Any, Final

import msgspec
from msgspec.structs import replace

from pancakes.control import Checkpoints, Guarding, Refusal, Take
from pancakes.durable.arrivals import MOST_IN_DOUBT, MOST_IN_DOUBT_BYTES, MOST_LEFT
from pancakes.durable.bidding_messages import MIGRATOR, AttemptOver, BidAwarded, HasMoved, MoveOver, Negotiate
from pancakes.durable.checkpoints import rules_of
from pancakes.durable.guarding import (
    AnswerAsker,
    GuardEffect,
    GuardEvent,
    GuardRegister,
    GuardsForgotten,
    Lease,
    LeaseOver,
    SetLease,
    WriteRegister,
    handle,
    recover,
)
from pancakes.durable.host_state import HostState, Imported
from pancakes.durable.hosting import Deadline, Deadlines, LastSaid, PeerTalk
from pancakes.durable.messages import (
    NO_CHECKPOINT,
    AskLease,
    CanGuard,
    CheckpointId,
    DenyLease,
    GuardAnswer,
    HeldUntil,
    KeepLease,
    LeaseKept,
    LeaseSeen,
    MayGuard,
    SeizeTask,
    Solicit,
    TakeTask,
    YieldLease,
    is_for,
)
from pancakes.durable.record import (
    NO_EPOCH,
    Epoch,
    GuardianId,
    Guards,
    Phase,
    Record,
    TaskId,
    Wanted,
    forgotten_guards,
    is_out_of_reach,
    newest,
)
from pancakes.durable.snapshot import Snapshot
from pancakes.durable.store import Records, Registers, RegisterWritten
from pancakes.errors import ControlRefusedError, MigrationError
from pancakes.kernel.actor import ActorCore
from pancakes.kernel.handlers import drop_oldest, on
from pancakes.kernel.mailbox import tell
from pancakes.kernel.timer import OneShot
from pancakes.mesh.mesh import Mesh
from pancakes.migration import CostChoice, GuardRule, MigrationRule, is_of_core
from pancakes.packet import NETWORK, Fence, Packet, agent_of, join
from pancakes.supervision.messages import AskedOfGuardian, GuardianAnswers

GUARDIAN: Final = "guardian"
IN_DOUBT: Final = "in doubt"
_KEPT: Final = (Phase.COMMITTED, Phase.PREPARED)


def is_meant(asked: Checkpoints, task_id: TaskId) -> bool:
    """Returns whether a task is asked for."""
    return asked.task in ("", task_id.name) and asked.birthplace in ("", task_id.birthplace)


def of_register(register: GuardRegister, age_s: float, at_least: bool, asked: Checkpoints) -> Iterator[dict[str, Any]]:
    """Yields what a guardian holds of a task, as plain values: one row, or none.

    Args:
        register: what it has on disk.
        age_s: how long ago the task was known to be as the checkpoint says, in host seconds.
        at_least: whether that may be longer ago.
        asked: what is asked for.
    """
    if register.body is None:
        return
    checkpoint = register.checkpoint
    row = _row(register.task_id, register.body.snapshot, checkpoint.epoch, checkpoint.no, asked)
    known = {"held": GUARDIAN, "wanted": register.body.wanted.value, "age_s": age_s, "at_least": at_least}
    sets = [[member.agent for member in members] for members in register.guards.sets]
    seen = max(register.promised, checkpoint.epoch).n
    yield from ({**it, **known, "seen": seen, "guardians": sets, "peer": ""} for it in row)


def of_records(records: Iterable[Record], asked: Checkpoints) -> Iterator[dict[str, Any]]:
    """Yields what an agent holds of tasks whose hand-off is in doubt, as plain values.

    Nothing of such a task is newer than its snapshot, but what it has done on the other agent since.
    """
    for record in records:
        if record.phase not in _KEPT or not is_meant(asked, record.task_id):
            continue
        known = {"held": IN_DOUBT, "wanted": record.wanted.value, "age_s": None, "at_least": True}
        row = _row(record.task_id, record.snapshot, record.offer, 0, asked)
        seen = max(record.seen, record.offer).n
        yield from ({**it, **known, "seen": seen, "guardians": [], "peer": record.peer} for it in row)


def _row(task_id: TaskId, encoded: bytes, epoch: Epoch, no: int, asked: Checkpoints) -> Iterator[dict[str, Any]]:
    try:
        snapshot = Snapshot.decode(encoded)
    except MigrationError:  # what cannot be read is of no use
        return
    row = {"task_id": str(task_id), "type": snapshot.type, "service": snapshot.service}
    body = {"snapshot": encoded} if asked.body else {}
    yield {**row, "epoch": [epoch.n, epoch.minter], "no": no, **body}


RANK_S: Final = 0.15
"""So much later than the guardian before it each guardian looks for a new owner: so that one of them does it."""
CALLED_S: Final = 1.5
"""An agent that was called to take a task has so long to ask for its first lease."""
POLLED_S: Final = 1.0
"""A person who asks is told after this time that too few guardians have answered."""
NEGOTIATED_S: Final = 10.0
"""A negotiation that has not ended by then is forgotten: the Task Migrator was started anew."""


class _Orphan(msgspec.Struct):
    """A task on which no lease runs here.

    Attributes:
        register: what this guardian has of it.
        snapshot: its checkpoint.
        rule: how it is guarded.
        move: when it moves by itself; None: it does not.
        heard_s: when its owner was heard last, in host time.
        held: the newest checkpoint that any of them has.
        promised: the latest epoch that any of them follows.
        guards: the newest guards that any of them knows.
        over: the guardians that say that no lease runs there either.
        asks: how often neighbours were asked for bids.
        negotiating_s: since when, in host time; None: bids are not compared now.
        called: the agent that was called to take it.
        asked: what a person has asked for that waits for an answer; None: nothing.
        told: whether people were told that it waits for a person.
        timer: what comes next.
    """

    register: GuardRegister
    snapshot: Snapshot
    rule: GuardRule
    move: MigrationRule | None
    heard_s: float
    held: HeldUntil
    promised: Epoch
    guards: Guards
    over: set[GuardianId] = set()
    asks: int = 0
    negotiating_s: float | None = None
    called: str = ""
    asked: AskedOfGuardian | None = None
    told: bool = False
    timer: OneShot | None = None


class Takeovers:
    """Looks after the tasks whose leases are over. All in the guardian's actor.

    Args:
        guardian: the guardian.
        talk: how it talks to other agents.
    """

    def __init__(self, guardian: ActorCore, talk: PeerTalk) -> None:
        self._guardian = guardian
        self._talk = talk
        self._orphans: dict[TaskId, _Orphan] = {}
        self._asks = 0

    def lease_ended(self, register: GuardRegister, heard_s: float, held: HeldUntil, wait_s: float) -> None:
        """No lease runs on a task any more.

        Args:
            register: what this guardian has of it.
            heard_s: when its owner was heard last, in host time.
            held: the checkpoint that this guardian has.
            wait_s: for so long no new owner is looked for.
        """
        members = register.guards.members()
        known = self._orphans.get(register.task_id)
        if known is not None and self._talk.me in members:
            # An agent asks for a pledge, which may be the one that was called.
            known.register, known.promised = register, max(known.promised, register.promised)
            self._later(known, wait_s + RANK_S * members.index(self._talk.me))
            return
        self._drop(register.task_id)
        if register.body is None or register.body.wanted is not Wanted.RUNNING or self._talk.me not in members:
            return
        try:
            snapshot, rules = rules_of(register.body.snapshot, register.task_id)
        except MigrationError as error:
            self._guardian.log("error", f"{register.task_id} cannot be taken over: {error}")
            return
        if rules.guard is None:
            return
        orphan = _Orphan(
            register,
            snapshot,
            rules.guard,
            rules.move,
            heard_s,
            held,
            register.promised,
            register.guards,
        )
        self._orphans[register.task_id] = orphan
        self._later(orphan, wait_s + RANK_S * members.index(self._talk.me))

    def lease_runs(self, task_id: TaskId, epoch: Epoch) -> None:
        """A task has an owner again."""
        orphan = self._orphans.get(task_id)
        if orphan is None:
            return
        self._drop(task_id)
        self._answer(orphan, "", {"task_id": str(task_id), "winner": epoch.minter, **self._loss(orphan)})
        if orphan.negotiating_s is None:
            return
        if epoch.minter == orphan.called:
            self._guardian.log("warning", f"{task_id} runs on {epoch.minter}, {self._cause(orphan)}")
            owner = orphan.held.checkpoint.epoch.minter
            told = {"by": epoch.minter, "source_agent": owner, **self._loss(orphan)}
            self._guardian.event("taken_over", task=task_id.name, **told)
            self._guardian.kernel.tell(MIGRATOR, HasMoved(self._guardian, task_id, epoch.minter, str(epoch), None, ""))
        else:
            owned = Refusal("moved", f"{epoch.minter} owns it")
            self._guardian.kernel.tell(MIGRATOR, AttemptOver(self._guardian, task_id, "", owned, None))

    def _cause(self, orphan: _Orphan) -> str:
        silent_s, owner = self._guardian.kernel.host.now() - orphan.heard_s, orphan.held.checkpoint.epoch.minter
        return f"taken over from {owner}, silent for {silent_s:.1f} s; {orphan.held.story()}"

    def _loss(self, orphan: _Orphan) -> dict[str, Any]:
        """Returns what is lost of a task that is taken over, as plain values."""
        checkpoint, silent_s = orphan.held.checkpoint, self._guardian.kernel.host.now() - orphan.heard_s
        name = f"{checkpoint.epoch}/{checkpoint.no}"
        return {"checkpoint": name, "age_s": orphan.held.age_s, "silent_s": silent_s}

    def _drop(self, task_id: TaskId) -> None:
        orphan = self._orphans.pop(task_id, None)
        if orphan is not None and orphan.timer is not None:
            orphan.timer.cancel()

    # Asking the other guardians ---------------------------------------------------------------------------------

    def _later(self, orphan: _Orphan, delay_s: float) -> None:
        if orphan.timer is not None:
            orphan.timer.cancel()
        orphan.timer = self._guardian.after_host(delay_s, partial(self._poll, orphan))

    def _poll(self, orphan: _Orphan) -> None:
        now_s = self._guardian.kernel.host.now()
        if orphan.negotiating_s is not None and now_s - orphan.negotiating_s > NEGOTIATED_S:
            orphan.negotiating_s = None
        orphan.over = {self._talk.me}
        for member in orphan.guards.members():
            if member != self._talk.me:
                self._talk.to_guardian(member, AskLease(orphan.register.task_id))
        members = orphan.register.guards.members()
        self._later(orphan, max(1.0, orphan.rule.lease_s / 2) + RANK_S * members.index(self._talk.me))
        self._look(orphan)

    def seen(self, answer: LeaseSeen) -> None:
        """Another guardian says whether a lease runs there."""
        orphan = self._orphans.get(answer.task_id)
        if orphan is None or answer.guardian not in orphan.guards.members():
            return
        if is_out_of_reach(max(answer.promised, answer.guards.epoch), orphan.register.promised):
            return  # no guardian would pledge itself to an epoch after that one
        orphan.guards = newest(orphan.guards, answer.guards)
        orphan.promised = max(orphan.promised, answer.promised)
        if answer.held.checkpoint > orphan.held.checkpoint:
            orphan.held = answer.held
        if self._talk.me not in orphan.guards.members():
            self._drop(answer.task_id)  # another one has taken its place
            return
        if not answer.runs:
            orphan.over.add(answer.guardian)
        self._look(orphan)

    def put_off(self, task_id: TaskId) -> None:
        """Another guardian asks: it is the one that looks for a new owner, unless it dies too."""
        orphan = self._orphans.get(task_id)
        if orphan is not None and orphan.negotiating_s is None:
            self._later(orphan, max(1.0, orphan.rule.lease_s / 2))

    def _look(self, orphan: _Orphan) -> None:
        if orphan.negotiating_s is not None or not orphan.guards.has_quorum(orphan.over):
            return
        if orphan.rule.takeover == "ask" and orphan.asked is None:
            self._tell_waiting(orphan)
            return
        self._negotiate(orphan)

    def _tell_waiting(self, orphan: _Orphan) -> None:
        if not orphan.told:
            orphan.told = True
            task_id = orphan.register.task_id
            self._guardian.log(
                "warning",
                f"the owner of {task_id} is silent, and the task waits for you: `pancakes task take"
                f" {self._guardian.agent}/{task_id.name}` has another agent run it",
            )
            self._guardian.event("takeover_waits", task=task_id.name)

    # Asking for bids -------------------------------------------------------------------------------------------

    def _negotiate(self, orphan: _Orphan) -> None:
        snapshot, task_id = orphan.snapshot, orphan.register.task_id
        rule = orphan.move
        self._asks += 1
        cost = rule.cost if rule is not None else "tasks"
        request = Solicit(
            task_id,
            self._asks,
            snapshot.type,
            snapshot.version,
            snapshot.service,
            snapshot.requires,
            cost,
            rule.below if rule is not None and rule.when == "battery" else None,
            self._offer(snapshot, cost),
        )
        now_s = self._guardian.kernel.host.now()
        orphan.negotiating_s = now_s
        asked = orphan.asked
        owner, cause = orphan.held.checkpoint.epoch.minter, self._cause(orphan)
        asked_by = asked.request.by if asked is not None else "guardians"
        dry_run = asked is not None and asked.dry_run
        self._guardian.kernel.tell(MIGRATOR, Negotiate(self._guardian, request, asked_by, "", dry_run, owner, cause))

    def _offer(self, snapshot: Snapshot, cost: CostChoice) -> bytes:
        try:
            return b"" if is_of_core(cost) else snapshot.offer()
        except MigrationError as error:
            self._guardian.log("warning", f"bidders for {snapshot.task_id} are told nothing of it: {error}")
            return b""

    def awarded(self, awarded: BidAwarded) -> None:
        """The bids are compared: calls the cheapest bidder."""
        orphan = self._orphans.get(awarded.task_id)
        if orphan is None:
            back = Refusal("conflict", "its owner is back")
            self._guardian.kernel.tell(MIGRATOR, AttemptOver(self._guardian, awarded.task_id, "", back, None))
            return
        orphan.called = awarded.peer
        register = orphan.register
        silent_s = self._guardian.kernel.host.now() - orphan.heard_s
        call = TakeTask(
            register.task_id, register.type, orphan.promised, orphan.guards, orphan.held.checkpoint, silent_s
        )
        self._talk.say(awarded.peer, orphan.snapshot.service, call)
        self._guardian.after_host(CALLED_S, partial(self._look_at_called, orphan, awarded.peer))

    def _look_at_called(self, orphan: _Orphan, peer: str) -> None:
        task_id = orphan.register.task_id
        if self._orphans.get(task_id) is orphan and orphan.called == peer:
            silent = Refusal("unable", f"did not take it within {CALLED_S:g} s")
            self._guardian.kernel.tell(MIGRATOR, AttemptOver(self._guardian, task_id, peer, silent, None))

    def over(self, over: MoveOver) -> None:
        """The negotiation is over, one way or the other."""
        orphan = self._orphans.get(over.task_id)
        if orphan is None:
            return
        orphan.negotiating_s, orphan.called = None, ""
        if orphan.asked is not None:
            self._answer(orphan, over.reason, {**over.result, **self._loss(orphan)} if over.result else None)
            return
        if over.reason and not orphan.told:
            orphan.told = True
            self._guardian.log("warning", f"{over.task_id} runs nowhere, and is not taken over: {over.reason}")

    # What a person asks for -----------------------------------------------------------------------------------

    def take(self, asked: AskedOfGuardian, task_id: TaskId) -> None:
        """A person says that a task is to be taken over.

        Raises:
            ControlRefusedError: it does not wait for that.
        """
        orphan = self._orphans.get(task_id)
        if orphan is None:
            raise ControlRefusedError(f"{task_id} is not to run, as its checkpoint says: there is nothing to take over")
        if orphan.negotiating_s is not None or orphan.asked is not None:
            raise ControlRefusedError(f"{task_id} is being taken over already", "busy")
        orphan.asked = asked
        self._poll(orphan)
        self._guardian.after_host(POLLED_S, partial(self._look_at_polled, orphan))

    def _look_at_polled(self, orphan: _Orphan) -> None:
        if orphan.asked is None or orphan.negotiating_s is not None:
            return
        members = orphan.guards.members()
        silent = ", ".join(sorted(one.agent for one in members if one not in orphan.over))
        known = f"{len(orphan.over)} of its {len(members)} guardians say that its owner is silent"
        self._answer(orphan, f"{orphan.register.task_id} is not taken over: {known}, and not {silent}")

    def _answer(self, orphan: _Orphan, reason: str, result: Any = None) -> None:
        asked, orphan.asked = orphan.asked, None
        if asked is not None:
            tell(asked.root, GuardianAnswers(asked.request, Refusal.if_any(reason), result))


KEEP: Final = drop_oldest(1024)
"""What falls out is said again."""
MOST_WAIT: Final = 16
"""So much may wait for the disk of what is said of one task; what falls out is said again."""
PLEDGED_S: Final = 1.0
"""For so long no other owner is looked for than the agent that was given a pledge, or the task."""
MOST_TASKS: Final = 1024
"""An agent guards so many tasks of one peer at most, ..."""
MOST_BYTES: Final = 64 * 1024 * 1024
"""... and so many bytes of their checkpoints."""
MOST_FORGOTTEN: Final = 16_384
"""Of so many tasks of one peer that were removed an agent remembers that they were; it guards no new ones then."""


class _Guarded(msgspec.Struct):
    """One task that is guarded here.

    Attributes:
        register: what is on disk of it.
        alarm: feeds the end of the newest lease on it.
        lease: that lease.
        asker: the address that is to have the answers of the event that is being dealt with.
        effects: what is still to be carried out of that event.
        writing: the register that is being written; None: none is.
        waiting: the events that wait, each with the address that asked.
        event: the event that is being dealt with.
        heard_s: when the owner was heard last, in host time.
        as_of_s: when the task was known last to be as the checkpoint says, in host time.
        from_disk: whether the checkpoint is from before this guardian began, and so may be older than that.
        told: the newest checkpoint that its owners have told of, also where the disk had no room for it.
    """

    register: GuardRegister
    alarm: Deadline
    lease: Lease
    asker: str = ""
    effects: deque[GuardEffect] = msgspec.field(default_factory=deque)
    writing: GuardRegister | None = None
    waiting: list[tuple[str, GuardEvent]] = msgspec.field(default_factory=list)
    event: GuardEvent | None = None
    heard_s: float = 0.0
    as_of_s: float = 0.0
    from_disk: bool = False
    told: CheckpointId = NO_CHECKPOINT


class Guardian(ActorCore):
    """Answers the owners of tasks, and the agents that are to take them (docs/protocol.md, guardians).

    It belongs to no service: an agent that hosts no task may guard those of others.

    Args:
        registers: what it has on disk.
        records: what this agent has on disk of the tasks that it hosts, or has hosted.
        mesh: says what neighbours there are.
        state: says what this agent could be to a task.
    """

    def __init__(
        self, *args: Any, registers: Registers, records: Records, mesh: Mesh, state: HostState, **others: Any
    ) -> None:
        super().__init__(*args, **others)
        self._registers = registers
        self._records = records
        self._state = state
        state.register_of = registers.get
        self._talk = PeerTalk(self, mesh)
        self._takeovers = Takeovers(self, self._talk)
        self._deadlines = Deadlines(self.after_host, self.kernel.host.now)
        self._guarded: dict[TaskId, _Guarded] = {}
        self._refused = LastSaid()  # why a peer was refused

    def on_start(self) -> None:
        self._began_s = self.kernel.host.now()
        for task, why in self._registers.lost().items():
            self.log("error", f"{self.agent} guards {task!a} no more, as it may have forgotten a pledge: {why}")
        if of_original := self._registers.of_original():
            names = ", ".join(map(str, of_original))
            self.log("warning", f"{self.agent} guards {names} anew: its disk is a copy, and lacks later pledges")
        for register in self._registers.all():
            one = self._new(register)
            one.heard_s = one.as_of_s = self._began_s
            one.from_disk = True
            record = self._records.get(register.task_id)
            if record is not None and record.removed:  # its guardians may not have been told before this agent ended
                one.waiting.append(("", GuardsForgotten(forgotten_guards(record.epoch))))
            one.effects.extend(recover(register, self._talk.boot))
            self._go_on(one)

    def take_message(self, message: Any) -> Any:
        match message:
            case RegisterWritten():
                self._written(message)
            case Imported():
                self.on_may_guard(message.waiting)
            case BidAwarded():
                self._takeovers.awarded(message)
            case MoveOver():
                self._takeovers.over(message)
            case AskedOfGuardian():
                self._asked(message)
            case _:
                return super().take_message(message)
        return None

    def _asked(self, asked: AskedOfGuardian) -> None:
        try:
            if isinstance(asked.body, Guarding):
                tell(asked.root, GuardianAnswers(asked.request, result=[self._row(one) for one in self._kept()]))
            elif isinstance(asked.body, Checkpoints):
                tell(asked.root, GuardianAnswers(asked.request, result=self._held(asked.body)))
            else:
                self._takeovers.take(asked, self._to_take(asked.body).register.task_id)
        except ControlRefusedError as error:
            tell(asked.root, GuardianAnswers(asked.request, Refusal.of(error)))

    def _held(self, asked: Checkpoints) -> list[dict[str, Any]]:
        now_s, rows = self.kernel.host.now(), list(of_records(self._records.all().values(), asked))
        for one in self._guarded.values():
            if is_meant(asked, one.register.task_id):
                rows += of_register(one.register, now_s - one.as_of_s, one.from_disk, asked)
        return [{"agent": self.agent, **row} for row in rows]

    def _kept(self) -> list[_Guarded]:
        return [one for one in self._guarded.values() if self._talk.me in one.register.guards.members()]

    def _to_take(self, body: Take) -> _Guarded:
        """Returns the task that is to be taken over.

        Raises:
            ControlRefusedError: this agent guards none, or two, of this name; or its owner is not silent.
        """
        kept = {one.register.task_id: one for one in self._kept()}
        found = [one for it, one in kept.items() if it.name == body.task and body.birthplace in ("", it.birthplace)]
        if not found:
            names = ", ".join(map(str, kept)) or "no task"
            raise ControlRefusedError(f"{self.agent} does not guard {body.task}, but {names}", "not_found")
        if len(found) > 1:
            names = " and ".join(str(one.register.task_id) for one in found)
            raise ControlRefusedError(f"{self.agent} guards {names}: say which birthplace is meant", "ambiguous")
        (one,) = found
        if one.lease.epoch is not None:
            owner, name = one.lease.epoch.minter, one.register.task_id.name
            hint = f"`pancakes task migrate {owner}/{name}` moves it"
            raise ControlRefusedError(f"{one.register.task_id} is not taken over: {owner} has a lease on it. {hint}")
        return one

    def _row(self, one: _Guarded) -> dict[str, Any]:
        """Returns what is to be known about a task that is guarded here, as plain values."""
        register, now_s = one.register, self.kernel.host.now()
        owner = register.promised.minter
        row = {
            "task_id": str(register.task_id),
            "agent": self.agent,
            "owner": owner,
            "epoch": str(register.promised),
            "checkpoint": register.checkpoint.no,
            "age_s": now_s - one.as_of_s,
            "silent_s": now_s - one.heard_s,
            "lease": one.lease.epoch is not None,
            "lease_left_s": max(0.0, one.alarm.due_s - now_s) if one.lease.epoch is not None else None,
            "wanted": register.body is not None and register.body.wanted is Wanted.RUNNING,
        }
        if owner != self.agent or register.body is None:
            return row
        try:
            snapshot = Snapshot.decode(register.body.snapshot)
        except MigrationError:  # where the task is started, that is said
            return row
        permits = self.kernel.permits
        address = join(self.agent, snapshot.service, register.task_id.name)
        return {
            **row,
            "guardians": [member.agent for member in register.guards.members()],
            "guard": snapshot.guard["guard"] if snapshot.guard is not None else 1,
            "permit_s": permits.left_s(Fence(str(register.task_id), register.promised)),
            "held_back": permits.held_back(str(register.task_id)),
            "clock_steps": permits.steps(str(register.task_id)),
            "no_dead_man": self.kernel.registry.without_dead_man(address),
        }

    def _written(self, message: RegisterWritten) -> None:
        one = self._guarded[message.task_id]
        written, one.writing = one.writing, None
        if message.why_not:
            one.effects.clear()  # as after a crash: nothing of it has happened, and nothing was promised
        elif written is not None:
            lease_s, one.register = one.register.lease_s, written
            if written.lease_s != lease_s:
                self._note_shortest()
        self._go_on(one)

    def _new(self, register: GuardRegister) -> _Guarded:
        alarm = self._deadlines.new(partial(self._lease_over, register.task_id))
        one = self._guarded[register.task_id] = _Guarded(register, alarm, Lease(boot=self._talk.boot))
        return one

    @on(NETWORK, KeepLease, queue=KEEP, addressed=True)
    def on_keep(self, packet: Packet) -> None:
        """The owner of a task asks for a lease."""
        self._take(packet)

    @on(NETWORK, SeizeTask, queue=KEEP, addressed=True)
    def on_seize(self, packet: Packet) -> None:
        """An agent is to take a task, and asks for a pledge."""
        self._take(packet)

    @on(NETWORK, YieldLease, queue=KEEP, addressed=True)
    def on_yield(self, packet: Packet) -> None:
        """The owner of a task ends: others may take it at once."""
        one = self._guarded.get(packet.body.task_id)
        speaks = packet.body.epoch.minter == agent_of(packet.source)
        if one is not None and speaks and is_for(packet.body, self._talk.me.journal):
            self._handle(one, packet)

    @on(NETWORK, AskLease, queue=KEEP, addressed=True)
    def on_ask_lease(self, packet: Packet) -> None:
        """Another guardian of a task looks for a new owner."""
        one = self._guarded.get(packet.body.task_id)
        if one is None or not is_for(packet.body, self._talk.me.journal):
            return
        peer, register = agent_of(packet.source), one.register
        if register.guards.forgotten:
            self._say(
                packet.source, LeaseSeen(register.task_id, self._talk.me, False, register.promised, register.guards)
            )
            return
        if peer not in {member.agent for member in register.guards.members()}:
            return
        self._takeovers.put_off(register.task_id)
        runs = one.lease.epoch is not None
        seen = LeaseSeen(
            register.task_id, self._talk.me, runs, register.promised, register.guards, self._held_until(one)
        )
        self._say(packet.source, seen)

    @on(NETWORK, LeaseSeen, queue=KEEP, addressed=True)
    def on_lease_seen(self, packet: Packet) -> None:
        """Another guardian says whether a lease runs there."""
        told = packet.body
        if told.guardian.agent == agent_of(packet.source) and is_for(told, self._talk.me.journal):
            self._takeovers.seen(told)
            one = self._guarded.get(told.task_id)
            members = one.register.guards.members() if one is not None else ()
            if one is not None and told.guards.forgotten and told.guardian in members and one.lease.epoch is None:
                if len(one.waiting) < MOST_WAIT:
                    one.waiting.append(("", GuardsForgotten(told.guards)))
                self._go_on(one)

    @on(NETWORK, MayGuard, queue=KEEP, addressed=True)
    def on_may_guard(self, packet: Packet) -> None:
        """The owner of a task looks for guardians."""
        asked, peer = packet.body, agent_of(packet.source)
        if not is_for(asked, self._talk.me.journal):
            return
        if self._state.hosts() and self._state.imports_first(self, peer, asked.type, packet):
            return
        access = self.kernel.access
        refusal = access.fault(peer, "guard", asked.type) or access.fault(peer, "host", asked.type)
        if not refusal and str(asked.task_id) in self._registers.lost():
            refusal = f"{self.agent} has lost what it knew of it"
        answer = CanGuard(
            asked.task_id,
            self._talk.me,
            refusal,
            not refusal and self._state.runs(asked.type),
            "battery" in self.kernel.registry.device_types(),
            self.kernel.host.now() - self._began_s,
        )
        self._say(packet.source, answer)

    def _take(self, packet: Packet) -> None:
        asked: KeepLease | SeizeTask = packet.body
        peer = agent_of(packet.source)
        if not is_for(asked, self._talk.me.journal):
            return
        if fault := self._fault(peer, asked):
            if self._refused.is_news(peer, fault):
                self.log("warning", f"{self.agent} does not guard {asked.task_id} for {peer}: {fault}")
            self._say(packet.source, DenyLease(asked.task_id, asked.epoch, self._talk.me, NO_EPOCH, fault))
            return
        one = self._guarded.get(asked.task_id) or self._new(GuardRegister(asked.task_id))
        if isinstance(asked, KeepLease):  # a newer one says all that an older one says
            one.waiting = [it for it in one.waiting if it[0] != packet.source or not isinstance(it[1], KeepLease)]
            if asked.checkpoint.epoch == asked.epoch:
                one.told = max(one.told, asked.checkpoint)
        self._handle(one, packet)
        if one.register.blank and one.writing is None:
            del self._guarded[asked.task_id]  # it was refused

    def _handle(self, one: _Guarded, packet: Packet) -> None:
        if len(one.waiting) < MOST_WAIT:
            one.waiting.append((packet.source, packet.body))
        self._go_on(one)

    def _fault(self, peer: str, asked: KeepLease | SeizeTask) -> str:
        """Returns why a peer has no right to what it asks for, as a clause; empty: it has."""
        task_id, known = asked.task_id, self._guarded.get(asked.task_id)
        if asked.epoch.minter != peer:
            return f"the epoch {asked.epoch} is not of its making, and each agent speaks for itself alone"
        if known is not None and known.register.type not in ("", asked.type):
            return f"it is a {known.register.type}, and no {asked.type}"
        access = self.kernel.access
        if fault := access.fault(peer, "guard", asked.type) or access.fault(peer, "host", asked.type):
            return fault
        if str(task_id) in self._registers.lost():
            return f"{self.agent} has lost what it knew of it, and may have forgotten a pledge"
        return self._lacks_room(peer, asked)

    def _lacks_room(self, peer: str, asked: KeepLease | SeizeTask) -> str:
        body, known = asked.body if isinstance(asked, KeepLease) else None, self._guarded.get(asked.task_id)
        if known is not None and known.register.promised.minter == peer:
            if body is None or len(body.snapshot) <= _bytes_of(known.register):
                return ""  # it takes no more than before
        registers = (it.register for it in self._guarded.values())
        of_peer = [it for it in registers if it.promised.minter == peer]
        theirs = [it for it in of_peer if not it.guards.forgotten]
        if asked.task_id not in self._guarded:
            if len(theirs) >= MOST_TASKS:
                return f"{self.agent} guards {MOST_TASKS} tasks of {peer} already"
            if len(of_peer) - len(theirs) >= MOST_FORGOTTEN:
                return f"{self.agent} remembers {MOST_FORGOTTEN} removed tasks of {peer}, and takes no new one"
        others = sum(_bytes_of(it) for it in theirs if it.task_id != asked.task_id)
        if body is not None and others and others + len(body.snapshot) > MOST_BYTES:
            return f"the checkpoints of {peer} would take more than {MOST_BYTES // 2**20} MiB on {self.agent}"
        return ""

    # Deciding --------------------------------------------------------------------------------------------------

    def _go_on(self, one: _Guarded) -> None:
        """Goes on with a task, until something waits for the disk."""
        while one.writing is None and (one.effects or one.waiting):
            if one.effects:
                self._carry_out(one, one.effects.popleft())
            else:
                one.asker, event = one.waiting.pop(0)
                one.event = event
                one.effects.extend(handle(self._talk.me, one.register, one.lease, event))

    def _carry_out(self, one: _Guarded, effect: GuardEffect) -> None:
        match effect:
            case WriteRegister(register):
                one.writing = register
                self._registers.write(register, self)
            case SetLease(lease, lease_s):
                began_or_ended = (one.lease.epoch is None) is not (lease.epoch is None)
                one.lease = lease
                if began_or_ended:
                    self._note_shortest()
                if lease.epoch is None:
                    one.alarm.cancel()
                    # An agent that was given a pledge, or the task, is about to be the owner.
                    given = isinstance(one.event, YieldLease) and one.event.given
                    wait_s = PLEDGED_S if given or isinstance(one.event, SeizeTask) else 0.0
                    self._takeovers.lease_ended(one.register, one.heard_s, self._held_until(one), wait_s)
                else:
                    if one.event is not None:
                        one.heard_s = self.kernel.host.now()
                        self._takeovers.lease_runs(one.register.task_id, lease.epoch)
                    one.alarm.set(lease_s)
            case AnswerAsker(message):
                if isinstance(message, LeaseKept):
                    told = one.told.no if one.told.epoch == message.epoch else -1
                    message = replace(message, told=told)
                self._note_age(one, message)
                self._say(one.asker, message)

    def _note_shortest(self) -> None:
        """Keeps true for how long this agent may be silent."""
        leased = [one.register for one in self._guarded.values() if one.lease.epoch is not None]
        self._state.shortest_lease = min(leased, key=lambda it: (it.lease_s, it.task_id), default=None)

    def _held_until(self, one: _Guarded) -> HeldUntil:
        age_s = None if one.from_disk else max(0.0, one.heard_s - one.as_of_s)
        return HeldUntil(one.register.checkpoint, age_s)

    def _note_age(self, one: _Guarded, answer: GuardAnswer) -> None:
        """The owner has said how old its newest checkpoint is; that counts where this guardian has that one."""
        keep = one.event
        if isinstance(answer, LeaseKept) and isinstance(keep, KeepLease):
            if keep.checkpoint == one.register.checkpoint:
                one.as_of_s, one.from_disk = self.kernel.host.now() - keep.age_s, False

    def _lease_over(self, task_id: TaskId) -> None:
        one = self._guarded[task_id]
        one.waiting.append(("", LeaseOver(one.lease.number)))
        self._go_on(one)

    def _say(self, asker: str, message: GuardAnswer | LeaseSeen | CanGuard) -> None:
        peer, _, place = asker.partition("/")
        self._talk.say(peer, place, message)


def _bytes_of(register: GuardRegister) -> int:
    return len(register.body.snapshot) if register.body is not None else 0


BROUGHT_IN_DOUBT = "in doubt"
"""Tasks that a peer has brought and not handed over."""


def kept_of_peers(agent: str, records: Iterable[Record], registers: Iterable[GuardRegister]) -> list[dict[str, Any]]:
    """Returns a row for each peer and kind of thing, with how much of its room is taken, as plain values.

    Args:
        agent: the agent itself, which is no peer.
        records: what it has on disk of tasks.
        registers: what it has on disk as a guardian.
    """
    counts: Counter[tuple[str, str]] = Counter()
    sizes: Counter[tuple[str, str]] = Counter()
    for record in records:
        if record.phase is Phase.PREPARED:
            counts[record.peer, BROUGHT_IN_DOUBT] += 1
            sizes[record.peer, BROUGHT_IN_DOUBT] += len(record.snapshot)
        elif record.phase is Phase.ABSENT and record.peer:
            counts[record.peer, "taken back"] += 1
    for register in registers:
        kind = "removed" if register.guards.forgotten else "guarded"
        counts[register.promised.minter, kind] += 1
        sizes[register.promised.minter, kind] += len(register.body.snapshot) if register.body is not None else 0
    most = {
        BROUGHT_IN_DOUBT: (MOST_IN_DOUBT, MOST_IN_DOUBT_BYTES),
        "taken back": (MOST_LEFT, 0),
        "guarded": (MOST_TASKS, MOST_BYTES),
        "removed": (MOST_FORGOTTEN, 0),
    }
    rows = []
    for (peer, kind), count in sorted(counts.items()):
        most_count, most_bytes = most[kind]
        share = max(count / most_count, sizes[peer, kind] / most_bytes if most_bytes else 0.0)
        if peer not in ("", agent):
            rows.append({"peer": peer, "kind": kind, "count": count, "bytes": sizes[peer, kind], "share": share})
    return rows
