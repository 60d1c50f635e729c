"""Whether a task may run here: births, old copies of disks, and other owners. In the service's actor.

A task must not start here while it may run elsewhere. `Births` asks the configured peers before a new task begins,
`Inquiries` asks all neighbours before a task is created, `CopiedTasks` pauses tasks if other agents say that this
disk is an old copy, and `Disputes` tells of other owners. The pure rules come first: `birth_of` decides whether a new
task may begin, and `copied_task` whether a task on an old copy of a disk may go on.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Sequence
from enum import Enum
from typing import Final

import msgspec

from pancakes.durable.answers import fact_of, newest_fact
from pancakes.durable.hosting import HostingService, OtherOwner, Place, Unsure
from pancakes.durable.messages import REGISTRAR, Fact, Known
from pancakes.durable.peer_talk import LastSaid
from pancakes.durable.record import DISK_LOST, OLD_COPY, WAITS, Lost, TaskId
from pancakes.durable.register import Epoch, Identity, Register
from pancakes.durable.register_messages import AskAbout, ClaimsCame, CopyNoticed, FactsCame, NeighbourCame, News
from pancakes.durable.rules import Confirmed
from pancakes.durable.rules import Known as Claim
from pancakes.durable.snapshot import Snapshot
from pancakes.durable.store import Records
from pancakes.errors import MigrationError
from pancakes.mesh.mesh import Mesh
from pancakes.mesh.peers import reachable
from pancakes.supervision.lifecycle import Retry, State, StopAsked
from pancakes.supervision.slots import Slot


class Verdict(Enum):
    """What becomes of a birth."""

    BORN = "born"
    """All that were to be asked know nothing of the task."""
    UNASKED = "unasked"
    """It begins although some have not said what they know."""
    WAITS = "waits"
    """Some have not said what they know."""
    RESTS = "rests"
    """It was born before: a person decides."""


class BirthFacts(msgspec.Struct, frozen=True):
    """What is to be known before a task is born.

    Attributes:
        named: the agents that are to be asked, by name; one that was never met, by its address.
        said: the agents that have said what they know.
        known: what they know, and what the own disk says of the task under another name of this agent.
        guardians: of a guarded task, the guardians that its configuration names; None: it is not guarded.
        over: whether the time that it waits is over.
    """

    named: Sequence[str] = ()
    said: Collection[str] = ()
    known: Sequence[Fact] = ()
    guardians: Sequence[str] | None = None
    over: bool = False


class Birth(msgspec.Struct, frozen=True):
    """What becomes of a birth, and why.

    Attributes:
        verdict: what becomes of it.
        missing: the agents that have not said what they know.
        fact: the newest that is known of the task; None: nothing.
    """

    verdict: Verdict
    missing: tuple[str, ...] = ()
    fact: Fact | None = None


def birth_of(facts: BirthFacts) -> Birth:
    """Decides whether a task begins."""
    missing = tuple(name for name in facts.named if name not in facts.said)
    if facts.known:
        return Birth(Verdict.RESTS, missing, max(facts.known, key=lambda fact: fact.epoch))
    if not missing:
        return Birth(Verdict.BORN)
    enough = facts.guardians is None or _most(facts.guardians, facts.said)
    return Birth(Verdict.UNASKED if facts.over and enough else Verdict.WAITS, missing)


def _most(guardians: Sequence[str], said: Collection[str]) -> bool:
    return 2 * sum(name in said for name in guardians) > len(guardians)


ENOUGH: Final = 2
"""So many agents must say so: one alone may have gone wrong. A quorum of guardians is never less."""


class CopyVerdict(Enum):
    """What becomes of a task."""

    GOES_ON = "goes on"
    """Too few say that the disk is an old copy; or those that say so know of no later owner."""
    WAITS = "waits"
    """It is paused until all that say so have told what they know of it."""
    ELSEWHERE = "elsewhere"
    """It went on after the copy was made: it is paused until a person decides."""


class CopiedTask(msgspec.Struct, frozen=True):
    """What becomes of a task, and why.

    Attributes:
        verdict: what becomes of it.
        missing: the agents that have still to tell what they know of it.
        fact: what tells of a later owner; None: nothing does.
    """

    verdict: CopyVerdict
    missing: tuple[str, ...] = ()
    fact: Fact | None = None


def copied_task(epoch: Epoch, sayers: Collection[str], told: Collection[str], known: Sequence[Fact]) -> CopiedTask:
    """Decides about a task that the disk says is owned here.

    Args:
        epoch: the epoch that the disk has.
        sayers: the agents that say that the disk is an old copy, and are believed.
        told: those that have told what they know of the task.
        known: what they know.
    """
    if len(sayers) < ENOUGH:
        return CopiedTask(CopyVerdict.GOES_ON)
    later = [fact for fact in known if fact.epoch > epoch]
    if later:
        return CopiedTask(CopyVerdict.ELSEWHERE, fact=max(later, key=lambda fact: fact.epoch))
    missing = tuple(sorted(set(sayers) - set(told)))
    return CopiedTask(CopyVerdict.WAITS if missing else CopyVerdict.GOES_ON, missing)


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
    known: dict[tuple[str, TaskId], Fact] = msgspec.field(default_factory=dict)
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
        for place in self._host.places.values():
            is_resident = place.slot is not None and place.slot.name in self._host.residents
            if self._may_be_born(place) and (is_resident or place.record.goes_on):
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

    def heard(self, peer: str, told: Known) -> None:
        """Another agent has told what it knows."""
        for unborn in self._unborn.values():
            about = set(unborn.task_ids).intersection(told.task_ids)
            if about:
                unborn.answered.setdefault(peer, set()).update(about)
                self._learn(peer, unborn, [fact for fact in told.facts if fact.task_id in about])
        self._look_again()

    def _learn(self, peer: str, unborn: _Unborn, facts: Iterable[Fact]) -> None:
        place = self._host.places[unborn.task_ids[0]]
        for fact in facts:
            known = unborn.known.get((peer, fact.task_id))
            if fact.epoch <= place.record.seen or (known is not None and known.epoch >= fact.epoch):
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
                    read = place.record if place.record.goes_on else None
                    found.append(Lost(place.task_id, unsure.why, read, heard=max([place.record.seen, *heard])))
        return found

    # Looking ---------------------------------------------------------------------------------------------------

    def _may_be_born(self, place: Place) -> bool:
        record = place.record
        return (record.may_begin and place.task_id.birthplace == self._host.agent) or record.goes_on

    def _unborn_of(self, place: Place) -> _Unborn:
        task_id = place.task_id
        found = self._unborn.get(task_id)
        if found is None:
            former = tuple(TaskId(name, task_id.name) for name in self._rule.former)
            found = self._unborn[task_id] = _Unborn((task_id, *former))
            for record in map(self._records.get, former):
                fact = fact_of(record) if record is not None and not record.unborn else None
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
        decide = f"`pancakes task recover {self._host.agent}/{task_id.name} --here` has it begin here"
        if birth.verdict is Verdict.RESTS:
            fact = birth.fact
            assert fact is not None
            whose = f"{fact.owner} has it" if fact.owner else "it is not known where it is"
            if fact.owner == self._host.agent:
                whose = "it was here last"
            if place.record.goes_on:
                why = (
                    f"{task_id} went on after the copy was made that {self._host.agent} has for a disk ({whose}, epoch"
                    f" {fact.epoch}). It rests here until it comes, or you decide:"
                    f" `pancakes task recover {self._host.agent}/{task_id.name}`"
                )
                return Unsure(OLD_COPY, why, for_good=True)
            why = (
                f"{fact.task_id} was born before ({whose}, epoch {fact.epoch}), and {self._host.agent} knows nothing of"
                f" {task_id}: its disk was lost, or its name is new. It rests here until it comes, or you decide:"
                f" {decide}, without the state that it had"
            )
            return Unsure(DISK_LOST, why, for_good=True)
        until = f"for {self._rule.wait_s:g} s at most"
        if slot.spec.guard is not None:
            until = f"or from more than half of the guardians that its configuration names; {decide}"
        is_copy = place.record.goes_on
        new = f"the disk of {self._host.agent} is a copy, and {task_id}" if is_copy else f"{task_id} is new here, and"
        why = f"{new} may run elsewhere: it waits to hear from {missing}, {until}"
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
            begins = "continues from a copy of its disk" if place.record.goes_on else "is born"
            host.log("warning", f"{task_id} {begins}, although nothing was heard of it from {missing}")
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
            text = f"not started yet: {tasks}. They are new here, or the disk is a copy, and they may run elsewhere"
            self._host.log("warning", f"{text}, and nothing was heard of that from {missing}")
            self._host.event("birth_waits", tasks=tasks, missing=missing)

    def _wait_over(self) -> None:
        self._look_again()
        self._tell_of_waiting()

    # Asking ----------------------------------------------------------------------------------------------------

    def _ask(self, peers: tuple[str, ...]) -> None:
        task_ids = tuple(task_id for unborn in self._unborn.values() for task_id in unborn.task_ids)
        if task_ids:
            self._host.kernel.tell(REGISTRAR, AskAbout(peers, task_ids))

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


LOOK_S: Final = 1.0
ASK_COPIED_AGAIN_S: Final = 0.9


class _Heard(msgspec.Struct):
    """What those that take the disk for an old copy have told of one task.

    Attributes:
        by: the agents that have told.
        known: the newest that each of them knows.
    """

    by: set[str] = msgspec.field(default_factory=set)
    known: dict[str, Fact] = msgspec.field(default_factory=dict)


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
        self._believed: set[tuple[str, TaskId]] = set()
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
        self._copied.update(place.task_id for place in places if not place.record.unborn)
        copied = [place for place in places if place.record.here or place.record.goes_on]
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
        for place in copied:
            if place.record.goes_on:
                self._retry(place)  # it waits for other agents from now on

    def heard(self, peer: str, told: Known) -> None:
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
        """Returns why a task is paused; None: it need not, for all that this knows."""
        copied = self._verdict(place)
        if copied.verdict is not CopyVerdict.WAITS or not (place.record.owned or place.record.goes_on):
            return None
        name = f"{self._host.agent}/{place.task_id.name}"
        why = (
            f"the disk of {self._host.agent} is an old copy, as {' and '.join(sorted(self._sayers))} say, and"
            f" {place.task_id} may be elsewhere by now: it is paused until {', '.join(copied.missing)} told what"
            f" they know of it. `pancakes task recover {name} --here` has it go on here"
        )
        self._ask_again()
        return Unsure(OLD_COPY, why)

    def undecided(self, name: str) -> list[Place]:
        """Returns the places of the tasks of a name that stand still, for a person to decide."""
        return [
            place
            for place in self._host.places.named(name)
            if self._verdict(place).verdict is CopyVerdict.WAITS and (place.record.owned or place.record.goes_on)
        ]

    def is_decided(self, place: Place) -> bool:
        """Return whether a person has said that a task is to go on here."""
        return place.task_id in self._decided

    def decide(self, place: Place) -> None:
        """A person says that a task is to go on here."""
        self._decided.add(place.task_id)
        self._retry(place)

    def _verdict(self, place: Place) -> CopiedTask:
        record = place.record
        is_here = record.here or record.goes_on
        if not is_here or place.task_id not in self._copied or place.task_id in self._decided:
            return CopiedTask(CopyVerdict.GOES_ON)
        sayers = [peer for peer in self._sayers if self._is_believed(peer, place)]
        told = self._told.get(place.task_id, _Heard())
        return copied_task(record.seen, sayers, told.by, tuple(told.known.values()))

    def _is_believed(self, peer: str, place: Place) -> bool:
        """Return whether an agent was believed once: what rights it has is known only while it is linked."""
        said = (peer, place.task_id)
        if said not in self._believed and not self._fault(peer, place):
            self._believed.add(said)
        return said in self._believed

    def _look(self) -> None:
        """Has what runs stand still; one that is being handed over does, and is looked at again once that is over."""
        waiting = [it for it in self._host.places.values() if self._verdict(it).verdict is CopyVerdict.WAITS]
        reason = f"the disk of {self._host.agent} is an old copy, and it may be elsewhere by now"
        for place in waiting:
            slot = place.slot
            lives = slot is not None and slot.life.state in (State.STARTING, State.RUNNING)
            if lives and place.course.settled and place.record.owned:
                self._host.feed_place(place, StopAsked(reason=reason, again=True))
        if waiting:
            self._host.after_host(LOOK_S, self._look)

    def _look_again(self, place: Place) -> None:
        copied = self._verdict(place)
        if copied.verdict is CopyVerdict.ELSEWHERE and copied.fact is not None:
            peer = copied.fact.owner if copied.fact.owner not in ("", self._host.agent) else min(self._sayers)
            self._went_on(place, OtherOwner(peer, copied.fact.epoch))
        if copied.verdict is not CopyVerdict.WAITS:
            self._retry(place)

    def _retry(self, place: Place) -> None:
        if place.slot is not None and place.slot.life.state is State.REFUSED:
            self._host.feed_place(place, Retry())

    # Asking ----------------------------------------------------------------------------------------------------

    def _ask(self, places: list[Place]) -> None:
        self._asked_s = self._host.kernel.host.now()
        if places:
            task_ids = tuple(place.task_id for place in places)
            self._host.kernel.tell(REGISTRAR, AskAbout(tuple(sorted(self._sayers)), task_ids))

    def _ask_again(self) -> None:
        """A question or an answer may be lost. What waits looks again each second."""
        if self._host.kernel.host.now() >= self._asked_s + ASK_COPIED_AGAIN_S:
            waiting = [it for it in self._host.places.values() if self._verdict(it).verdict is CopyVerdict.WAITS]
            self._ask(waiting)


MOST_CLAIMS: Final = 4096
"""At most this many claims are remembered; of more, the one that was heard first is forgotten."""
ANSWERED_S: Final = 1.0
"""So long, in host time, the agents that are connected have for their answers."""


class InquiryFindings(msgspec.Struct, frozen=True):
    """What was found out about a task.

    Attributes:
        facts: what agents know of it.
        silent: the agents that have not answered.
    """

    facts: Sequence[Fact]
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
    facts: list[Fact]
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
        self._host.kernel.tell(REGISTRAR, AskAbout((), (task_id,)))
        self._host.after_host(ANSWERED_S, lambda: self._conclude(task_id, inquiry))

    def heard(self, peer: str, told: Known) -> None:
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

    def _learn(self, peer: str, inquiry: _Inquiry, fact: Fact) -> None:
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
        self._claims: dict[TaskId, OtherOwner] = {}  # the highest claim on each task, believed or not
        self._told: set[TaskId] = set()  # the tasks that were told not to be born
        self._told_of: dict[TaskId, Epoch] = {}  # the other owners of which people were told
        self.births = Births(host, records, mesh, rule, self._fault_of_teller)
        self.inquiries = Inquiries(host, mesh)
        self.copied = CopiedTasks(host, self._fault_of_teller, self._went_on)

    def begin(self) -> None:
        """The service has begun."""
        self.births.begin()

    def heard(self, news: News) -> None:
        """The registrar has news."""
        match news:
            case ClaimsCame():
                for task_id, claim in news.claims.items():
                    self._claimed(task_id, OtherOwner(news.peer, claim.register.epoch))
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
        if self.copied.is_decided(place):
            return None
        return self.copied.of(place) or self._owned_elsewhere(place, starts) or self.births.of(slot, place, starts)

    def _owned_elsewhere(self, place: Place, starts: bool) -> Unsure | None:
        """Returns why a task is not born here that another agent says it owns."""
        host, other, task_id = self._host, place.other, place.task_id
        is_later = place.record.goes_on and other is not None and other.epoch > place.record.seen
        if other is None or not (place.record.may_begin or is_later):
            return None
        owns = f"{other.peer} owns {task_id} (epoch {other.epoch})"
        word, because = OLD_COPY, f", and the disk of {host.agent} is a copy"
        if not is_later:
            word, because = DISK_LOST, f", of which {host.agent} knows nothing: its disk was lost"
        why = f"{owns}{because}. It stays there; `pancakes task migrate` brings it here"
        if starts and task_id not in self._told:
            self._told.add(task_id)
            host.log("warning", f"{task_id} does not start: {why}")
            host.event("not_born", task=task_id.name, owner=other.peer, epoch=other.epoch.n)
        return Unsure(word, why, for_good=True)

    def claimant(self, task_id: TaskId) -> OtherOwner | None:
        """Return the agent that has made the highest claim on a task, whether it was believed or not; None: none."""
        return self._claims.get(task_id)

    def _claimed(self, task_id: TaskId, other: OtherOwner) -> None:
        known = self._claims.get(task_id)
        if known is None or known.epoch <= other.epoch:
            self._claims[task_id] = other
            if len(self._claims) > MOST_CLAIMS:
                del self._claims[next(iter(self._claims))]
        place = self._host.places.get(task_id)
        if place is None or place.other == other or (place.other is not None and place.other.epoch > other.epoch):
            return
        if self._host.kernel.access.fault(other.peer, "host", self._type_of(place)):
            return
        place.other = other
        record = place.record
        is_lower = other.epoch < record.epoch and record.owned and not record.guarded
        if is_lower or (record.disputed and other.epoch > record.epoch):
            self._tell(place, other)

    def was_paused(self, place: Place) -> None:
        """A task is paused here from now on, because another agent owns it too."""
        if place.other is not None and place.other.epoch > place.record.epoch:
            self._tell(place, place.other)

    def became_owner(self, place: Place) -> None:
        """This agent owns a task from now on, or under another epoch."""
        other = place.other
        if other is not None and other.epoch < place.record.epoch:
            place.other = None  # it owned the task before

    def _tell(self, place: Place, other: OtherOwner) -> None:
        """Tell people of two owners. The register of the lower one has it paused."""
        record, task_id, agent = place.record, place.task_id, self._host.agent
        if self._told_of.get(task_id) == other.epoch:
            return
        self._told_of[task_id] = other.epoch
        is_paused = other.epoch > record.epoch
        what = f"{task_id} is owned by {agent} (epoch {record.epoch}) and by {other.peer} (epoch {other.epoch})"
        does = f"it is paused here, and runs on {other.peer}"
        if not is_paused:
            does = f"it runs here, and must be paused on {other.peer}"
        recover = f"`pancakes task recover AGENT/{task_id.name}` says which of the two lives"
        self._host.log("error", f"{what}: {does}. {recover}")
        told = {"peer": other.peer, "epoch": other.epoch.n, "stands_still": is_paused}
        self._host.event("task_disputed", task=task_id.name, **told)

    def _went_on(self, place: Place, other: OtherOwner) -> None:
        """What others know says that a task went on after the copy was made that this agent has for a disk."""
        if place.record.owned and (place.other is None or place.other.epoch < other.epoch):
            place.other = other
            claim = Claim(Identity(other.peer), Register(other.epoch))
            self._host.tell_registrar(place, Confirmed(claim), lambda outcome, why: None)

    def _fault_of_teller(self, peer: str, place: Place) -> str:
        """Returns why an agent is not believed what it knows of a task; empty: it may host it, or guard it."""
        access, of = self._host.kernel.access, self._type_of(place)
        return access.fault(peer, "host", of) and access.fault(peer, "guard", of)

    def _type_of(self, place: Place) -> str:
        if place.slot is not None and place.slot.spec.type:
            return place.slot.spec.type
        try:
            return Snapshot.decode(place.record.snapshot).type
        except MigrationError:  # it has none, or one that cannot be read here
            return ""
