"""Has tasks taken over whose owners are silent. In the registrar.

A member whose lease is over asks the other members whether the owner is silent there too (`WhoHas`), then all
neighbours for bids, and calls the agent that made the lowest. That agent asks for promises, by the rules. No safety
hangs on anything here.
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any, Final

import msgspec

from pancakes.control import Checkpoints, Guarding, Refusal, Take
from pancakes.durable import messages, rules
from pancakes.durable.bidding_messages import MIGRATOR, AttemptOver, BidAwarded, HasMoved, MoveOver, Negotiate
from pancakes.durable.entry import Entry, Fed, right_of
from pancakes.durable.messages import REGISTRAR, Fact, WhoHas, is_for
from pancakes.durable.origins import Origins
from pancakes.durable.peer_talk import LastSaid
from pancakes.durable.record import TaskId
from pancakes.durable.register import (
    ANYONE,
    NO_EPOCH,
    Epoch,
    Identity,
    Register,
    Sets,
    Standing,
    Wanted,
    is_quorum,
    members_in,
)
from pancakes.durable.rules import MOST_STEP
from pancakes.durable.snapshot import Snapshot, rules_of
from pancakes.errors import ControlRefusedError, MigrationError
from pancakes.kernel.mailbox import tell
from pancakes.kernel.timer import OneShot
from pancakes.migration import GuardRule, MigrationRule
from pancakes.packet import Packet, agent_of, join
from pancakes.supervision.messages import AskedOfGuardian, GuardianAnswers

if TYPE_CHECKING:
    from pancakes.durable.registrar import Registrar

GUARDIAN: Final = "guardian"
IN_DOUBT: Final = "in doubt"
RANK_S: Final = 0.15
"""Each member looks for a new owner this much later than the member before it, so that one of them does it."""
PROMISED_S: Final = 1.0
"""For this long no other owner is looked for than the agent that was promised the task."""
CALLED_S: Final = 1.5
"""An agent that was called to take a task has this long to ask for its first lease."""
POLLED_S: Final = 1.0
"""A person who asks is told after this time that too few members have answered."""
NEGOTIATED_S: Final = 10.0
"""A negotiation that has not ended by then is forgotten: the Task Migrator was started again."""
MOST_CALLED: Final = 64
"""At most this many tasks are being taken at once; members call again."""
GIVEN_UP_S: Final = 3.0
"""A task that this agent was called to take is left to others after this time."""
AGAIN_S: Final = 0.25
"""How often members that have not answered are asked again, in host time."""


class _Orphan(msgspec.Struct):
    """A task on which no lease runs here.

    Attributes:
        snapshot: its checkpoint.
        rule: how it is guarded.
        move: when it migrates by itself; None: it does not.
        held: the newest write that any member has, and how old that was at the owner's last word, in host seconds.
        floor: the highest epoch that any member follows.
        sets: the newest members that any of them knows, and under which write.
        over: the members that say that no lease runs there either.
        negotiating_s: since when, in host time; None: bids are not compared now.
        asked: what a person has asked for that waits for an answer; None: nothing.
        told: whether people were told that it waits for a person.
        timer: what comes next.
    """

    snapshot: Snapshot
    rule: GuardRule
    move: MigrationRule | None
    held: tuple[Register, float | None]
    floor: Epoch
    sets: Sets
    over: set[Identity] = set()
    negotiating_s: float | None = None
    asked: AskedOfGuardian | None = None
    told: bool = False
    timer: OneShot | None = None


class Takeovers:
    """Looks after tasks whose leases are over, and those that this agent is called to take. In the registrar's actor.

    Args:
        registrar: the registrar.
    """

    def __init__(self, registrar: Registrar) -> None:
        self._registrar = registrar
        self._orphans: dict[TaskId, _Orphan] = {}
        self._asks = 0
        self._called = 0
        self._unbelieved = LastSaid()
        self.origins = Origins(registrar, registrar.records, registrar.talk.neighbours)

    # Leases that are granted here ------------------------------------------------------------------------------

    def lease_ended(self, entry: Entry, promised: bool) -> None:
        """No lease runs on a task any more; `promised`: as it was promised to an agent, or its owner said goodbye."""
        registrar, record = self._registrar, entry.record
        register, me, task_id = record.register, registrar.me, record.task_id
        wait_s = PROMISED_S if promised and register.heir != ANYONE else 0.0
        members = members_in(register.sets)
        known = self._orphans.get(task_id)
        if known is not None and me in members:
            known.floor = max(known.floor, record.seen)
            self._later(task_id, known, wait_s + RANK_S * members.index(me))
            return
        self._drop(task_id)
        if register.state is None or register.wanted is not Wanted.RUNNING or me not in members or register.unguarded:
            return
        try:
            snapshot, found = rules_of(register.state, task_id)
        except MigrationError as error:
            registrar.log("error", f"{task_id} cannot be taken over: {error}")
            return
        if found.guard is None:
            return
        age_s = None if entry.from_disk else max(0.0, entry.heard_s - entry.as_of_s)
        held = (register.summary(), age_s)
        orphan = _Orphan(snapshot, found.guard, found.move, held, record.seen, register.sets)
        self._orphans[task_id], entry.called = orphan, ""
        self._later(task_id, orphan, wait_s + RANK_S * members.index(me))

    def lease_runs(self, entry: Entry, epoch: Epoch) -> None:
        """A task has an owner again."""
        registrar, task_id = self._registrar, entry.record.task_id
        orphan = self._orphans.get(task_id)
        if orphan is None:
            return
        self._drop(task_id)
        winner = epoch.minter.agent
        loss = self._loss(entry, orphan)
        self._answer(orphan, "", {"task_id": str(task_id), "winner": winner, **loss})
        if orphan.negotiating_s is None:
            return
        if winner == entry.called:
            registrar.log("warning", f"{task_id} runs on {winner}, {self._cause(entry, orphan)}")
            owner = orphan.held[0].owner.agent
            registrar.event("taken_over", task=task_id.name, by=winner, source_agent=owner, **loss)
            registrar.kernel.tell(MIGRATOR, HasMoved(registrar, task_id, winner, str(epoch), None, ""))
        else:
            owned = Refusal("moved", f"{winner} owns it")
            registrar.kernel.tell(MIGRATOR, AttemptOver(registrar, task_id, "", owned, None))

    def _silent_s(self, entry: Entry) -> float:
        return self._registrar.kernel.host.now() - entry.heard_s

    def _cause(self, entry: Entry, orphan: _Orphan) -> str:
        register, age_s = orphan.held
        age = f"{age_s:.1f} s old" if age_s is not None else "of an age that is not known"
        story = f"checkpoint {register.epoch}/{register.no}, {age} at its last word"
        return f"taken over from {register.owner}, silent for {self._silent_s(entry):.1f} s; {story}"

    def _loss(self, entry: Entry, orphan: _Orphan) -> dict[str, Any]:
        """Return what is lost of a task that is taken over, as plain values."""
        register, age_s = orphan.held
        return {"checkpoint": f"{register.epoch}/{register.no}", "age_s": age_s, "silent_s": self._silent_s(entry)}

    def _drop(self, task_id: TaskId) -> None:
        orphan = self._orphans.pop(task_id, None)
        if orphan is not None and orphan.timer is not None:
            orphan.timer.cancel()

    # Asking the other members ----------------------------------------------------------------------------------

    def _later(self, task_id: TaskId, orphan: _Orphan, delay_s: float) -> None:
        if orphan.timer is not None:
            orphan.timer.cancel()
        orphan.timer = self._registrar.after_host(delay_s, partial(self._poll, task_id, orphan))

    def _poll(self, task_id: TaskId, orphan: _Orphan) -> None:
        registrar, entry = self._registrar, self._registrar.entries.get(task_id)
        if entry is None or self._orphans.get(task_id) is not orphan:
            return
        now_s = registrar.kernel.host.now()
        if orphan.negotiating_s is not None and now_s - orphan.negotiating_s > NEGOTIATED_S:
            orphan.negotiating_s = None
        orphan.over = {registrar.me}
        for member in members_in(orphan.sets):
            if member != registrar.me and registrar.talk.connected(member.agent):
                registrar.talk.tell(member.agent, REGISTRAR, WhoHas((task_id,), silent=True))
        members = entry.record.members
        rank = members.index(registrar.me) if registrar.me in members else 0
        self._later(task_id, orphan, max(1.0, orphan.rule.lease_s / 2) + RANK_S * rank)
        self._look(task_id, entry, orphan)

    def asks(self, peer: str, task_id: TaskId) -> None:
        """Another member asks: it is the one that looks for a new owner, unless it dies too."""
        orphan = self._orphans.get(task_id)
        is_member = orphan is not None and peer in {it.agent for it in members_in(orphan.sets)}
        if orphan is not None and is_member and orphan.negotiating_s is None:
            self._later(task_id, orphan, max(1.0, orphan.rule.lease_s / 2))

    def seen(self, by: Identity, fact: Fact) -> None:
        """Another member says what it knows."""
        task_id = fact.task_id
        orphan, entry = self._orphans.get(task_id), self._registrar.entries.get(task_id)
        if orphan is None or entry is None or by not in members_in(orphan.sets):
            return
        if fact.epoch.n > entry.record.seen.n + MOST_STEP:
            return
        register = fact.register
        if register.stamp > orphan.held[0].stamp:
            orphan.held, orphan.sets = (register, fact.age_s), register.sets or orphan.sets
        orphan.floor = max(orphan.floor, fact.epoch)
        if register.wanted is not Wanted.RUNNING and register.stamp >= orphan.held[0].stamp:
            self._drop(task_id)
            return
        if self._registrar.me not in members_in(orphan.sets):
            self._drop(task_id)  # another one has taken its place
            return
        if not fact.lease:
            orphan.over.add(by)
        self._look(task_id, entry, orphan)

    def _look(self, task_id: TaskId, entry: Entry, orphan: _Orphan) -> None:
        if orphan.negotiating_s is not None or not is_quorum(orphan.sets, orphan.over):
            return
        if orphan.rule.takeover == "ask" and orphan.asked is None:
            self._tell_waiting(task_id, orphan)
            return
        self._negotiate(task_id, entry, orphan)

    def _tell_waiting(self, task_id: TaskId, orphan: _Orphan) -> None:
        if not orphan.told:
            orphan.told = True
            self._registrar.log(
                "warning",
                f"the owner of {task_id} is silent, and the task waits for you: `pancakes task recover"
                f" {self._registrar.agent}/{task_id.name}` has another agent run it",
            )
            self._registrar.event("takeover_waits", task=task_id.name)

    # Asking for bids -------------------------------------------------------------------------------------------

    def _negotiate(self, task_id: TaskId, entry: Entry, orphan: _Orphan) -> None:
        registrar, snapshot, move = self._registrar, orphan.snapshot, orphan.move
        self._asks += 1
        cost = move.cost if move is not None else "tasks"
        try:
            request = snapshot.solicit(self._asks, cost, move)
        except MigrationError as error:
            registrar.log("warning", f"bidders for {task_id} are told nothing of it: {error}")
            request = snapshot.solicit(self._asks, cost, move, tells=False)
        orphan.negotiating_s = registrar.kernel.host.now()
        asked, owner = orphan.asked, orphan.held[0].owner.agent
        asked_by = asked.request.by if asked is not None else "guardians"
        dry_run = asked is not None and asked.dry_run
        cause = self._cause(entry, orphan)
        registrar.kernel.tell(MIGRATOR, Negotiate(registrar, request, asked_by, "", dry_run, owner, cause))

    def awarded(self, awarded: BidAwarded) -> None:
        """The bids are compared: calls the agent that made the lowest."""
        registrar, task_id = self._registrar, awarded.task_id
        orphan, entry = self._orphans.get(task_id), self._registrar.entries.get(awarded.task_id)
        if orphan is None or entry is None:
            back = Refusal("conflict", "its owner is back")
            registrar.kernel.tell(MIGRATOR, AttemptOver(registrar, task_id, "", back, None))
            return
        entry.called = awarded.peer
        call = messages.Call(
            task_id, entry.record.type, orphan.snapshot.service, orphan.floor, orphan.sets, self._silent_s(entry)
        )
        if awarded.peer == registrar.agent:
            self._begin(entry, registrar.agent, call)
        else:
            registrar.talk.say(awarded.peer, REGISTRAR, call)
        registrar.after_host(CALLED_S, partial(self._look_at_called, entry, orphan, awarded.peer))

    def _look_at_called(self, entry: Entry, orphan: _Orphan, peer: str) -> None:
        task_id = entry.record.task_id
        if self._orphans.get(task_id) is orphan and entry.called == peer:
            silent = Refusal("unable", f"did not take it within {CALLED_S:g} s")
            self._registrar.kernel.tell(MIGRATOR, AttemptOver(self._registrar, task_id, peer, silent, None))

    def over(self, over: MoveOver) -> None:
        """The negotiation is over, one way or the other."""
        orphan, entry = self._orphans.get(over.task_id), self._registrar.entries.get(over.task_id)
        if orphan is None or entry is None:
            return
        orphan.negotiating_s, entry.called = None, ""
        if orphan.asked is not None:
            self._answer(orphan, over.reason, {**over.result, **self._loss(entry, orphan)} if over.result else None)
            return
        if over.reason and not orphan.told:
            orphan.told = True
            self._registrar.log("warning", f"{over.task_id} runs nowhere, and is not taken over: {over.reason}")

    # Being called ----------------------------------------------------------------------------------------------

    def called(self, packet: Packet) -> None:
        """A member has this agent take a task. It is believed only from a member, as far as that is known here."""
        registrar, call, peer = self._registrar, packet.body, agent_of(packet.source)
        if not is_for(call, registrar.me.journal) or registrar.kernel.access.fault(peer, "guard", call.type):
            return
        if registrar.records.service_of(call.task_id) not in ("", call.service):
            return
        if registrar.records.lost(call.task_id) is not None:
            return
        entry = registrar.entries.get(call.task_id)
        members = entry.record.members if entry is not None and registrar.me in entry.record.members else []
        known = members or members_in(call.sets)
        if peer not in {it.agent for it in known}:
            self._not_believed(peer, call.task_id, f"{peer} does not guard it")
            return
        if entry is not None and entry.record.here and not entry.record.guarded:
            self._not_believed(peer, call.task_id, f"it is {entry.record.standing.value} here, and not guarded")
            return
        if members:  # it asks those that it knows
            self._let_take(packet, None)
        else:
            self.origins.judge(packet, self._let_take)

    def _let_take(self, packet: Packet, refusal: Refusal | None) -> None:
        """Take a task, unless the agents that must know where it is say that its owner acts."""
        call, peer = packet.body, agent_of(packet.source)
        if refusal is not None:
            self._not_believed(peer, call.task_id, refusal.text)
        elif self._called < MOST_CALLED:
            self._begin(self._registrar.known(call.task_id, call.type), peer, call)

    def _begin(self, entry: Entry, peer: str, call: messages.Call) -> None:
        registrar = self._registrar
        if entry.memory.taking != NO_EPOCH:
            return
        if not entry.record.service:
            entry.service = call.service  # not in the record: another one may be on its way to the disk
        self._called += 1
        registrar.event("task_called", task=call.task_id.name, silent_s=call.silent_s)
        registrar.feed(entry, Fed(rules.Call(call.floor, call.sets), peer))
        until_s = registrar.kernel.host.now() + GIVEN_UP_S
        registrar.after_host(AGAIN_S, partial(self._again, entry, until_s))

    def _again(self, entry: Entry, until_s: float) -> None:
        registrar, record = self._registrar, entry.record
        if entry.memory.taking == NO_EPOCH:
            self._called -= 1
        elif registrar.kernel.host.now() < until_s:
            registrar.after_host(AGAIN_S, partial(self._again, entry, until_s))
        else:
            self._called -= 1
            if record.standing is not Standing.HEIR:
                registrar.stop_taking(entry)

    def _not_believed(self, peer: str, task_id: TaskId, why: str) -> None:
        if self._unbelieved.is_news(peer, f"{task_id} {why}"):
            text = f"{peer} says that {task_id} should be taken over, and is not believed: {why}"
            self._registrar.log("warning", text)

    # What a person asks for ------------------------------------------------------------------------------------

    def asked(self, asked: AskedOfGuardian) -> None:
        """A person asks for something."""
        try:
            if isinstance(asked.body, Guarding):
                tell(asked.root, GuardianAnswers(asked.request, result=[self._row(it) for it in self._shown()]))
            elif isinstance(asked.body, Checkpoints):
                tell(asked.root, GuardianAnswers(asked.request, result=self._held(asked.body)))
            else:
                self._take(asked, self._to_take(asked.body))
        except ControlRefusedError as error:
            tell(asked.root, GuardianAnswers(asked.request, Refusal.of(error)))

    def _kept(self) -> list[Entry]:
        me, entries = self._registrar.me, self._registrar.entries.values()
        return [it for it in entries if me in it.record.members and it.record.guarded and not it.record.removed]

    def _shown(self) -> list[Entry]:
        """Return what is guarded here, and what waits here for guardians."""
        waits = [it for it in self._registrar.entries.values() if it.held is not None and it.held.rule is not None]
        return [*self._kept(), *(it for it in waits if not it.record.guarded)]

    def _to_take(self, body: Take) -> Entry:
        """Return the task to be taken over.

        Raises:
            ControlRefusedError: this agent guards none, or two, of this name; or its owner is not silent.
        """
        agent, kept = self._registrar.agent, {it.record.task_id: it for it in self._kept()}
        found = [it for key, it in kept.items() if key.name == body.task and body.birthplace in ("", key.birthplace)]
        if not found:
            names = ", ".join(map(str, kept)) or "no task"
            raise ControlRefusedError(f"{agent} does not guard {body.task}, but {names}", "not_found")
        if len(found) > 1:
            names = " and ".join(str(it.record.task_id) for it in found)
            raise ControlRefusedError(f"{agent} guards {names}: say which birthplace is meant", "ambiguous")
        (entry,) = found
        if entry.lease.beat:
            owner, task_id = entry.lease.epoch.minter, entry.record.task_id
            hint = f"`pancakes task migrate {owner}/{task_id.name}` moves it"
            raise ControlRefusedError(f"{task_id} is not taken over: {owner} has a lease on it. {hint}")
        return entry

    def _take(self, asked: AskedOfGuardian, entry: Entry) -> None:
        """A person says that a task should be taken over.

        Raises:
            ControlRefusedError: it does not wait for that.
        """
        task_id = entry.record.task_id
        orphan = self._orphans.get(task_id)
        if orphan is None:
            raise ControlRefusedError(f"{task_id} is not to run, as its checkpoint says: there is nothing to take over")
        if orphan.negotiating_s is not None or orphan.asked is not None:
            raise ControlRefusedError(f"{task_id} is being taken over already", "busy")
        orphan.asked = asked
        self._poll(task_id, orphan)
        self._registrar.after_host(POLLED_S, partial(self._look_at_polled, task_id, orphan))

    def _look_at_polled(self, task_id: TaskId, orphan: _Orphan) -> None:
        if orphan.asked is None or orphan.negotiating_s is not None:
            return
        members = members_in(orphan.sets)
        silent = ", ".join(sorted(it.agent for it in members if it not in orphan.over))
        known = f"{len(orphan.over)} of its {len(members)} guardians say that its owner is silent"
        self._answer(orphan, f"{task_id} is not taken over: {known}, and not {silent}")

    def _answer(self, orphan: _Orphan, reason: str, result: Any = None) -> None:
        asked, orphan.asked = orphan.asked, None
        if asked is not None:
            tell(asked.root, GuardianAnswers(asked.request, Refusal.if_any(reason), result))

    def _row(self, entry: Entry) -> dict[str, Any]:
        """Return what there is to know about a task that is guarded here, as plain values."""
        registrar, record = self._registrar, entry.record
        now_s, owner = registrar.kernel.host.now(), record.seen.minter.agent
        row = {
            "task_id": str(record.task_id),
            "agent": registrar.agent,
            "owner": owner,
            "epoch": str(record.seen),
            "checkpoint": record.register.no,
            "age_s": now_s - entry.as_of_s,
            "silent_s": now_s - entry.heard_s if owner != registrar.agent else 0.0,
            "lease": entry.lease.beat > 0,
            "lease_left_s": max(0.0, entry.alarm.due_s - now_s) if entry.lease.beat else None,
            "wanted": record.snapshot != b"" and record.wanted is Wanted.RUNNING,
        }
        if not record.owned or entry.held is None:
            return row
        permits = registrar.kernel.permits
        address = join(registrar.agent, record.service, record.task_id.name)
        permit_s = permits.left_s(right_of(record))
        return {
            **row,
            "guardians": [member.agent for member in record.members],
            "changing": len(record.register.sets) > 1,
            "guard": entry.held.number,
            "permit_s": permit_s if permit_s is not None else record.lease_s,
            "held_back": permits.held_back(str(record.task_id)),
            "clock_steps": permits.steps(str(record.task_id)),
            "no_dead_man": registrar.kernel.registry.without_dead_man(address),
        }

    def _held(self, asked: Checkpoints) -> list[dict[str, Any]]:
        return [
            {"agent": self._registrar.agent, **row}
            for it in self._registrar.entries.values()
            if (row := self._checkpoint(it, asked))
        ]

    def _checkpoint(self, entry: Entry, asked: Checkpoints) -> dict[str, Any]:
        """Return a state that this agent holds and does not run, as plain values; empty: none."""
        record, now_s = entry.record, self._registrar.kernel.host.now()
        task_id = record.task_id
        is_meant = asked.task in ("", task_id.name) and asked.birthplace in ("", task_id.birthplace)
        if not is_meant or not record.snapshot or not (record.in_doubt or record.guarded):
            return {}
        try:
            snapshot = Snapshot.decode(record.snapshot)
        except MigrationError:  # what cannot be read is of no use
            return {}
        return {
            "task_id": str(task_id),
            "type": snapshot.type,
            "service": snapshot.service,
            "epoch": [record.epoch.n, record.epoch.minter.agent],
            "no": record.register.no,
            **({"snapshot": record.snapshot} if asked.body else {}),
            "held": IN_DOUBT if record.in_doubt else GUARDIAN,
            "wanted": record.wanted.value,
            "age_s": None if record.in_doubt else now_s - entry.as_of_s,
            "at_least": record.in_doubt or entry.from_disk,
            "seen": record.seen.n,
            "guardians": [[member.agent for member in one] for one in record.register.sets] if record.guarded else [],
            "peer": record.peer if record.in_doubt else "",
        }
