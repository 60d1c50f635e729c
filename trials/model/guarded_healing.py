"""L1 of guarded tasks: if all goes well from now on, it comes to exactly one copy that acts.

All messages and all memory are lost, all leases are over, and any one agent is gone for good, or none. While a majority
of the guardians is up, a few rounds must lead to one agent that acts, and that goes on acting. A round is longer than a
lease. In it every owner asks for leases, all that is said arrives, guardians whose leases are over call one agent, and
agents tell each other what they own.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from model.guarded_parts import BOOT, OWNED, TASK, TYPE, Party, Rules, Scenario, Violation
from msgspec.structs import replace

from pancakes.durable.guarding import AnswerAsker, Lease, SetLease, WriteRegister
from pancakes.durable.handoff_events import (
    ClaimHeard,
    Discard,
    Event,
    Freeze,
    GiveUp,
    GiveWay,
    PermitGiven,
    Persist,
    Received,
    Remember,
    Resend,
    Resume,
    Seize,
    Send,
    StartTask,
)
from pancakes.durable.messages import CheckpointId, DenyLease, KeepLease, LeaseKept, Pledge, SeizeTask, TakeTask
from pancakes.durable.record import GuardianId, Phase, Wanted

ROUNDS = 16
ASKED = 10
"""So often an owner asks in each round."""


class Healing:
    """Asks for L1 in one scenario.

    Args:
        scenario: its agents.
        rules: the functions under search.
    """

    def __init__(self, scenario: Scenario, rules: Rules) -> None:
        self._names = scenario.agents
        self._rules = rules

    def fault_of(self, parties: Sequence[Party]) -> str:
        """Returns why it does not come to one copy from here on; empty: it does."""
        wanted = [it.record.wanted for it in parties if it.record.phase is not Phase.ABSENT]
        wanted += [it.register.body.wanted for it in parties if it.register.body is not None]
        if any(one is not Wanted.RUNNING for one in wanted):
            return ""  # which of the two holds is a matter of what has arrived
        sets = {one for it in parties for guards in (it.register.guards, it.record.guards) for one in guards.sets}
        for gone in (None, *range(len(parties))):
            there = {self._me(at, it) for at, it in enumerate(parties) if at != gone}
            if all(2 * sum(it in there for it in one) > len(one) for one in sets):
                try:
                    story = _Course(self._names, self._rules, parties, gone).failure()
                except Violation as violation:
                    return f"{violation}, while it heals"
                if story:
                    return story
        return ""

    def _me(self, at: int, party: Party) -> GuardianId:
        return GuardianId(self._names[at], f"j{party.journal}")


class _Course:
    """How it goes on from one configuration, without one of the agents."""

    def __init__(self, names: str, rules: Rules, parties: Sequence[Party], gone: int | None) -> None:
        self._names, self._rules, self._gone = names, rules, gone
        self._alive = [at for at in range(len(parties)) if at != gone]
        self._box: list[tuple[int, Any, int]] = []
        self._round = 0
        self._tenures = [rules.tenure.begun(0, 0.0, it.original) for it in parties]
        self._parties = [Party(it.record, register=it.register, journal=it.journal) for it in parties]

    def failure(self) -> str:
        for i in self._alive:
            self._carry(i, self._rules.core.recover(self._parties[i].record))
            self._box.clear()
        calm = 0
        for self._round in range(1, ROUNDS):
            for i in self._alive:
                self._begin_round(i)
            self._deliver()
            acting = [i for i in self._alive if self._acts(i)]
            if len(acting) > 1:
                raise Violation(f"S1: the task acts on {' and on '.join(self._names[i] for i in acting)}")
            others = [i for i in self._alive if i not in acting and self._parties[i].record.phase in OWNED]
            calm = calm + 1 if acting and not others else 0
            if calm == 2:
                return ""
            self._end_round(bool(acting))
        story = ", ".join(f"{self._names[i]} is {self._parties[i].record.phase.name}" for i in self._alive)
        gone = f" without {self._names[self._gone]}" if self._gone is not None else ""
        return f"L1: however long one waits{gone}, it does not come to one copy: {story}"

    def _acts(self, i: int) -> bool:
        party = self._parties[i]
        return party.actor >= 0 and not party.still and party.permit == self._round

    def _begin_round(self, i: int) -> None:
        party, rules = self._parties[i], self._rules.tenure
        if party.owns and rules.may_ask(self._tenures[i], party.record):
            self._ask(i)
        if party.record.phase in (Phase.COMMITTED, Phase.PREPARED, Phase.FROZEN):
            self._feed(i, Resend(party.record.offer, party.record.phase, 0))
        taking = party.taking
        if taking is not None and taking.source:
            if self._rules.seizing.is_vain(taking, party.record):
                self._parties[i] = party._replace(taking=None)
            else:
                taking = self._rules.seizing.asked_anew(taking, self._names[i])
                self._parties[i] = party._replace(taking=taking)
                self._post(i, taking.ask(), taking.guards.members())
        if party.owns:
            for other in self._alive:
                if other != i:
                    self._box.append((other, ClaimHeard(self._names[i], party.record.epoch), i))

    def _ask(self, i: int) -> None:
        party, rules = self._parties[i], self._rules.tenure
        self._tenures[i] = rules.asked_again(replace(self._tenures[i], beat=ASKED * self._round - 1), party.record)
        keep = rules.keep_lease(self._tenures[i], party.record, TYPE, 1.0, True)
        self._post(i, keep, party.record.guards.members())

    def _post(self, i: int, message: Any, members: Sequence[GuardianId]) -> None:
        for at in self._alive:
            if GuardianId(self._names[at], f"j{self._parties[at].journal}") in members:
                self._box.append((at, message, i))

    def _deliver(self) -> None:
        for _ in range(2_000):
            if not self._box:
                return
            to, message, source = self._box.pop(0)
            match message:
                case KeepLease() | SeizeTask():
                    self._guard(to, message, source)
                case LeaseKept() | DenyLease() | Pledge():
                    self._hear(to, message)
                case ClaimHeard():
                    record = self._parties[to].record
                    if message.epoch > record.epoch:
                        self._feed(to, message)
                case _:
                    self._feed(to, Received(self._names[source], message))
        raise Violation("L1: messages without end")

    def _guard(self, to: int, message: KeepLease | SeizeTask, source: int) -> None:
        party = self._parties[to]
        me = GuardianId(self._names[to], f"j{party.journal}")
        for effect in self._rules.guardian.handle(me, party.register, party.lease, message):
            match effect:
                case WriteRegister(register):
                    party = party._replace(register=register)
                case SetLease(lease, _):
                    party = party._replace(lease=lease, until=self._round)
                case AnswerAsker(answer) if source in self._alive:
                    self._box.append((source, answer, to))
        self._parties[to] = party

    def _hear(self, i: int, answer: LeaseKept | DenyLease | Pledge) -> None:
        party, rules = self._parties[i], self._rules
        if party.taking is not None:
            taking = rules.seizing.told(party.taking, answer)
            if taking.guards != party.taking.guards:
                self._post(i, taking.ask(), taking.guards.members())
            self._parties[i] = party = party._replace(taking=taking)
            result = taking.result()
            if result is not None:
                self._parties[i] = party._replace(taking=None)
                self._feed(i, result)
                if self._parties[i].owns:
                    self._ask(i)
                return
        if not party.owns or isinstance(answer, Pledge):
            return
        tenure = self._tenures[i] = rules.tenure.answered(self._tenures[i], party.record, answer)
        granted = tenure.granted_beat(party.record.guards) == ASKED * self._round
        if not tenure.behind and granted and party.permit != self._round:
            self._parties[i] = party._replace(permit=self._round)
            self._feed(i, PermitGiven())
        party = self._parties[i]
        follows = rules.tenure.conclusion(tenure, party.record, party.permit == self._round, party.taking is not None)
        if follows is not None:
            before = party.record
            self._feed(i, follows)
            now = self._parties[i]
            if now.owns and now.record != before:
                self._ask(i)

    def _feed(self, i: int, event: Event) -> None:
        party = self._parties[i]
        may = party.permit == self._round
        self._carry(i, self._rules.core.handle(self._names[i], party.record, party.volatile, event, may))

    def _carry(self, i: int, effects: Sequence[Any]) -> None:
        for effect in effects:
            party = self._parties[i]
            match effect:
                case Persist(record):
                    party = party._replace(record=record)
                    if not party.owns:
                        party = party._replace(permit=0)
                case Remember(volatile):
                    party = party._replace(volatile=volatile)
                case StartTask() | Resume():
                    party = party._replace(actor=effect.snapshot[0], still=False)
                case Freeze():
                    party = party._replace(still=True)
                case Discard() | GiveWay():
                    party = party._replace(actor=-1, still=False)
                case Send(peer, message):
                    to = self._names.index(peer)
                    if to in self._alive:
                        self._box.append((to, message, i))
                case Seize(source, commit):
                    if party.taking is None or party.taking.offer != commit.offer:
                        taking = self._rules.seizing.given_away(self._names[i], party.record, TYPE, source, commit)
                        party = party._replace(taking=taking)
                        self._post(i, taking.ask(), taking.guards.members())
            self._parties[i] = party

    def _end_round(self, acts: bool) -> None:
        for i in self._alive:
            party = self._parties[i]
            if party.lease.epoch is not None and party.until != self._round:
                self._parties[i] = party._replace(lease=Lease(boot=BOOT))
            if party.taking is not None and not party.taking.source:
                self._parties[i] = self._parties[i]._replace(taking=None)
            if party.record.phase is Phase.FROZEN and self._round > 2:
                self._feed(i, GiveUp(party.record.offer, "late"))
        if acts or self._round < 2:
            return
        parties = [self._parties[i] for i in self._alive]
        guards = max((it.register.guards for it in parties), key=lambda it: it.stamp)
        over = [
            GuardianId(self._names[i], f"j{self._parties[i].journal}")
            for i in self._alive
            if self._parties[i].lease.epoch is None
        ]
        i = self._alive[self._round % len(self._alive)]
        party = self._parties[i]
        if guards.has_quorum(over) and party.taking is None:
            promised = max(it.register.promised for it in parties)
            call = TakeTask(TASK, TYPE, promised, guards, CheckpointId(promised, 0))
            taking = self._rules.seizing.called(self._names[i], party.record, party.volatile, call)
            if taking is not None:
                self._parties[i] = party._replace(taking=taking)
                self._post(i, taking.ask(), taking.guards.members())
