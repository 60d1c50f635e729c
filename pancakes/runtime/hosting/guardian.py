"""The guardian: remembers for the owners of tasks, and decides with others which agent may run each of them."""

from __future__ import annotations

from collections import deque
from functools import partial
from typing import Any, Final

import msgspec
from msgspec.structs import replace

from pancakes.control import Checkpoints, Guarding, Take
from pancakes.errors import ControlRefused, MigrationError
from pancakes.mesh.guarding.choosing import CanGuard, MayGuard
from pancakes.mesh.guarding.guard_messages import (
    NO_CHECKPOINT,
    CheckpointId,
    DenyLease,
    GuardAnswer,
    KeepLease,
    LeaseKept,
    SeizeTask,
    YieldLease,
)
from pancakes.mesh.guarding.guardian_core import (
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
from pancakes.mesh.guarding.taking_over import AskLease, HeldUntil, LeaseSeen
from pancakes.mesh.migration.epoch import NO_EPOCH
from pancakes.mesh.migration.guards import forgotten_guards
from pancakes.mesh.migration.messages import is_for
from pancakes.mesh.migration.record import TaskId, Wanted
from pancakes.mesh.migration.snapshot import Snapshot
from pancakes.mesh.net.mesh import Mesh
from pancakes.packet import NETWORK, Fence, Packet, agent_of, join
from pancakes.runtime.hosting import held
from pancakes.runtime.hosting.bidding_messages import BidAwarded, MoveOver
from pancakes.runtime.hosting.deadlines import Deadline, Deadlines
from pancakes.runtime.hosting.host_state import HostState
from pancakes.runtime.hosting.importer import Imported
from pancakes.runtime.hosting.last_said import LastSaid
from pancakes.runtime.hosting.peer_talk import PeerTalk
from pancakes.runtime.hosting.records import Records
from pancakes.runtime.hosting.registers import Registers, RegisterWritten
from pancakes.runtime.hosting.takeover import Takeovers
from pancakes.runtime.kernel.component import Component
from pancakes.runtime.kernel.handlers import on
from pancakes.runtime.kernel.keep import queue
from pancakes.runtime.kernel.tell import tell
from pancakes.runtime.supervision.guardian_messages import AskedOfGuardian, GuardianAnswers

KEEP: Final = queue(1024)
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


class Guardian(Component):
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
        except ControlRefused as error:
            tell(asked.root, GuardianAnswers(asked.request, str(error)))

    def _held(self, asked: Checkpoints) -> list[dict[str, Any]]:
        now_s, rows = self.kernel.host.now(), list(held.of_records(self._records.all().values(), asked))
        for one in self._guarded.values():
            if held.is_meant(asked, one.register.task_id):
                rows += held.of_register(one.register, now_s - one.as_of_s, one.from_disk, asked)
        return [{"agent": self.agent, **row} for row in rows]

    def _kept(self) -> list[_Guarded]:
        return [one for one in self._guarded.values() if self._talk.me in one.register.guards.members()]

    def _to_take(self, body: Take) -> _Guarded:
        """Returns the task that is to be taken over.

        Raises:
            ControlRefused: this agent guards none, or two, of this name; or its owner is not silent.
        """
        kept = {one.register.task_id: one for one in self._kept()}
        found = [one for it, one in kept.items() if it.name == body.task and body.birthplace in ("", it.birthplace)]
        if not found:
            names = ", ".join(map(str, kept)) or "no task"
            raise ControlRefused(f"{self.agent} does not guard {body.task}, but {names}")
        if len(found) > 1:
            names = " and ".join(str(one.register.task_id) for one in found)
            raise ControlRefused(f"{self.agent} guards {names}: say which birthplace is meant")
        (one,) = found
        if one.lease.epoch is not None:
            owner, name = one.lease.epoch.minter, one.register.task_id.name
            hint = f"`pancakes task migrate {owner}/{name}` moves it"
            raise ControlRefused(f"{one.register.task_id} is not taken over: {owner} has a lease on it. {hint}")
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

    @on(NETWORK, KeepLease, keep=KEEP, addressed=True)
    def on_keep(self, packet: Packet) -> None:
        """The owner of a task asks for a lease."""
        self._take(packet)

    @on(NETWORK, SeizeTask, keep=KEEP, addressed=True)
    def on_seize(self, packet: Packet) -> None:
        """An agent is to take a task, and asks for a pledge."""
        self._take(packet)

    @on(NETWORK, YieldLease, keep=KEEP, addressed=True)
    def on_yield(self, packet: Packet) -> None:
        """The owner of a task ends: others may take it at once."""
        one = self._guarded.get(packet.body.task_id)
        speaks = packet.body.epoch.minter == agent_of(packet.source)
        if one is not None and speaks and is_for(packet.body, self._talk.me.journal):
            self._handle(one, packet)

    @on(NETWORK, AskLease, keep=KEEP, addressed=True)
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

    @on(NETWORK, LeaseSeen, keep=KEEP, addressed=True)
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

    @on(NETWORK, MayGuard, keep=KEEP, addressed=True)
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
