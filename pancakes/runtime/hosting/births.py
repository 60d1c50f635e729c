"""The births of one service's tasks: each waits until others have said that they know nothing of it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Final

import msgspec

from pancakes.mesh.migration.birth import Birth, BirthFacts, Verdict, birth_of
from pancakes.mesh.migration.knowledge import TaskFact, TasksKnown, fact_of
from pancakes.mesh.migration.record import TaskId
from pancakes.mesh.migration.rest import DISK_LOST, WAITS
from pancakes.mesh.net.mesh import Mesh
from pancakes.mesh.net.peers import reachable
from pancakes.runtime.hosting.census_messages import CENSUS, AskAbout
from pancakes.runtime.hosting.hosting_service import HostingService
from pancakes.runtime.hosting.last_said import LastSaid
from pancakes.runtime.hosting.lost import Lost
from pancakes.runtime.hosting.place import Place, Unsure
from pancakes.runtime.hosting.records import Records
from pancakes.runtime.life.life import State
from pancakes.runtime.life.life_event import Retry
from pancakes.runtime.supervision.slot import Slot

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
