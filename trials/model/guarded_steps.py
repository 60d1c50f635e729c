"""All that one agent does in the search of guarded tasks: whole, and cut by a crash.

An agent's steps do not depend on the others. So each is worked out once and remembered, and the search itself works
on small numbers.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from model.guarded_parts import (
    BOOT,
    OWNED,
    REQUEST,
    STOPPED,
    TASK,
    TYPE,
    Backup,
    Farewell,
    Message,
    Party,
    Rules,
    Scenario,
    Violation,
    Word,
)
from msgspec.structs import replace

from pancakes.durable.guarding import AnswerAsker, LeaseOver, SetLease, WriteRegister
from pancakes.durable.handoff_events import (
    Ack,
    Award,
    Discard,
    Ended,
    Event,
    Freeze,
    Frozen,
    GiveWay,
    PacketId,
    PermitGiven,
    Persist,
    Received,
    Remember,
    Resume,
    RunAsked,
    Seize,
    Send,
    StartTask,
)
from pancakes.durable.messages import (
    CheckpointId,
    Commit,
    DenyLease,
    KeepLease,
    LeaseKept,
    Pledge,
    Reserved,
    SeizeTask,
    TakeTask,
    YieldLease,
)
from pancakes.durable.record import Epoch, GuardianId, Guards, Phase, Record

STREAM = "sender"


class Outcome(NamedTuple):
    """What one step does.

    Attributes:
        party: the agent's number afterwards.
        sent: the messages that it sent, as bits.
        acked: what it acknowledged, as bits.
        cuts: the same for each place at which it may crash.
        ended: whether a lease ended at its owner's word.
    """

    party: int
    sent: int
    acked: int
    cuts: tuple[tuple[int, int, int], ...] = ()
    ended: bool = False


class GuardedSteps:
    """The steps of single agents.

    Args:
        scenario: what may happen.
        rules: the functions under search.
    """

    def __init__(self, scenario: Scenario, rules: Rules) -> None:
        self.scenario, self.rules = scenario, rules
        self.names = scenario.agents
        self.parties: list[Party] = []
        self.messages: list[Message] = []
        self._party_ids: dict[Party, int] = {}
        self._message_ids: dict[tuple[type, Message], int] = {}
        self._outcomes: dict[Any, Outcome] = {}
        self._crashed: dict[tuple[int, int, int], tuple[int, int]] = {}
        self._lapsed: dict[int, int] = {}
        self._news: dict[int, tuple[Epoch, Epoch | None, int]] = {}
        self._heard_by: dict[tuple[int, int], tuple[int, int]] = {}

    # Numbers ---------------------------------------------------------------------------------------------------

    def number(self, party: Party) -> int:
        """Returns the number of an agent in this state."""
        number = self._party_ids.setdefault(party, len(self.parties))
        if number == len(self.parties):
            self.parties.append(party)
        return number

    def bit(self, message: Message) -> int:
        """Returns the bit of a message."""
        key = (type(message), message)
        number = self._message_ids.get(key)
        if number is None:
            number = self._message_ids[key] = len(self.messages)
            self.messages.append(message)
        return 1 << number

    def lapsed(self, number: int) -> int:
        """Returns the number of an agent once the oldest asking has lapsed."""
        out = self._lapsed.get(number)
        if out is None:
            party = self.parties[number]
            lease = replace(party.lease, beat=max(0, party.lease.beat - 1))
            out = self._lapsed[number] = self.number(
                party._replace(
                    permit=max(0, party.permit - 1),
                    asked=tuple(beat - 1 for beat in party.asked if beat > 1),
                    lease=lease,
                    until=max(0, party.until - 1),
                )
            )
        return out

    def me(self, i: int, party: Party) -> GuardianId:
        """Returns an agent as a guardian."""
        return GuardianId(self.names[i], f"j{party.journal}")

    def is_concerned(self, i: int, number: int) -> bool:
        """Returns whether what can happen to an agent hangs on what others have promised and own."""
        party = self.parties[number]
        waits = party.taking is not None or party.record.phase in (*OWNED, Phase.COMMITTED, Phase.PREPARED)
        return waits or self.names[i] in self.scenario.takers

    def news(self, number: int) -> tuple[Epoch, Epoch | None, int]:
        """Returns what others may hear of an agent: what it has promised, the epoch that it owns, and its journal."""
        found = self._news.get(number)
        if found is None:
            party = self.parties[number]
            owned = party.record.epoch if party.owns else None
            found = self._news[number] = party.register.promised, owned, party.journal
        return found

    def heard_by(self, i: int, number: int) -> int:
        """Returns the messages that an agent can hear, as bits."""
        upto, mask = self._heard_by.get((i, number), (0, 0))
        if upto < len(self.messages):
            party = self.parties[number]
            me, name = self.me(i, party), self.names[i]
            epoch = party.record.epoch if party.owns else None
            offer = party.taking.epoch if party.taking is not None else None
            for at in range(upto, len(self.messages)):
                match self.messages[at]:
                    case KeepLease() | SeizeTask() as message:
                        heard = me in message.guards.members()
                    case Farewell(to):
                        heard = to == me
                    case Word(_, to_name):
                        heard = to_name == name
                    case LeaseKept() as message:
                        heard = message.epoch == epoch
                    case Pledge() as message:
                        heard = message.epoch == offer
                mask |= heard << at
            self._heard_by[i, number] = len(self.messages), mask
        return mask

    # Carrying out ----------------------------------------------------------------------------------------------

    def carry(self, i: int, party: Party, effects: Sequence[Any], asker: str = "") -> tuple[Party, int, int]:
        """Returns the agent after the effects, what it sent, and what it acknowledged."""
        me, sent = self.names[i], 0
        for effect in effects:
            match effect:
                case Persist(record):
                    if record.seen < party.record.seen:
                        raise Violation("S2: the highest epoch seen went down on a disk")
                    if party.owns and record.phase is Phase.COMMITTED:
                        sent |= self._farewells(record, max(party.asked, default=0))
                    party = _written(party, record)
                case Remember(volatile):
                    party = party._replace(volatile=volatile)
                case StartTask():
                    party = party._replace(actor=effect.snapshot[0], still=False)
                case Resume():
                    actor = party.actor if party.actor >= 0 else effect.snapshot[0]
                    party = party._replace(actor=actor, still=False)
                case Freeze():
                    party = party._replace(still=True)
                case Discard() | GiveWay():
                    party = party._replace(actor=-1, still=False)
                case Send(peer, message):
                    sent |= self.bit(Word(me, peer, message))
                case Seize(source, commit):
                    party, asked = self.given(i, party, source, commit)
                    sent |= asked
                case Ack(packet):
                    at = CheckpointId(party.record.epoch, party.record.no)
                    party = party._replace(owed=(*party.owed, (at, 1 << packet.seq)))
                case WriteRegister(register):
                    if register.promised < party.register.promised:
                        raise Violation("S2: a guardian goes back on its promise")
                    party = party._replace(register=register)
                case SetLease(lease, _):
                    until = party.until if lease.epoch is not None else 0
                    party = party._replace(lease=replace(lease, number=0), until=until)
                case AnswerAsker(LeaseKept() | Pledge() as answer):
                    sent |= self.bit(answer)
        return party, sent, 0

    def given(self, i: int, party: Party, source: str, commit: Commit) -> tuple[Party, int]:
        """Begins to take a task that was given away; returns what the agent then asks guardians."""
        if party.taking is not None and party.taking.offer == commit.offer:
            return party, 0
        seizing = self.rules.seizing.given_away(self.names[i], party.record, TYPE, source, commit)
        return party._replace(taking=seizing), self.bit(seizing.ask())

    def _outcome(self, key: Any, i: int, make: Callable[[], list[tuple[Party, int, int]]]) -> Outcome:
        """Returns the outcome of a step; `make` yields the agent after each of its effects, the last one whole."""
        found = self._outcomes.get(key)
        if found is None:
            *parts, (whole, sent, acked) = self._heard_at_home(i, make())
            cuts = tuple(dict.fromkeys((self.number(_crashed(part)), s, a) for part, s, a in parts))
            found = self._outcomes[key] = Outcome(self.number(whole), sent, acked, cuts)
        return found

    def _heard_at_home(self, i: int, parts: list[tuple[Party, int, int]]) -> list[tuple[Party, int, int]]:
        """Has an agent's own guardian hear at once what its owner, or taker, says to all guardians."""
        if not self.scenario.at_once:
            return parts
        party, sent, _ = parts[-1]
        me, fresh = self.me(i, party), sent
        while fresh:
            low = fresh & -fresh
            fresh ^= low
            message = self.messages[low.bit_length() - 1]
            if isinstance(message, KeepLease | SeizeTask) and me in message.guards.members():
                parts = [*parts, *self._guarded(i, parts[-1], message)]
        return parts

    def _guarded(
        self, i: int, start: tuple[Party, int, int], event: KeepLease | SeizeTask | YieldLease | LeaseOver
    ) -> list[tuple[Party, int, int]]:
        party, sent, acked = start
        out = []
        for effect in self.rules.guardian.handle(self.me(i, party), party.register, party.lease, event):
            if isinstance(effect, SetLease) and isinstance(event, KeepLease):
                # It began after this one was sent, and so did each that it goes on from.
                party = party._replace(until=max(party.until, event.beat))
            party, more, _ = self.carry(i, party, [effect])
            sent |= more
            out.append((party, sent, acked))
        return out or [start]

    def _each(self, i: int, start: tuple[Party, int, int], effects: Sequence[Any]) -> list[tuple[Party, int, int]]:
        party, sent, acked = start
        out = []
        for effect in effects:
            party, more, _ = self.carry(i, party, [effect])
            sent |= more
            out.append((party, sent, acked))
        return out or [start]

    def _decide(self, i: int, party: Party, event: Event) -> Sequence[Any]:
        effects: Sequence[Any] = self.rules.core.handle(
            self.names[i], party.record, party.volatile, event, party.permit > 0
        )
        return effects

    # The owner -------------------------------------------------------------------------------------------------

    def decide(self, i: int, number: int, event: Event) -> Outcome:
        """Feeds an event to the core of an agent."""

        def make() -> list[tuple[Party, int, int]]:
            party = self.parties[number]
            if isinstance(event, Ended):
                party = party._replace(actor=-1, still=False)
            if isinstance(event, RunAsked):
                party = party._replace(owed=tuple(it for it in party.owed if it[1] != STOPPED))
            parts = self._each(i, (party, 0, 0), self._decide(i, party, event))
            if isinstance(event, Ended):
                last, sent, acked = parts[-1]
                at = CheckpointId(last.record.epoch, last.record.no)
                parts[-1] = (last._replace(owed=(*last.owed, (at, STOPPED))), sent, acked)
            return parts

        return self._outcome((number, i, event), i, make)

    def hand_over(self, i: int, number: int, peer: str) -> Outcome:
        """Begins a hand-off: a reservation was granted, and the task has been stopped."""

        def make() -> list[tuple[Party, int, int]]:
            party = self.parties[number]
            offer = Epoch(party.record.seen.n + 1, self.names[i])
            for event in (Award(peer, REQUEST), Received(peer, Reserved(TASK, offer))):
                party, _, _ = self.carry(i, party, self._decide(i, party, event))
            frozen = Frozen(offer, bytes([max(party.actor, 0)]))
            return self._each(i, (party, 0, 0), self._decide(i, party, frozen))

        return self._outcome((number, i, "hand over", peer), i, make)

    def renew(self, i: int, number: int, top: int, with_body: bool = True) -> Outcome:
        """Asks the guardians for leases."""

        def make() -> list[tuple[Party, int, int]]:
            party = self.parties[number]
            rules = self.rules.tenure
            had = rules.Tenure(party.record.epoch, top, behind=party.behind, original=party.original)
            if not rules.may_ask(had, party.record):
                return [(party, 0, 0)]
            tenure = rules.asked_again(rules.Tenure(party.record.epoch, top), party.record)
            keep = rules.keep_lease(tenure, party.record, TYPE, 1.0, with_body)
            return [(party._replace(asked=(*party.asked, top + 1)), self.bit(keep), 0)]

        return self._outcome((number, i, "renew", top, with_body), i, make)

    def votes(self, i: int, number: int, answers: tuple[LeaseKept | DenyLease, ...]) -> Outcome:
        """The owner hears what guardians say. They are counted in one go: each can be heard again."""

        def make() -> list[tuple[Party, int, int]]:
            party, rules = self.parties[number], self.rules.tenure
            record = party.record
            # Those that do not answer may have been silent for long.
            tenure = rules.Tenure(record.epoch, max(party.asked, default=0), -1_000, behind=party.behind)
            for answer in answers:
                tenure = rules.answered(tenure, record, answer)
            party = party._replace(behind=tenure.behind)
            out = [(party, 0, 0)]
            if not tenure.behind:
                beat = tenure.granted_beat(record.guards)
                if beat in party.asked and beat > party.permit:
                    party = party._replace(permit=beat)
                    out += self._each(i, (party, 0, 0), self._decide(i, party, PermitGiven()))
                    party = out[-1][0]
                owed = [(at, PacketId(STREAM, bits)) for at, bits in party.owed]
                kept, left = rules.kept_packets(tenure, record, owed)
                acked = sum(packet.seq for packet in kept)
                party = party._replace(owed=tuple((at, packet.seq) for at, packet in left))
                out.append((party, 0, acked))
            follows = rules.conclusion(tenure, record, party.acts, party.taking is not None)
            if follows is not None:
                out += self._each(i, out[-1], self._decide(i, party, follows))
            return out

        return self._outcome((number, i, "votes", answers), i, make)

    # A taker ---------------------------------------------------------------------------------------------------

    def called(self, i: int, number: int, promised: Epoch, guards: Guards) -> Outcome:
        """A guardian calls the agent to take the task."""

        def make() -> list[tuple[Party, int, int]]:
            party = self.parties[number]
            call = TakeTask(TASK, TYPE, promised, guards, CheckpointId(promised, 0))
            seizing = self.rules.seizing.called(self.names[i], party.record, party.volatile, call)
            if seizing is None:
                return [(party, 0, 0)]
            return [(party._replace(taking=seizing), self.bit(seizing.ask()), 0)]

        return self._outcome((number, i, "called", promised, guards), i, make)

    def asked_anew(self, i: int, number: int, promised: Epoch) -> Outcome:
        """The agent asks once more, and has heard what a guardian has promised."""

        def make() -> list[tuple[Party, int, int]]:
            party, rules = self.parties[number], self.rules.seizing
            assert party.taking is not None
            if rules.is_vain(party.taking, party.record):
                return [(party._replace(taking=None), 0, 0)]
            member = party.taking.guards.members()[0]
            denied = DenyLease(TASK, party.taking.epoch, member, promised, "it follows another one")
            taking = rules.asked_anew(rules.told(party.taking, denied), self.names[i])
            return [(party._replace(taking=replace(taking, denied=())), self.bit(taking.ask()), 0)]

        return self._outcome((number, i, "asked anew", promised), i, make)

    def pledges(self, i: int, number: int, pledges: tuple[Pledge, ...]) -> Outcome:
        """The taker hears pledges, in one go. Those that do not suffice are heard again."""

        def make() -> list[tuple[Party, int, int]]:
            party, rules = self.parties[number], self.rules.seizing
            taking = party.taking
            assert taking is not None
            begins = taking
            for at, pledge in enumerate(pledges):
                taking = rules.told(taking, pledge)
                result = taking.result()
                if result is not None and at < len(pledges) - 1:
                    return [(party, 0, 0)]  # fewer would do
                if result is not None:
                    party = party._replace(taking=None)
                    return self._each(i, (party, 0, 0), self._decide(i, party, result))
            learnt = replace(begins, guards=taking.guards)
            if learnt == begins:
                return [(party, 0, 0)]
            return [(party._replace(taking=learnt), self.bit(learnt.ask()), 0)]

        return self._outcome((number, i, "pledges", pledges), i, make)

    # A guardian ------------------------------------------------------------------------------------------------

    def guard(self, i: int, number: int, message: KeepLease | SeizeTask | Farewell | LeaseOver) -> Outcome:
        """A guardian hears something."""

        def make() -> list[tuple[Party, int, int]]:
            event = message.message if isinstance(message, Farewell) else message
            return self._guarded(i, (self.parties[number], 0, 0), event)

        found = self._outcome((number, i, type(message), message), i, make)
        if isinstance(message, Farewell) and found.party != number and not found.ended:
            found = self._outcomes[(number, i, type(message), message)] = found._replace(ended=True)
        return found

    # Its end ---------------------------------------------------------------------------------------------------

    def crash(self, i: int, number: int, top: int) -> tuple[int, int]:
        """Returns the agent after crash and restart, and what it sent."""
        key = (i, number, top)
        found = self._crashed.get(key)
        if found is None:
            party = _crashed(self.parties[number])
            party, sent, _ = self.carry(i, party, self.rules.core.recover(party.record))
            recovered = self.rules.guardian.recover(party.register, BOOT)
            party, _, _ = self.carry(i, party._replace(until=top if recovered else 0), recovered)
            found = self._crashed[key] = (self.number(party), sent)
        return found

    def backed_up(self, number: int) -> int:
        """Returns the agent once a copy of its disk was made."""
        party = self.parties[number]
        believed = Backup(party.record) if self.rules.tells_copies else Backup(party.record, party.register)
        return self.number(party._replace(backup=believed))

    def restored(self, i: int, number: int, top: int) -> tuple[int, int]:
        """Returns the agent after a restart with that copy in the place of its disk, and what it sent."""
        party = self.parties[number]
        assert party.backup is not None
        (record, register), journal = party.backup, party.journal + self.rules.tells_copies
        copy = Party(record, register=register, journal=journal, original=record.epoch)
        return self.crash(i, self.number(copy), top)

    def goodbye(self, i: int, number: int, top: int) -> Outcome:
        """The agent is shut down in order: it takes leave of its guardians."""

        def make() -> list[tuple[Party, int, int]]:
            party = self.parties[number]
            return [(_crashed(party), self._farewells(party.record, top), 0)]

        return self._outcome((number, i, "goodbye", top), i, make)

    def _farewells(self, record: Record, beat: int) -> int:
        """Returns what an owner says to its guardians that acts no more; `beat`: its newest asking."""
        rules, sent = self.rules.tenure, 0
        for guardian in record.guards.members():
            last = rules.LastAnswer(guardian, boot=BOOT)
            word = rules.yield_lease(rules.Tenure(record.epoch, beat, answers=(last,)), record, guardian)
            sent |= self.bit(Farewell(guardian, word))
        return sent


def _written(party: Party, record: Record) -> Party:
    party = party._replace(record=record)
    if record.phase in OWNED and record.guarded:
        return party
    return party._replace(permit=0, asked=(), behind=False, owed=())


def _crashed(party: Party) -> Party:
    """Returns what a crash leaves of an agent, before it has begun anew."""
    return Party(
        party.record, register=party.register, journal=party.journal, original=party.original, backup=party.backup
    )
