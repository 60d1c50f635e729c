"""Asks the members of owned tasks for leases, and lets a task act while a quorum of them agrees. In the registrar.

A task whose owner is its only member needs none of this. `Leases` numbers the requests (beats), notes by the clocks
when each permit ends, and chooses and replaces members. What is safe is decided in `rules`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import TYPE_CHECKING, Any, Final

import msgspec

from pancakes.durable import messages, rules
from pancakes.durable.deadlines import Deadlines
from pancakes.durable.entry import Entry, Fed, Held, right_of
from pancakes.durable.messages import MOST_AGE_S, REGISTRAR, CanGuard, MayGuard, choose
from pancakes.durable.record import Record
from pancakes.durable.register import (
    ANYONE,
    NOBODY,
    Identity,
    Register,
    Wanted,
    is_quorum,
    members_in,
)
from pancakes.durable.snapshot import rules_of
from pancakes.errors import MigrationError
from pancakes.migration import PERMIT_SHARE, RENEWED, GuardRule
from pancakes.packet import Fence, join

if TYPE_CHECKING:
    from pancakes.durable.register_messages import Guarded
    from pancakes.durable.registrar import Registrar

REPLACED_S: Final = 60.0
"""A member that has said nothing for this long is replaced if there is another agent that can be one, in host time."""
CHOOSE_S: Final = 1.0
ASK_AGAIN_S: Final = 2.0
ANSWERED_S: Final = 0.2
"""The owner waits this long for what its neighbours say when it chooses members."""
REMEMBERED: Final = 16
"""At most this many requests may be under way; a lease that was granted on an older one is as good as over."""
BEATS_OF_BOOT: Final = 2**44
"""A life of an agent has this many beats: one for each 0.1 ms of 55 years."""


class Leases:
    """Looks after the permits of the tasks that this agent owns. In the registrar's actor.

    Args:
        registrar: the registrar.
        deadlines: those of its actor.
    """

    def __init__(self, registrar: Registrar, deadlines: Deadlines) -> None:
        self._registrar = registrar
        self._deadlines = deadlines
        self._choosing = False

    @property
    def _now_s(self) -> float:
        return self._registrar.kernel.host.now()

    # How a task stands -----------------------------------------------------------------------------------------

    def look(self, entry: Entry) -> None:
        """How a task stands may have changed: asks for leases, or no longer."""
        record, permits = entry.record, self._registrar.kernel.permits
        # The members of a task that was removed are told until they know.
        is_told = record.removed and record.register.owner == self._registrar.me and record.guarded
        is_told = is_told and not self._all_have(entry)
        if not is_told and (not record.owned or record.disputed):
            self._let_go(entry)
            return
        if entry.held is None or entry.held.epoch != record.epoch:
            self._let_go(entry)
            self._begin(entry)
        held = entry.held
        assert held is not None
        for one in record.members:
            held.heard_s.setdefault(one, self._now_s)
        if record.register.clockless:
            permits.free(str(record.task_id))
        elif permits.begin(right_of(record)):
            self._give(entry, held)
            if entry.memory.permit:  # its members have granted leases while it needed none
                self._registrar.event("permit_given", task=record.task_id.name, without_s=0.0)
        if record.guarded and not held.closed and held.told != record.register.stamp:
            self._renew(entry, held)
        self._note(entry, held)

    def _all_have(self, entry: Entry) -> bool:
        held, register = entry.held, entry.register
        if held is None or held.epoch != register.epoch:
            return False
        others = [it for it in entry.record.members if it != self._registrar.me]
        return all(held.has.get(it, -1) >= register.no for it in others)

    def _begin(self, entry: Entry) -> None:
        registrar, record = self._registrar, entry.record
        first = registrar.talk.boot * BEATS_OF_BOOT + int(self._now_s * 1e4)
        held = entry.held = Held(
            self._deadlines.new(partial(self._renewal_due, entry)),
            self._deadlines.new(partial(self.look_for_end, entry)),
            record.epoch,
            first,
            self._now_s,
        )
        held.rule = _rule_of(record)
        # Until its service begins: if that is gone, another agent is to have the task.
        held.closed = entry.from_disk and registrar.kernel.actor(record.service) is None
        if record.register.clockless:
            registrar.kernel.permits.free(str(record.task_id))
        else:
            registrar.kernel.permits.revoke(right_of(record))
        self._choose_later()

    def _let_go(self, entry: Entry) -> None:
        held, entry.held = entry.held, None
        if held is None:
            if not entry.record.was_ours:
                self._registrar.kernel.guard_notes.drop(self._address(entry.record))
            return
        held.renewal.cancel()
        held.end.cancel()
        kernel, record = self._registrar.kernel, entry.record
        kernel.guard_notes.drop(self._address(record))
        if str(record.task_id) in kernel.permits.by_task:
            epoch = held.epoch
            kernel.permits.revoke(Fence(str(record.task_id), (epoch.n, epoch.minter.agent)))

    def open(self, entry: Entry) -> None:
        """The service of a task has begun."""
        if entry.held is not None:
            entry.held.closed = False

    def close(self, entry: Entry) -> None:
        """The service of a task has ended, or cannot start it: the task acts no more."""
        held = entry.held
        if held is None:
            return
        held.closed = True
        held.renewal.cancel()
        held.end.cancel()
        entry.memory = entry.memory._replace(permit=0)
        self._registrar.kernel.permits.revoke(right_of(entry.record))

    def learn(self, entry: Entry, told: Guarded) -> None:
        """A service says how to guard a task, and how new its checkpoint is."""
        held = entry.held
        if held is None:
            return
        held.rule, held.closed = told.rule, False
        held.as_of_s[entry.register.no] = told.as_of_s
        lease_s = told.rule.lease_s if told.rule is not None else entry.record.lease_s
        if entry.record.lease_s != lease_s or entry.record.type != told.type:
            entry.record = msgspec.structs.replace(entry.record, lease_s=lease_s, type=told.type)
            if entry.writing is not None:  # it takes the record's place
                entry.writing = msgspec.structs.replace(entry.writing, lease_s=lease_s, type=told.type)
        self._choose_later()
        self.look(entry)

    def may_write(self, entry: Entry) -> Callable[[], str] | None:
        """Return what is asked before a checkpoint of a running task is written; None: nothing is."""
        if entry.register.clockless:
            return None
        permits, right = self._registrar.kernel.permits, right_of(entry.record)

        def why_not() -> str:
            if permits.may_act(right):
                return ""
            permits.hold_back(right, "checkpoints")
            return f"{right.task_id} may not act until its guardians answer"

        return why_not

    # Asking ----------------------------------------------------------------------------------------------------

    def _renewal_due(self, entry: Entry) -> None:
        if entry.held is not None and not entry.held.closed:
            self._renew(entry, entry.held)

    def _renew(self, entry: Entry, held: Held) -> None:
        record, permits = entry.record, self._registrar.kernel.permits
        if not record.guarded or entry.memory.behind or held.closed:
            return
        held.beat += 1
        # The clock is read before anything is sent: a lease begins later, so it ends later.
        held.until[held.beat] = permits.moment().later(PERMIT_SHARE * record.lease_s)
        held.until.pop(held.beat - REMEMBERED, None)
        held.told = record.register.stamp
        is_slow = record.removed and entry.counted >= record.register.stamp  # the rest is told when it is back
        held.renewal.set(REPLACED_S if is_slow else record.lease_s / RENEWED)
        self._registrar.feed(entry, Fed(rules.Beat(held.beat)))

    def met(self, peer: str) -> None:
        """A link to another agent stands: if that is a member of a task without a permit, it is asked at once.

        After a stop of this process that was longer than a lease, the links are gone, and with them what was asked.
        """
        for entry in list(self._registrar.entries.values()):
            held, is_member = entry.held, peer in {one.agent for one in entry.record.members}
            if held is not None and is_member and not entry.memory.permit:
                self._renewal_due(entry)

    def state_for(self, entry: Entry, receiver: Identity, register: Register, beat: int) -> tuple[bytes | None, float]:
        """Return the state that goes along with a write for an agent, and its age; None: it has it, or needs none."""
        held, now_s = entry.held, self._now_s
        age_s = now_s - held.as_of_s.get(register.no, now_s) if held is not None else 0.0
        age_s = min(max(0.0, age_s), MOST_AGE_S)
        is_heir = register.heir not in (NOBODY, ANYONE) and receiver == register.heir
        if is_heir:
            return register.state, age_s
        if receiver not in register.members or held is None or held.has.get(receiver, -1) >= register.no:
            return None, age_s
        sent = held.sent.get(receiver)
        if sent is not None and sent[0] == register.no and held.beat - sent[1] < 2:
            return None, age_s  # it is on its way
        held.sent[receiver] = (register.no, held.beat)
        return register.state, age_s

    def heard(self, entry: Entry, told: messages.Accepted) -> None:
        """A member has said what it has."""
        held = entry.held
        if held is None or told.epoch != held.epoch:
            return
        held.heard_s[told.by] = self._now_s
        held.has[told.by] = told.no  # one that has begun again may have an old copy of its disk

    # Permits ---------------------------------------------------------------------------------------------------

    def permit_changed(self, entry: Entry, had: int) -> None:
        """Another request was granted by a quorum than before, or none is any more."""
        held = entry.held
        if held is None or entry.register.clockless or not entry.record.owned:
            return
        if held.closed:
            entry.memory = entry.memory._replace(permit=0)
        if entry.memory.permit <= 0:
            self._registrar.kernel.permits.revoke(right_of(entry.record))
            held.lost_s = self._now_s if had else held.lost_s
            return
        if had and not self._registrar.kernel.permits.may_act(right_of(entry.record)):
            granted = entry.memory.permit  # the answers came after the end of the one before
            self.look_for_end(entry)
            entry.memory, had = entry.memory._replace(permit=granted), 0
        self._give(entry, held)
        if not had and entry.memory.permit:
            without_s = self._now_s - held.lost_s
            self._registrar.event("permit_given", task=entry.record.task_id.name, without_s=without_s)

    def _give(self, entry: Entry, held: Held) -> None:
        permits, right = self._registrar.kernel.permits, right_of(entry.record)
        until = held.until.get(entry.memory.permit)
        if until is None or until.left_s(permits.moment()) <= 0:  # it came too late
            entry.memory = entry.memory._replace(permit=0)
            permits.revoke(right)
            return
        permits.give(right, until)
        held.end.set(permits.left_s(right) or 0.0)

    def look_for_end(self, entry: Entry) -> None:
        """See whether a permit is over. Then the task is paused, and its members are asked at once."""
        held, record = entry.held, entry.record
        if held is None or not entry.memory.permit or record.register.clockless:
            return
        permits, right = self._registrar.kernel.permits, right_of(record)
        left_s = permits.left_s(right) or 0.0
        if left_s > 0.0:
            held.end.set(left_s)
            return
        step_s = permits.ended_by_step(right)
        entry.memory = entry.memory._replace(permit=0)
        held.lost_s = self._now_s
        silent = ", ".join(sorted(one.agent for one in self._silent(entry, held, record.lease_s / 2))) or "too few"
        why = f"its guardians do not answer ({silent})"
        if step_s:
            why = f"the time of day of {self._registrar.agent} was set forward by {step_s:.1f} s, so its permit is over"
            self._registrar.event("clock_stepped", task=record.task_id.name, by_s=step_s)
        self._registrar.log("warning", f"{record.task_id} is paused: {why}")
        self._registrar.event("permit_lost", task=record.task_id.name)
        self._renew(entry, held)
        self._registrar.settle(entry)

    # Choosing members ------------------------------------------------------------------------------------------

    def _choose_later(self) -> None:
        if not self._choosing:
            self._choosing = True
            self._registrar.after_host(CHOOSE_S, self._choose_all)

    def _choose_all(self) -> None:
        self._choosing = False
        for entry in list(self._registrar.entries.values()):
            held, record = entry.held, entry.record
            if held is None or held.closed or len(record.register.sets) != 1 or entry.memory.behind:
                continue
            if held.rule is not None or record.guarded:
                self._choosing = True
            members = record.register.sets[0]
            enough = len(members) == held.number and self._registrar.me in members
            if record.register.heir != NOBODY or (enough and not self._silent(entry, held, REPLACED_S)):
                continue
            if held.number == 1:
                self._replace(entry, (self._registrar.me,))
            elif self._now_s - held.asked_s >= ASK_AGAIN_S:
                self._ask(entry, held)
        if self._choosing:
            self._registrar.after_host(CHOOSE_S, self._choose_all)

    def _ask(self, entry: Entry, held: Held) -> None:
        held.asked_s, held.answers = self._now_s, {}
        for peer in self._registrar.talk.neighbours():
            self._registrar.talk.say(peer, REGISTRAR, MayGuard(entry.record.task_id, entry.record.type))
        self._registrar.after_host(ANSWERED_S, partial(self._choose, entry))

    def can_guard(self, entry: Entry, answer: CanGuard) -> None:
        """A neighbour says whether it would guard a task."""
        if entry.held is not None:
            entry.held.answers[answer.guardian.agent] = answer

    def _choose(self, entry: Entry) -> None:
        held, record = entry.held, entry.record
        if held is None or not record.owned or len(record.register.sets) != 1:
            return
        members, rule = record.register.sets[0], held.rule
        silent = self._silent(entry, held, REPLACED_S)
        named = rule.guardians if rule is not None else ()
        chosen = choose(self._registrar.me, members, silent, named, held.number, held.answers.values())
        if chosen is not None:
            held.thin = False
            self._replace(entry, chosen)
        elif not held.thin:
            held.thin = True
            self._tell_thin(entry, held)

    def _tell_thin(self, entry: Entry, held: Held) -> None:
        task_id, members = entry.record.task_id, entry.record.members
        refusals = [f"{peer}: {one.refusal}" for peer, one in sorted(held.answers.items()) if one.refusal]
        why = f" ({'; '.join(refusals)})" if refusals else ""
        able = sum(not one.refusal for one in held.answers.values())
        if len(members) == 1:
            text = f"{task_id} is not guarded: it needs {held.number - 1} other agents, and {able} can guard it"
        else:
            text = f"{task_id} has a silent guardian, and no other agent can guard it"
        self._registrar.log("warning", text + why)
        self._registrar.event("guard_thin", task=task_id.name, guardians=[one.agent for one in members])

    def _replace(self, entry: Entry, chosen: tuple[Identity, ...]) -> None:
        if set(chosen) != set(entry.record.register.sets[0]):
            task_id, names = entry.record.task_id, [one.agent for one in chosen]
            self._registrar.log("info", f"{task_id} will be guarded by {', '.join(names)}")
            self._registrar.event("guards_chosen", task=task_id.name, guardians=names)
            self._registrar.feed(entry, Fed(rules.SetMembers(chosen)))

    def _silent(self, entry: Entry, held: Held, since_s: float) -> list[Identity]:
        others = [one for one in entry.record.members if one != self._registrar.me]
        return [one for one in others if self._now_s - held.heard_s.get(one, self._now_s) >= since_s]

    # For people ------------------------------------------------------------------------------------------------

    def _note(self, entry: Entry, held: Held) -> None:
        record, now_s = entry.record, self._now_s
        if held.rule is None and not record.guarded:
            self._registrar.kernel.guard_notes.drop(self._address(record))
            return
        held.as_of_s.setdefault(record.register.no, now_s)
        while len(held.as_of_s) > REMEMBERED:
            del held.as_of_s[next(iter(held.as_of_s))]
        held.has[self._registrar.me] = record.register.no
        note = GuardNote(
            right_of(record),
            held.number,
            record.lease_s,
            record.register.summary(),
            dict(held.has),
            dict(held.heard_s),
            dict(held.as_of_s),
        )
        self._registrar.kernel.guard_notes.enter(self._address(record), note)

    def note_copied(self, record: Record) -> None:
        """Note that a task is paused here, as the disk is a copy of that of its owner."""
        right, number = right_of(record), len(record.members)
        note = GuardNote(right, number, record.lease_s, record.register, {}, {}, {}, copied=True)
        self._registrar.kernel.guard_notes.enter(self._address(record), note)

    def _address(self, record: Record) -> str:
        return join(self._registrar.agent, record.service, record.task_id.name)


def _rule_of(record: Record) -> GuardRule | None:
    if not record.snapshot or record.wanted is Wanted.REMOVED:
        return None
    try:
        return rules_of(record.snapshot, record.task_id)[1].guard
    except MigrationError:
        return None


class GuardNote(msgspec.Struct, frozen=True):
    """How a task is guarded, as its owner knows it. Times are host times.

    Attributes:
        right: the right under which it acts, and which its permit limits.
        number: how many members it is to have.
        lease_s: how long a lease is, in host seconds.
        register: its register.
        has: the newest write that each member has said to have.
        heard_s: when each member has said something last.
        as_of_s: when the task was known last to be as each of the newest writes says, by number.
        copied: whether the agent's disk is a copy, so that the task is paused until its members let an agent run it.
    """

    right: Fence
    number: int
    lease_s: float
    register: Register
    has: Mapping[Identity, int]
    heard_s: Mapping[Identity, float]
    as_of_s: Mapping[int, float]
    copied: bool = False

    def answering(self, now_s: float) -> int:
        """Return how many members have said something within a lease."""
        me = self.register.owner
        return sum(
            one == me or now_s - self.heard_s.get(one, -1e9) < self.lease_s for one in members_in(self.register.sets)
        )

    @property
    def replicated_no(self) -> int:
        """The newest write that a quorum has; -1: none."""
        numbers = sorted(set(self.has.values()), reverse=True)
        sets = self.register.sets
        return next((no for no in numbers if is_quorum(sets, {it for it, has in self.has.items() if has >= no})), -1)

    def age_s(self, now_s: float) -> float | None:
        """Return how long ago the task was known to be as the checkpoint says that a quorum has."""
        return self._age_s(self.replicated_no, now_s)

    def _age_s(self, no: int, now_s: float) -> float | None:
        then_s = self.as_of_s.get(no)
        return now_s - then_s if then_s is not None else None

    def plain(self, now_s: float, permit_s: float | None) -> dict[str, Any]:
        """Return it as plain values.

        Args:
            now_s: host time.
            permit_s: for how long the task may act yet; None: no permit limits that; 0: it is paused.
        """
        return {
            "task_id": self.right.task_id,
            "epoch": str(self.register.epoch),
            "guard": self.number,
            "lease_s": self.lease_s,
            "permit_s": 0.0 if self.copied else permit_s if permit_s is not None else self.lease_s,
            "copied": self.copied,
            "checkpoint": self.replicated_no,
            "age_s": self.age_s(now_s),
            "answering": self.answering(now_s),
            "guardians": [
                {
                    "agent": one.agent,
                    "checkpoint": self.has.get(one, -1),
                    "age_s": self._age_s(self.has.get(one, -1), now_s),
                    "silent_s": now_s - self.heard_s.get(one, now_s) if one != self.register.owner else 0.0,
                }
                for one in members_in(self.register.sets)
            ],
        }
