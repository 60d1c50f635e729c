"""Checks of ownership in a service: births, old copies of disks, disputes, and whose a task is before it is taken.

A task must not start here while it may run elsewhere. `Births` asks the configured peers before a new task begins,
`Inquiries` asks all neighbours before a task is created, `CopiedTasks` pauses tasks if other agents say that this
disk is an old copy, `Disputes` pauses one of two owners, and `Origins` asks which agent has a task before it is taken
from another one. The rules are in `ownership`. All in the service's actor.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Final

import msgspec

from pancakes.control import Refusal
from pancakes.durable.census import (
    CENSUS,
    AskAbout,
    CensusNews,
    ClaimsCame,
    CopyNoticed,
    FactsCame,
    HostBegan,
    NeighbourCame,
    Owns,
)
from pancakes.durable.checkpoints import rules_of
from pancakes.durable.courier import COURIER
from pancakes.durable.handoff import is_by_person, is_disputed
from pancakes.durable.handoff_events import ClaimHeard
from pancakes.durable.hosting import HostingService, LastSaid, OtherOwner, Place, Unsure
from pancakes.durable.messages import Reserve
from pancakes.durable.ownership import (
    Birth,
    BirthFacts,
    Claims,
    CopiedTask,
    CopyVerdict,
    OwnerClaim,
    TaskAt,
    TaskFact,
    TasksKnown,
    Verdict,
    WhereIs,
    birth_of,
    copied_task,
    fact_of,
    newest_fact,
)
from pancakes.durable.record import DISK_LOST, OLD_COPY, WAITS, Lost, Phase, Record, TaskId, is_out_of_reach
from pancakes.durable.snapshot import Snapshot
from pancakes.durable.state_machine import idle
from pancakes.durable.store import Records
from pancakes.errors import MigrationError, PancakesError
from pancakes.mesh.mesh import Mesh
from pancakes.mesh.peers import reachable
from pancakes.packet import NETWORK, Packet, agent_of, join
from pancakes.supervision.lifecycle import Retry, State, StopAsked
from pancakes.supervision.slots import Slot

TOLD_S: Final = 1.0
"""A birth that waits longer than this is told of: when a fleet starts, all wait for a moment."""
ASK_AGAIN_S: Final = 0.9


class BirthRule(msgspec.Struct, frozen=True):
    """What an agent asks before a task is born.

    Attributes:
        peers: the addresses at which the agents are that it asks.
        wait_s: how long it waits for them, in host seconds; 0: it asks none.
        former: the names that this agent had before, with the same disk.
    """

    peers: tuple[str, ...]
    wait_s: float
    former: tuple[str, ...]

    @property
    def asks(self) -> bool:
        """Whether it asks at all."""
        return bool(self.peers) and self.wait_s > 0.0


class _Unborn(msgspec.Struct):
    """A task that may be born here.

    Attributes:
        task_ids: its names: by this agent's name, and by each that it had before.
        answered: what each agent has answered about.
        known: the newest that each agent knows of it, of each name; this one among them, under a former name.
        told: what was told of it last.
    """

    task_ids: tuple[TaskId, ...]
    answered: dict[str, set[TaskId]] = msgspec.field(default_factory=dict)
    known: dict[tuple[str, TaskId], TaskFact] = msgspec.field(default_factory=dict)
    told: str = ""

    def said(self) -> list[str]:
        """Returns the agents that have answered about all names."""
        return [peer for peer, about in self.answered.items() if about.issuperset(self.task_ids)]


class Births:
    """Asks other agents about tasks of which this one knows nothing. All in the service's actor.

    Args:
        host: the service.
        records: what this agent knows.
        mesh: says which of the agents that are to be asked were met.
        rule: what is to be asked.
        fault: returns why an agent is not believed what it knows of a task; empty: it is.
    """

    def __init__(
        self,
        host: HostingService,
        records: Records,
        mesh: Mesh,
        rule: BirthRule,
        fault: Callable[[str, Place], str],
    ) -> None:
        self._host = host
        self._records = records
        self._mesh = mesh
        self._rule = rule
        self._fault = fault
        self._began_s = self._asked_s = host.kernel.host.now()
        self._unborn: dict[TaskId, _Unborn] = {}
        self._unbelieved = LastSaid()
        self._strangers: set[str] = set()  # named in `peers`, and no agents: a simulated world owns no task

    def begin(self) -> None:
        """Asks about all tasks that are new here."""
        for name in sorted(self._host.residents):
            place = self._host.places.at.get(name)
            if place is not None and self._may_be_born(place):
                self._unborn_of(place)
        if self._unborn and self._rule.asks:
            self._ask(())
            self._host.after_host(min(TOLD_S, self._rule.wait_s), self._tell_of_waiting)
            self._host.after_host(self._rule.wait_s, self._wait_over)

    def came(self, peer: str) -> None:
        """Another agent can be asked now."""
        if self._rule.asks:
            self._ask((peer,))
            self._look_again()

    def heard(self, peer: str, told: TasksKnown) -> None:
        """Another agent has told what it knows."""
        for unborn in self._unborn.values():
            about = set(unborn.task_ids).intersection(told.task_ids)
            if about:
                unborn.answered.setdefault(peer, set()).update(about)
                self._learn(peer, unborn, [fact for fact in told.facts if fact.task_id in about])
        self._look_again()

    def _learn(self, peer: str, unborn: _Unborn, facts: Iterable[TaskFact]) -> None:
        place = self._host.places[unborn.task_ids[0]]
        for fact in facts:
            known = unborn.known.get((peer, fact.task_id))
            if fact.epoch <= place.standing.record.seen or (known is not None and known.epoch >= fact.epoch):
                continue  # of one that was removed here, others may know what was before
            if fault := self._fault(peer, place):
                text = f"{peer} says that {fact.task_id} was born before, and is not believed: {fault}"
                if self._unbelieved.is_news(peer, text):
                    self._host.log("warning", text)
            else:
                unborn.known[peer, fact.task_id] = fact

    def of(self, slot: Slot, place: Place, starts: bool = True) -> Unsure | None:
        """Returns why a task is not born now; None: it may be, or has been.

        Args:
            slot: its slot.
            place: its place.
            starts: whether it is about to be; otherwise it is only looked at.
        """
        if not self._may_be_born(place):
            return None
        # What is asked for expressly does not wait: a person can see by the answer what it was based on.
        birth = self._birth(slot, place, at_once=slot.life.asker is not None or not starts)
        if birth.verdict is Verdict.BORN:
            return None
        if starts:
            self._tell(slot, place, birth)
            if birth.verdict is Verdict.WAITS:
                self._ask_again()
        return self._unsure(slot, place, birth)

    def undecided(self, name: str) -> list[Lost]:
        """Returns the tasks of a name that are not born, for a person to decide."""
        found = []
        for place in self._host.places.named(name):
            slot = place.slot
            if slot is not None and self._may_be_born(place):
                unsure = self.of(slot, place, starts=False)
                if unsure is not None:
                    fact = self._birth(slot, place, at_once=True).fact
                    heard = [fact.epoch] if fact is not None else []
                    found.append(Lost(place.task_id, unsure.why, heard=max([place.standing.record.seen, *heard])))
        return found

    # Looking ---------------------------------------------------------------------------------------------------

    def _may_be_born(self, place: Place) -> bool:
        return place.standing.record.may_begin and place.task_id.birthplace == self._host.agent

    def _unborn_of(self, place: Place) -> _Unborn:
        task_id = place.task_id
        found = self._unborn.get(task_id)
        if found is None:
            former = tuple(TaskId(name, task_id.name) for name in self._rule.former)
            found = self._unborn[task_id] = _Unborn((task_id, *former))
            for record in map(self._records.get, former):
                fact = fact_of(self._host.agent, record) if record is not None else None
                if fact is not None:
                    found.known[self._host.agent, fact.task_id] = fact
        return found

    def _birth(self, slot: Slot, place: Place, at_once: bool) -> Birth:
        unborn, rule = self._unborn_of(place), slot.spec.guard
        over = at_once or self._host.kernel.host.now() >= self._began_s + self._rule.wait_s
        named = self._named(place) if self._rule.asks else ()
        guardians = [name for name in rule.guardians if name != self._host.agent] if rule is not None else None
        said = {*unborn.said(), *self._strangers}
        return birth_of(BirthFacts(named, said, tuple(unborn.known.values()), guardians, over))

    def _named(self, place: Place) -> Sequence[str]:
        """Returns the agents that are to be asked, by name; those that were never met by their address."""
        described = self._mesh.describe()
        if described["state"] == "new":
            return self._rule.peers
        at: dict[str, str] = {}
        for link in described["peers"]:
            if link["role"] != "agent":
                self._strangers.add(link["name"])
            if not self._fault(link["name"], place):  # it dialled this agent, and says where it can be dialled
                at.update((reachable(address, link["remote"]), link["name"]) for address in link["addresses"])
        named = (it for it in described["addresses"] if it["static"])
        return list(dict.fromkeys(it["name"] or at.get(it["address"]) or it["address"] for it in named))

    def _unsure(self, slot: Slot, place: Place, birth: Birth) -> Unsure | None:
        task_id, missing = place.task_id, ", ".join(birth.missing)
        if birth.verdict is Verdict.UNASKED:
            return None
        decide = f"`pancakes task adopt {self._host.agent}/{task_id.name} --force` has it begin here"
        if birth.verdict is Verdict.RESTS:
            fact = birth.fact
            assert fact is not None
            whose = f"{fact.owner} has it" if fact.owner else "it is not known where it is"
            if fact.owner == self._host.agent:
                whose = "it was here last"
            why = (
                f"{fact.task_id} was born before ({whose}, epoch {fact.epoch}), and {self._host.agent} knows nothing of"
                f" {task_id}: its disk was lost, or its name is new. It rests here until it comes, or you decide:"
                f" {decide}, without the state that it had"
            )
            return Unsure(DISK_LOST, why, for_good=True)
        until = f"for {self._rule.wait_s:g} s at most"
        if slot.spec.guard is not None:
            until = f"or from more than half of the guardians that its configuration names; {decide}"
        why = f"{task_id} is new here, and may run elsewhere: it waits to hear from {missing}, {until}"
        return Unsure(f"{WAITS}{missing}", why)

    # Telling ---------------------------------------------------------------------------------------------------

    def _tell(self, slot: Slot, place: Place, birth: Birth) -> None:
        unborn, host, task_id = self._unborn_of(place), self._host, place.task_id
        missing = ", ".join(birth.missing)
        told = f"{birth.verdict.value} {birth.fact}"
        if unborn.told == told or birth.verdict is Verdict.WAITS:
            return
        unborn.told = told
        if birth.verdict is Verdict.UNASKED:
            host.log("warning", f"{task_id} is born, although nothing was heard of it from {missing}")
            host.event("born_unasked", task=task_id.name, missing=missing)
        else:
            unsure, fact = self._unsure(slot, place, birth), birth.fact
            assert unsure is not None and fact is not None
            host.log("error", unsure.why)
            host.event("not_born", task=task_id.name, owner=fact.owner, epoch=fact.epoch.n)

    def _still_unborn(self) -> list[tuple[Slot, Place]]:
        found = []
        for task_id in list(self._unborn):
            place = self._host.places.get(task_id)
            if place is None or not self._may_be_born(place):
                del self._unborn[task_id]
            elif place.slot is not None:
                found.append((place.slot, place))
        return found

    def _waiting(self) -> list[tuple[Slot, Place]]:
        return [(slot, place) for slot, place in self._still_unborn() if slot.life.state is State.REFUSED]

    def _look_again(self) -> None:
        for slot, place in self._waiting():
            if self._birth(slot, place, at_once=False).verdict is not Verdict.WAITS:
                self._host.feed_place(place, Retry())

    def _tell_of_waiting(self) -> None:
        waiting: dict[str, list[str]] = {}
        for slot, place in self._waiting():
            birth = self._birth(slot, place, at_once=False)
            if birth.verdict is Verdict.WAITS:
                waiting.setdefault(", ".join(birth.missing), []).append(place.task_id.name)
        for missing, names in waiting.items():
            tasks = ", ".join(sorted(names))
            text = f"not born yet: {tasks}. They are new here and may run elsewhere"
            self._host.log("warning", f"{text}, and nothing was heard of that from {missing}")
            self._host.event("birth_waits", tasks=tasks, missing=missing)

    def _wait_over(self) -> None:
        self._look_again()
        self._tell_of_waiting()

    # Asking ----------------------------------------------------------------------------------------------------

    def _ask(self, peers: tuple[str, ...]) -> None:
        task_ids = tuple(task_id for unborn in self._unborn.values() for task_id in unborn.task_ids)
        if task_ids:
            self._host.kernel.tell(CENSUS, AskAbout(peers, task_ids))

    def _ask_again(self) -> None:
        """A question or an answer may be lost. What waits looks again each second."""
        now_s = self._host.kernel.host.now()
        if now_s < self._asked_s + ASK_AGAIN_S:
            return
        self._asked_s = now_s
        heard = [self._unborn_of(place).said() for _, place in self._still_unborn()]  # one of them starts right now
        silent = [peer for peer in self._mesh.neighbours() if any(peer not in said for said in heard)]
        if silent:
            self._ask(tuple(silent))


HERE: Final = (Phase.OWNER, Phase.FROZEN)
"""The phases in which the task is here, as the disk says. Of a hand-off the other side knows how far it is."""

LOOK_S: Final = 1.0
ASK_COPIED_AGAIN_S: Final = 0.9


class _Heard(msgspec.Struct):
    """What those that take the disk for an old copy have told of one task.

    Attributes:
        by: the agents that have told.
        known: the newest that each of them knows.
    """

    by: set[str] = msgspec.field(default_factory=set)
    known: dict[str, TaskFact] = msgspec.field(default_factory=dict)


class CopiedTasks:
    """Has tasks stand still where their disk is an old copy. All in the service's actor.

    Args:
        host: the service.
        fault: returns why an agent is not believed what it knows of a task; empty: it is.
        went_on: called with the place of a task that went on elsewhere, and what is known of that.
    """

    def __init__(
        self,
        host: HostingService,
        fault: Callable[[str, Place], str],
        went_on: Callable[[Place, OtherOwner], None],
    ) -> None:
        self._host = host
        self._fault = fault
        self._went_on = went_on
        self._sayers: set[str] = set()
        self._copied: set[TaskId] = set()  # what came later is no copy
        self._told: dict[TaskId, _Heard] = {}
        self._decided: set[TaskId] = set()  # by a person
        self._asked_s = 0.0

    def noticed(self, peer: str) -> None:
        """Another agent takes the disk for an old copy."""
        if peer in self._sayers:
            return
        self._sayers.add(peer)
        places = self._host.places.values()
        self._copied.update(place.task_id for place in places if not place.standing.record.unborn)
        copied = [place for place in places if place.standing.record.phase in HERE]
        if any(self._verdict(place).verdict is CopyVerdict.WAITS for place in copied):
            sayers = " and ".join(sorted(self._sayers))
            self._host.log(
                "error",
                f"the disk of {self._host.agent} is an old copy, as {sayers} say: its tasks stand still until these"
                " have told where they are",
            )
            self._host.event("old_copy", peers=", ".join(sorted(self._sayers)))
        self._ask(copied)
        self._look()

    def heard(self, peer: str, told: TasksKnown) -> None:
        """Another agent has told what it knows."""
        if peer not in self._sayers:
            return
        facts = {fact.task_id: fact for fact in told.facts}
        for task_id in told.task_ids:
            place = self._host.places.get(task_id)
            if place is None or self._fault(peer, place):
                continue
            heard = self._told.setdefault(task_id, _Heard())
            heard.by.add(peer)
            if (fact := newest_fact((facts.get(task_id), heard.known.get(peer)))) is not None:
                heard.known[peer] = fact
            self._look_again(place)

    def of(self, place: Place) -> Unsure | None:
        """Returns why a task stands still; None: it need not, for all that this knows."""
        copied = self._verdict(place)
        if copied.verdict is not CopyVerdict.WAITS or place.standing.record.phase is not Phase.OWNER:
            return None
        name = f"{self._host.agent}/{place.task_id.name}"
        why = (
            f"the disk of {self._host.agent} is an old copy, as {' and '.join(sorted(self._sayers))} say, and"
            f" {place.task_id} may be elsewhere by now: it stands still until {', '.join(copied.missing)} told what"
            f" they know of it. `pancakes task adopt {name} --force` has it go on here"
        )
        self._ask_again()
        return Unsure(OLD_COPY, why)

    def undecided(self, name: str) -> list[Place]:
        """Returns the places of the tasks of a name that stand still, for a person to decide."""
        return [
            place
            for place in self._host.places.named(name)
            if self._verdict(place).verdict is CopyVerdict.WAITS and place.standing.record.phase is Phase.OWNER
        ]

    def decide(self, place: Place) -> None:
        """A person says that a task is to go on here."""
        self._decided.add(place.task_id)
        self._retry(place)

    def _verdict(self, place: Place) -> CopiedTask:
        record = place.standing.record
        if record.phase not in HERE or place.task_id not in self._copied or place.task_id in self._decided:
            return CopiedTask(CopyVerdict.GOES_ON)
        sayers = [peer for peer in self._sayers if not self._fault(peer, place)]
        told = self._told.get(place.task_id, _Heard())
        return copied_task(record.seen, sayers, told.by, tuple(told.known.values()))

    def _look(self) -> None:
        """Has what runs stand still; one that is being handed over does, and is looked at again once that is over."""
        waiting = [it for it in self._host.places.values() if self._verdict(it).verdict is CopyVerdict.WAITS]
        reason = f"the disk of {self._host.agent} is an old copy, and it may be elsewhere by now"
        for place in waiting:
            slot, standing = place.slot, place.standing
            lives = slot is not None and slot.life.state in (State.STARTING, State.RUNNING)
            if lives and idle(standing) and not standing.volatile.asked and standing.record.phase is Phase.OWNER:
                self._host.feed_place(place, StopAsked(reason=reason, again=True))
        if waiting:
            self._host.after_host(LOOK_S, self._look)

    def _look_again(self, place: Place) -> None:
        copied = self._verdict(place)
        if copied.verdict is CopyVerdict.ELSEWHERE and copied.fact is not None:
            peer = copied.fact.owner if copied.fact.owner not in ("", self._host.agent) else min(self._sayers)
            self._went_on(place, OtherOwner(peer, copied.fact.epoch))
        if copied.verdict is CopyVerdict.GOES_ON:
            self._retry(place)

    def _retry(self, place: Place) -> None:
        if place.slot is not None and place.slot.life.state is State.REFUSED:
            self._host.feed_place(place, Retry())

    # Asking ----------------------------------------------------------------------------------------------------

    def _ask(self, places: list[Place]) -> None:
        self._asked_s = self._host.kernel.host.now()
        if places:
            task_ids = tuple(place.task_id for place in places)
            self._host.kernel.tell(CENSUS, AskAbout(tuple(sorted(self._sayers)), task_ids))

    def _ask_again(self) -> None:
        """A question or an answer may be lost. What waits looks again each second."""
        if self._host.kernel.host.now() >= self._asked_s + ASK_COPIED_AGAIN_S:
            waiting = [it for it in self._host.places.values() if self._verdict(it).verdict is CopyVerdict.WAITS]
            self._ask(waiting)


ANSWERED_S: Final = 1.0
"""So long, in host time, the agents that are connected have for their answers."""


class InquiryFindings(msgspec.Struct, frozen=True):
    """What was found out about a task.

    Attributes:
        facts: what agents know of it.
        silent: the agents that have not answered.
    """

    facts: Sequence[TaskFact]
    silent: Sequence[str]


class _Inquiry(msgspec.Struct):
    """One task that is asked about.

    Attributes:
        type: entry point name of its class.
        silent: the agents that have not answered.
        facts: what the others know.
        done: gets what was found out.
    """

    type: str
    silent: list[str]
    facts: list[TaskFact]
    done: Callable[[InquiryFindings], None]


class Inquiries:
    """Asks all neighbours about tasks. All in the service's actor.

    Args:
        host: the service.
        mesh: says what neighbours there are.
    """

    def __init__(self, host: HostingService, mesh: Mesh) -> None:
        self._host = host
        self._mesh = mesh
        self._open: dict[TaskId, _Inquiry] = {}

    def about(self, task_id: TaskId) -> bool:
        """Returns whether a task is being asked about."""
        return task_id in self._open

    def begin(self, task_id: TaskId, type_name: str, done: Callable[[InquiryFindings], None]) -> None:
        """Asks about a task, and calls `done` once all have answered, or the time is over."""
        peers = sorted(self._mesh.neighbours())
        if not peers:
            done(InquiryFindings((), ()))
            return
        self._open[task_id] = inquiry = _Inquiry(type_name, peers, [], done)
        self._host.kernel.tell(CENSUS, AskAbout((), (task_id,)))
        self._host.after_host(ANSWERED_S, lambda: self._conclude(task_id, inquiry))

    def heard(self, peer: str, told: TasksKnown) -> None:
        """Another agent has told what it knows."""
        for task_id in told.task_ids:
            inquiry = self._open.get(task_id)
            if inquiry is None or peer not in inquiry.silent:
                continue
            inquiry.silent.remove(peer)
            for fact in told.facts:
                if fact.task_id == task_id:
                    self._learn(peer, inquiry, fact)
            if not inquiry.silent:
                self._conclude(task_id, inquiry)

    def _learn(self, peer: str, inquiry: _Inquiry, fact: TaskFact) -> None:
        access = self._host.kernel.access
        if fault := access.fault(peer, "host", inquiry.type) and access.fault(peer, "guard", inquiry.type):
            self._host.log("warning", f"{peer} says that it knows {fact.task_id}, and is not believed: {fault}")
        else:
            inquiry.facts.append(fact)

    def _conclude(self, task_id: TaskId, inquiry: _Inquiry) -> None:
        if self._open.get(task_id) is inquiry:
            del self._open[task_id]
            inquiry.done(InquiryFindings(tuple(inquiry.facts), tuple(inquiry.silent)))


class Disputes:
    """Looks at what other agents say that they own. All in the service's actor.

    Args:
        host: the service.
        records: what this agent knows.
        mesh: says what neighbours there are.
        rule: what is to be asked before a task is born.

    Attributes:
        births: the tasks that are new here.
        copied: those that may be elsewhere, as this agent's disk is an old copy.
        inquiries: those that are to be created.
    """

    def __init__(self, host: HostingService, records: Records, mesh: Mesh, rule: BirthRule) -> None:
        self._host = host
        self._claims = Claims()
        self._told: set[TaskId] = set()  # the tasks that were told not to be born
        self._unbelieved = LastSaid()
        self.births = Births(host, records, mesh, rule, self._fault_of_teller)
        self.inquiries = Inquiries(host, mesh)
        self.copied = CopiedTasks(host, self._fault_of_teller, self._went_on)

    def begin(self) -> None:
        """The service has begun."""
        self.births.begin()
        self._host.kernel.tell(CENSUS, HostBegan(self._host))

    def heard(self, news: CensusNews) -> None:
        """The census has news."""
        match news:
            case ClaimsCame():
                self._owned(news)
            case NeighbourCame():
                self.births.came(news.peer)
            case FactsCame():
                self.births.heard(news.peer, news.told)
                self.copied.heard(news.peer, news.told)
                self.inquiries.heard(news.peer, news.told)
            case CopyNoticed():
                self.copied.noticed(news.peer)

    def unsure(self, slot: Slot, place: Place, starts: bool = True) -> Unsure | None:
        """Returns why a task does not run here now, as its agent does not know what it must know; None: it does.

        Args:
            slot: its slot.
            place: its place.
            starts: whether it is about to start; otherwise it is only looked at.
        """
        return self.copied.of(place) or self._owned_elsewhere(place, starts) or self.births.of(slot, place, starts)

    def _owned_elsewhere(self, place: Place, starts: bool) -> Unsure | None:
        """Returns why a task is not born here that another agent says it owns."""
        host, other, task_id = self._host, place.other, place.task_id
        if other is None or not place.standing.record.may_begin:
            return None
        why = (
            f"{other.peer} owns {task_id} (epoch {other.epoch}), of which {host.agent} knows nothing: its disk was"
            f" lost. It stays there; `pancakes task migrate` brings it here"
        )
        if starts and task_id not in self._told:
            self._told.add(task_id)
            host.log("warning", f"{task_id} is not born: {why}")
            host.event("not_born", task=task_id.name, owner=other.peer, epoch=other.epoch.n)
        return Unsure(DISK_LOST, why, for_good=True)

    def _owned(self, message: ClaimsCame) -> None:
        for task_id, claim in message.claims.items():
            self._claims.heard(message.peer, claim)
            place = self._host.places.get(task_id)
            if place is not None:
                self._claimed(place, message.peer, claim)

    def claimant(self, task_id: TaskId) -> OtherOwner | None:
        """Returns the agent that has made the highest claim on a task, whether it was believed or not; None: none."""
        found = self._claims.of(task_id)
        return OtherOwner(found[0], found[1].epoch) if found is not None else None

    def _claimed(self, place: Place, peer: str, claim: OwnerClaim) -> None:
        other, record = OtherOwner(peer, claim.epoch), place.standing.record
        if place.other == other or (place.other is not None and place.other.epoch > other.epoch):
            return
        fault = self._host.kernel.access.fault(peer, "host", self._type_of(place))
        if not record.unborn and is_out_of_reach(claim.epoch, record.seen):
            fault = f"the epoch {claim.epoch} is further from {record.seen} than any task comes"
        if fault:
            if self._unbelieved.is_news(peer, f"{place.task_id} {fault}"):
                self._host.log("warning", f"{peer} says that it owns {place.task_id}, and is not believed: {fault}")
            return
        place.other = other
        if record.guarded and claim.epoch != record.epoch and not is_by_person(record, claim.epoch):
            # Which of them may run it the guardians decide; the lower one gives it up by itself.
            if claim.epoch < record.epoch:
                self._host.kernel.tell(CENSUS, Owns(OwnerClaim(place.task_id, record.epoch), peer))
            self._host.feed_place(place, ClaimHeard(peer, claim.epoch))
            return
        if record.phase is not Phase.OWNER:
            return
        # It may have become an owner since this agent told all what it owns.
        self._host.kernel.tell(CENSUS, Owns(OwnerClaim(place.task_id, record.epoch), peer))
        if claim.epoch < record.epoch:
            self._tell(record, other, stands_still=False)
        else:
            self._give_way(place, other)

    def look_for_owner(self, place: Place) -> None:
        """Drops a guarded task that was sent here where another agent has taken it over since.

        Not while this agent asks for pledges itself: its guardians may still decide for it.
        """
        record, claimant = place.standing.record, self.claimant(place.task_id)
        if claimant is None or claimant.epoch <= record.offer or place.taking is not None or not idle(place.standing):
            return
        try:
            guarded = rules_of(record.snapshot, place.task_id)[1].guard is not None
        except MigrationError:
            return
        if guarded and not self._host.kernel.access.fault(claimant.peer, "host", self._type_of(place)):
            self._host.log(
                "info", f"{place.task_id} runs on {claimant.peer}: what {record.peer} has sent of it is dropped"
            )
            self._host.feed_place(place, ClaimHeard(claimant.peer, claimant.epoch))

    def outvoted(self, place: Place, other: OtherOwner) -> None:
        """The guardians of a task follow another owner than this agent; `other.peer`: empty: no other agent."""
        if not other.peer or not is_by_person(place.standing.record, other.epoch):
            self._host.feed_place(place, ClaimHeard(other.peer, other.epoch))
        elif place.other != other:
            place.other = other
            self._give_way(place, other)

    def became_owner(self, place: Place) -> None:
        """This agent owns a task from now on, or under another epoch: all others are told."""
        self._host.kernel.tell(CENSUS, Owns(OwnerClaim(place.task_id, place.standing.record.epoch)))
        other = place.other
        if other is not None and other.epoch >= place.standing.record.epoch:
            self._give_way(place, other)
        else:
            place.other = None  # it owned the task before

    def _give_way(self, place: Place, other: OtherOwner) -> None:
        record = place.standing.record
        decided = record.guarded and other.epoch != record.epoch and not is_by_person(record, other.epoch)
        if not is_disputed(record) and not decided:
            self._tell(place.standing.record, other, stands_still=True)
        self._host.feed_place(place, ClaimHeard(other.peer, other.epoch))

    def _tell(self, record: Record, other: OtherOwner, stands_still: bool) -> None:
        task_id, agent = record.task_id, self._host.agent
        what = f"{task_id} is owned by {agent} (epoch {record.epoch}) and by {other.peer} (epoch {other.epoch})"
        if not stands_still:
            does = f"it goes on here, and must stand still on {other.peer}"
        elif other.epoch == record.epoch:
            does = "one of them is a copy of the other, so it stands still on both"
        else:
            does = f"it stands still here, and goes on on {other.peer}"
        resolve = f"`pancakes task resolve AGENT/{task_id.name}` says which of the two lives"
        self._host.log("error", f"{what}: {does}. {resolve}")
        self._host.event(
            "task_disputed", task=task_id.name, peer=other.peer, epoch=other.epoch.n, stands_still=stands_still
        )

    def _went_on(self, place: Place, other: OtherOwner) -> None:
        """What others know says that a task went on after the copy was made that this agent has for a disk."""
        if place.standing.record.phase is Phase.OWNER and (place.other is None or place.other.epoch < other.epoch):
            place.other = other
            self._give_way(place, other)

    def _fault_of_teller(self, peer: str, place: Place) -> str:
        """Returns why an agent is not believed what it knows of a task; empty: it may host it, or guard it."""
        access, of = self._host.kernel.access, self._type_of(place)
        return access.fault(peer, "host", of) and access.fault(peer, "guard", of)

    def _type_of(self, place: Place) -> str:
        if place.slot is not None and place.slot.spec.type:
            return place.slot.spec.type
        try:
            return Snapshot.decode(place.standing.record.snapshot).type
        except MigrationError:  # it has none, or one that cannot be read here
            return ""


ANSWER_S: Final = 0.3
"""So long each agent has to say where a task is, in host time: its source waits a second for the place."""
MOST_ASKED: Final = 8
"""So many agents are asked, one after the other, each named by the one before."""
MOST_OF_PEER: Final = 16
"""So many packets of one peer wait for an answer; of more, the peer asks again."""

Take = Callable[[Packet, Refusal | None], None]
"""Takes a packet, and why it is refused; None: it is not."""


class _Waiting(msgspec.Struct):
    """A packet that waits until other agents have said where the task is.

    Attributes:
        packet: the packet.
        take: takes it then.
        asked: the agents that were asked, the last one just now.
    """

    packet: Packet
    take: Take
    asked: list[str]


class Origins:
    """Asks the agents that must know which one has a task. All in the service's actor.

    The birthplace of a task knows, or the agent that has given it away, to which one it gave it, and so does each after
    that. If one of them has the task itself, no other gives it away, and no guardian has it taken over. An agent that
    is not linked, or does not answer, is no reason to refuse: a task outlives its birthplace. A guarded task is taken
    over also from an owner that is linked here, if its guardians do not let it act.

    Args:
        host: the service.
        records: what is known of tasks here.
    """

    def __init__(self, host: HostingService, records: Records) -> None:
        self._host = host
        self._records = records
        self._waiting: dict[tuple[str, str, TaskId], _Waiting] = {}

    def judge(self, packet: Packet, take: Take) -> None:
        """Has a packet taken that says where a task is to come from, once it is known whether that may be."""
        source, _, task_id = key = _key(packet)
        first = self._first(source, task_id, self._records.get(task_id))
        if not first:
            take(packet, None)
        elif key in self._waiting or sum(it[0] == source for it in self._waiting) < MOST_OF_PEER:
            waiting = self._waiting[key] = _Waiting(packet, take, [])
            self._ask(waiting, first)

    def told(self, packet: Packet) -> None:
        """An agent says which one has a task."""
        by, at = agent_of(packet.source), packet.body
        for (source, _, task_id), waiting in list(self._waiting.items()):
            if str(task_id) == at.task_id and waiting.asked[-1] == by:
                self._heard(waiting, source, by, at)

    def _first(self, source: str, task_id: TaskId, record: Record | None) -> str:
        """Returns the agent that must know where a task is; empty: none that can be asked."""
        gave_to = record.peer if record is not None and record.phase is Phase.RELEASED else ""
        knows = gave_to or task_id.birthplace
        return knows if knows != source and self._may_ask(knows) else ""

    def _may_ask(self, agent: str) -> bool:
        return agent != self._host.agent and self._host.connected(agent)

    def _heard(self, waiting: _Waiting, source: str, by: str, at: TaskAt) -> None:
        if at.peer == by and (at.acts or isinstance(waiting.packet.body, Reserve)):
            owned = f"{by} has {at.task_id}, under the epoch {at.epoch}: {source} has no right to it"
            self._end(waiting, Refusal("forbidden", owned))
        elif at.peer not in ("", source, *waiting.asked) and len(waiting.asked) < MOST_ASKED and self._may_ask(at.peer):
            self._ask(waiting, at.peer)
        else:
            self._end(waiting)

    def _ask(self, waiting: _Waiting, agent: str) -> None:
        waiting.asked.append(agent)
        task_id, number = str(waiting.packet.body.task_id), len(waiting.asked)
        try:
            self._host.publish(NETWORK, WhereIs(task_id), to=join(agent, COURIER))
        except PancakesError as error:
            self._host.log("debug", f"{agent} was not asked about {task_id}: {error}")
            self._end(waiting)
            return
        self._host.after_host(ANSWER_S, lambda: self._end(waiting) if len(waiting.asked) == number else None)

    def _end(self, waiting: _Waiting, refusal: Refusal | None = None) -> None:
        key = _key(waiting.packet)
        if self._waiting.get(key) is waiting:
            del self._waiting[key]
            waiting.take(waiting.packet, refusal)


def _key(packet: Packet) -> tuple[str, str, TaskId]:
    return agent_of(packet.source), packet.type, packet.body.task_id
