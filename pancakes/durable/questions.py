"""Whether a task may run here: births, old copies of disks, and other owners. In the service's actor.

A task must not start here while it may run elsewhere. `Questions` asks other agents what they know: the configured
peers before a new task begins (`Births`), all neighbours before a task is created, and those that say that this disk
is an old copy before its tasks go on (`CopiedTasks`). `Disputes` tells of other owners. The pure rules come first:
`birth_of` decides whether a new task may begin, and `copied_task` whether a task on an old copy of a disk may go on.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Sequence
from enum import Enum
from typing import TYPE_CHECKING, Final

import msgspec

from pancakes.durable.answers import fact_of
from pancakes.durable.hosting import OtherOwner, Place, Unsure
from pancakes.durable.messages import REGISTRAR, Fact, Known
from pancakes.durable.peer_talk import LastSaid
from pancakes.durable.record import DISK_LOST, OLD_COPY, WAITS, Lost, TaskId
from pancakes.durable.register import Epoch, Identity, Register
from pancakes.durable.register_messages import AskAbout, CopyNoticed, KnownCame, NeighbourCame, News
from pancakes.durable.rules import Confirmed
from pancakes.durable.rules import Known as Claim
from pancakes.durable.snapshot import Snapshot
from pancakes.durable.store import Records
from pancakes.errors import MigrationError
from pancakes.mesh.mesh import Mesh
from pancakes.mesh.peers import reachable
from pancakes.supervision.lifecycle import Retry, State, StopAsked
from pancakes.supervision.slots import Slot

if TYPE_CHECKING:
    from pancakes.durable.client_service import ClientServiceCore


class Verdict(Enum):
    """Whether a task may run here, as far as others have told."""

    GOES_ON = "goes on"
    """Nothing speaks against it."""
    UNASKED = "unasked"
    """It goes on although some have not told what they know."""
    WAITS = "waits"
    """Some have not told what they know."""
    RESTS = "rests"
    """It was born before, or went on elsewhere: it is paused until a person decides."""


class Finding(msgspec.Struct, frozen=True):
    """Whether a task may run here, and why not.

    Attributes:
        verdict: whether it may.
        missing: the agents that have not told what they know.
        fact: of a task that rests, the newest that is known of it.
    """

    verdict: Verdict
    missing: tuple[str, ...] = ()
    fact: Fact | None = None


def birth_of(
    named: Sequence[str] = (),
    said: Collection[str] = (),
    known: Sequence[Fact] = (),
    guardians: Sequence[str] | None = None,
    over: bool = False,
) -> Finding:
    """Decide whether a task begins.

    Args:
        named: the agents that are to be asked, by name; one that was never met, by its address.
        said: the agents that have told what they know.
        known: what they know, and what the own disk says of the task under another name of this agent.
        guardians: of a guarded task, the guardians that its configuration names; None: it is not guarded.
        over: whether the time that it waits is over.
    """
    missing = tuple(name for name in named if name not in said)
    if known:
        return Finding(Verdict.RESTS, missing, max(known, key=lambda fact: fact.epoch))
    if not missing:
        return Finding(Verdict.GOES_ON)
    enough = guardians is None or 2 * sum(name in said for name in guardians) > len(guardians)
    return Finding(Verdict.UNASKED if over and enough else Verdict.WAITS, missing)


ENOUGH: Final = 2
"""At least this many agents must say that a disk is an old copy: a single one may be wrong."""


def copied_task(epoch: Epoch, sayers: Collection[str], told: Collection[str], known: Sequence[Fact]) -> Finding:
    """Decide whether a task goes on that the disk says is owned here.

    Args:
        epoch: the epoch that the disk has.
        sayers: the agents that say that the disk is an old copy, and are believed.
        told: those that have told what they know of the task.
        known: what they know.
    """
    if len(sayers) < ENOUGH:
        return Finding(Verdict.GOES_ON)
    later = [fact for fact in known if fact.epoch > epoch]
    if later:
        return Finding(Verdict.RESTS, fact=max(later, key=lambda fact: fact.epoch))
    missing = tuple(sorted(set(sayers) - set(told)))
    return Finding(Verdict.WAITS if missing else Verdict.GOES_ON, missing)


ASK_AGAIN_S: Final = 0.9
"""A question or an answer may be lost. A task that waits looks again each second."""
ANSWERED_S: Final = 1.0
"""Agents have this long to answer before a task is created, in host time."""

Done = Callable[[Sequence[Fact], Sequence[str]], None]
"""Takes what agents know of a task, and the agents that have not answered."""


class _Told(msgspec.Struct):
    """What other agents have told of a task that they were asked about.

    Attributes:
        type: entry point name of its class.
        by: the agents that have told.
        known: the newest that each of them knows, if it may host or guard the task.
        asked_s: when they were asked last, in host time.
    """

    type: str
    by: set[str] = set()
    known: dict[str, Fact] = {}
    asked_s: float = -1e9


class Questions:
    """Asks other agents what they know of tasks, and remembers what they tell. All in the service's actor.

    Args:
        host: the service.
        mesh: says what neighbours there are.
    """

    def __init__(self, host: ClientServiceCore, mesh: Mesh) -> None:
        self._host = host
        self._mesh = mesh
        self._told: dict[TaskId, _Told] = {}
        self._inquiries: dict[TaskId, tuple[list[str], Done]] = {}
        self._unbelieved = LastSaid()

    def about(self, task_id: TaskId, place: Place) -> _Told:
        """Return what was told of a task, which is that of a place, or was under another name of this agent."""
        return self._told.get(task_id) or self._told.setdefault(task_id, _Told(_type_of(place)))

    def ask(self, task_ids: Sequence[TaskId], peers: Sequence[str] = ()) -> None:
        """Ask agents about tasks; no peers: all neighbours."""
        if task_ids:
            for told in filter(None, map(self._told.get, task_ids)):
                told.asked_s = self._host.kernel.host.now()
            self._host.kernel.tell(REGISTRAR, AskAbout(tuple(peers), tuple(task_ids)))

    def ask_again(self, task_id: TaskId, waiting: Callable[[], Sequence[TaskId]], peers: Sequence[str]) -> None:
        """Ask those agents once more that have not told of all tasks, if it is time for one that waits.

        Args:
            task_id: the task that waits.
            waiting: returns all tasks that wait. It is called at most once in `ASK_AGAIN_S`, however many these are.
            peers: the agents.
        """
        due_s = self._host.kernel.host.now() - ASK_AGAIN_S
        if (told := self._told.get(task_id)) is None or told.asked_s > due_s:
            return
        due = [it for it in waiting() if it in self._told and self._told[it].asked_s <= due_s]
        for it in due:
            self._told[it].asked_s = self._host.kernel.host.now()
        if silent := [peer for peer in peers if any(peer not in self._told[it].by for it in due)]:
            self.ask(due, silent)

    def forget(self, task_ids: Iterable[TaskId]) -> None:
        """Forget what was told of tasks: that is old by the time at which it is asked again."""
        for task_id in task_ids:
            if task_id not in self._inquiries:
                self._told.pop(task_id, None)

    def inquire(self, task_id: TaskId, type_name: str, done: Done) -> None:
        """Ask all neighbours about a task, and call `done` once all have answered, or the time is over."""
        peers = sorted(self._mesh.neighbours())
        if not peers:
            done((), ())
            return
        self._told[task_id], self._inquiries[task_id] = _Told(type_name), (peers, done)
        self.ask((task_id,))
        self._host.after_host(ANSWERED_S, lambda: self._conclude(task_id, done))

    def inquires(self, task_id: TaskId) -> bool:
        """Return whether all neighbours are being asked about a task."""
        return task_id in self._inquiries

    def _conclude(self, task_id: TaskId, done: Done) -> None:
        peers, waits = self._inquiries.get(task_id, ([], None))
        if waits is done:
            told = self._told.pop(task_id)
            del self._inquiries[task_id]
            done(tuple(told.known.values()), [peer for peer in peers if peer not in told.by])

    def heard(self, peer: str, known: Known) -> None:
        """Another agent has told what it knows."""
        for task_id in known.task_ids:
            if (told := self._told.get(task_id)) is None:
                continue
            facts = [fact for fact in known.facts if fact.task_id == task_id]
            fault = self.fault(peer, told.type) if facts else ""
            if fault and peer not in self._mesh.neighbours():
                continue  # its link has ended since, and what it may do is not known; it is asked again
            told.by.add(peer)
            if facts and not fault:
                told.known[peer] = max([*facts, told.known.get(peer, facts[0])], key=lambda fact: fact.epoch)
            elif fault and self._unbelieved.is_news(peer, f"{task_id} {fault}"):
                self._host.log("warning", f"{peer} says that it knows {task_id}, and is not believed: {fault}")
            peers, done = self._inquiries.get(task_id, ([], None))
            if done is not None and told.by.issuperset(peers):
                self._conclude(task_id, done)

    def fault(self, peer: str, type_name: str) -> str:
        """Return why an agent is not believed what it knows of a task; empty: it may host it, or guard it."""
        access = self._host.kernel.access
        return access.fault(peer, "host", type_name) and access.fault(peer, "guard", type_name)


def _type_of(place: Place) -> str:
    if place.slot is not None and place.slot.spec.type:
        return place.slot.spec.type
    try:
        return Snapshot.decode(place.record.snapshot).type
    except MigrationError:  # it has none, or one that cannot be read here
        return ""


TOLD_S: Final = 1.0
"""A birth that waits longer than this is told of: when a fleet starts, all wait for a moment."""


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
        here: what this agent knows of it under its former names.
        told: what was told of it last.
    """

    task_ids: tuple[TaskId, ...]
    here: list[Fact]
    told: str = ""


class Births:
    """Asks other agents about tasks of which this one knows nothing. All in the service's actor.

    Args:
        host: the service.
        records: what this agent knows.
        mesh: says which of the agents that are to be asked were met.
        rule: what to ask.
        questions: asks them.
    """

    def __init__(
        self, host: ClientServiceCore, records: Records, mesh: Mesh, rule: BirthRule, questions: Questions
    ) -> None:
        self._host = host
        self._records = records
        self._mesh = mesh
        self._rule = rule
        self._questions = questions
        self._began_s = host.kernel.host.now()
        self._unborn: dict[TaskId, _Unborn] = {}
        self._strangers: set[str] = set()  # named in `peers`, and no agents: a simulated world owns no task

    def begin(self) -> None:
        """Ask about all tasks that are new here."""
        for place in self._host.places.values():
            is_resident = place.slot is not None and place.slot.name in self._host.residents
            if self._may_be_born(place) and (is_resident or place.record.goes_on):
                self._unborn_of(place)
        if self._unborn and self._rule.asks:
            self._questions.ask(self._names())
            self._host.after_host(min(TOLD_S, self._rule.wait_s), self._tell_of_waiting)
            self._host.after_host(self._rule.wait_s, self._wait_over)

    def came(self, peer: str) -> None:
        """Another agent can be asked now."""
        if self._rule.asks:
            self._questions.ask(self._names(), (peer,))
            self.look_again()

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
        if birth.verdict is Verdict.GOES_ON:
            return None
        if starts:
            self._tell(slot, place, birth)
            if birth.verdict is Verdict.WAITS:
                self._questions.ask_again(place.task_id, self._names, self._mesh.neighbours())
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

    def is_known(self, task_id: TaskId) -> None:
        """A task is born, or is known by now."""
        if (unborn := self._unborn.pop(task_id, None)) is not None:
            self._questions.forget(unborn.task_ids)

    # Looking ---------------------------------------------------------------------------------------------------

    def _may_be_born(self, place: Place) -> bool:
        record = place.record
        return (record.may_begin and place.task_id.birthplace == self._host.agent) or record.goes_on

    def _unborn_of(self, place: Place) -> _Unborn:
        task_id = place.task_id
        found = self._unborn.get(task_id)
        if found is None:
            former = tuple(TaskId(name, task_id.name) for name in self._rule.former)
            records = [record for record in map(self._records.get, former) if record is not None]
            here = [fact_of(record) for record in records if not record.unborn and record.seen > place.record.seen]
            found = self._unborn[task_id] = _Unborn((task_id, *former), here)
            for name in found.task_ids:
                self._questions.about(name, place)
        return found

    def _names(self) -> list[TaskId]:
        return [task_id for unborn in self._unborn.values() for task_id in unborn.task_ids]

    def _birth(self, slot: Slot, place: Place, at_once: bool) -> Finding:
        unborn, rule = self._unborn_of(place), slot.spec.guard
        over = at_once or self._host.kernel.host.now() >= self._began_s + self._rule.wait_s
        named = self._named(place) if self._rule.asks else ()
        guardians = [name for name in rule.guardians if name != self._host.agent] if rule is not None else None
        told = [self._questions.about(task_id, place) for task_id in unborn.task_ids]
        said = set.intersection(*(it.by for it in told)) | self._strangers
        # Of one that was removed here, others may know what was before.
        known = [fact for it in told for fact in it.known.values() if fact.epoch > place.record.seen]
        return birth_of(named, said, [*unborn.here, *known], guardians, over)

    def _named(self, place: Place) -> Sequence[str]:
        """Returns the agents that are to be asked, by name; those that were never met by their address."""
        described = self._mesh.describe()
        if described["state"] == "new":
            return self._rule.peers
        at: dict[str, str] = {}
        for link in described["peers"]:
            if link["role"] != "agent":
                self._strangers.add(link["name"])
            # It dialled this agent, and says where it can be dialled.
            if not self._questions.fault(link["name"], _type_of(place)):
                at.update((reachable(address, link["remote"]), link["name"]) for address in link["addresses"])
        named = (it for it in described["addresses"] if it["static"])
        return list(dict.fromkeys(it["name"] or at.get(it["address"]) or it["address"] for it in named))

    def _unsure(self, slot: Slot, place: Place, birth: Finding) -> Unsure | None:
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

    def _tell(self, slot: Slot, place: Place, birth: Finding) -> None:
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

    def _waiting(self) -> list[tuple[Slot, Place]]:
        found = []
        for task_id in list(self._unborn):
            place = self._host.places.get(task_id)
            if place is None or not self._may_be_born(place):
                self.is_known(task_id)
            elif place.slot is not None and place.slot.life.state is State.REFUSED:
                found.append((place.slot, place))
        return found

    def look_again(self) -> None:
        """See whether what waits may begin: another agent has told what it knows."""
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
        self.look_again()
        self._tell_of_waiting()


LOOK_S: Final = 1.0


class CopiedTasks:
    """Pauses the tasks of this agent while others say that its disk is an old copy. All in the service's actor.

    Args:
        host: the service.
        questions: asks those that say so.
        went_on: called with the place of a task that went on elsewhere, and what is known of that.
    """

    def __init__(
        self, host: ClientServiceCore, questions: Questions, went_on: Callable[[Place, OtherOwner], None]
    ) -> None:
        self._host = host
        self._questions = questions
        self._went_on = went_on
        self._sayers: set[str] = set()
        self._believed: set[tuple[str, TaskId]] = set()
        self._copied: set[TaskId] = set()  # what came later is no copy

    def noticed(self, peer: str) -> None:
        """Another agent takes the disk for an old copy."""
        if peer in self._sayers:
            return
        self._sayers.add(peer)
        places = self._host.places.values()
        self._copied.update(place.task_id for place in places if not place.record.unborn)
        copied = [place for place in places if place.record.here or place.record.goes_on]
        for place in copied:
            self._questions.about(place.task_id, place).by.discard(peer)
        if self._waiting():
            sayers = " and ".join(sorted(self._sayers))
            self._host.log(
                "error",
                f"the disk of {self._host.agent} is an old copy, as {sayers} say: its tasks are paused until these"
                " have told where they are",
            )
            self._host.event("old_copy", peers=", ".join(sorted(self._sayers)))
        self._questions.ask([place.task_id for place in copied], sorted(self._sayers))
        self._look()
        for place in copied:
            if place.record.goes_on:
                self._retry(place)  # it waits for other agents from now on

    def heard(self, peer: str, known: Known) -> None:
        """Another agent has told what it knows."""
        if peer in self._sayers:
            for place in filter(None, map(self._host.places.get, known.task_ids)):
                if self._questions.fault(peer, _type_of(place)):  # it may not say so any more: the task waits on
                    self._questions.about(place.task_id, place).by.discard(peer)
                self._look_again(place)

    def of(self, place: Place) -> Unsure | None:
        """Returns why a task is paused; None: it need not, for all that this knows."""
        copied = self._verdict(place)
        if copied.verdict is not Verdict.WAITS or not (place.record.owned or place.record.goes_on):
            return None
        name = f"{self._host.agent}/{place.task_id.name}"
        why = (
            f"the disk of {self._host.agent} is an old copy, as {' and '.join(sorted(self._sayers))} say, and"
            f" {place.task_id} may be elsewhere by now: it is paused until {', '.join(copied.missing)} told what"
            f" they know of it. `pancakes task recover {name} --here` has it go on here"
        )
        self._questions.ask_again(place.task_id, lambda: [it.task_id for it in self._waiting()], sorted(self._sayers))
        return Unsure(OLD_COPY, why)

    def undecided(self, name: str) -> list[Place]:
        """Return the places of the tasks of a name that are paused, for a person to decide."""
        waiting = [place for place in self._waiting() if place.task_id.name == name]
        return [place for place in waiting if place.record.owned or place.record.goes_on]

    def became_owner(self, place: Place) -> None:
        """This agent owns a task under an epoch that the copy does not have."""
        self._copied.discard(place.task_id)

    def _waiting(self) -> list[Place]:
        return [it for it in self._host.places.values() if self._verdict(it).verdict is Verdict.WAITS]

    def _verdict(self, place: Place) -> Finding:
        record = place.record
        is_here = record.here or record.goes_on
        if not is_here or place.task_id not in self._copied:
            return Finding(Verdict.GOES_ON)
        sayers = [peer for peer in self._sayers if self._is_believed(peer, place)]
        told = self._questions.about(place.task_id, place)
        return copied_task(record.seen, sayers, told.by, [it for by, it in told.known.items() if by in sayers])

    def _is_believed(self, peer: str, place: Place) -> bool:
        """Return whether an agent was believed once: what rights it has is known only while it is linked."""
        said = (peer, place.task_id)
        if said not in self._believed and not self._questions.fault(peer, _type_of(place)):
            self._believed.add(said)
        return said in self._believed

    def _look(self) -> None:
        """Pause what runs; a task that is being handed over is looked at again once that is over."""
        waiting = self._waiting()
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
        if copied.fact is not None:
            peer = copied.fact.owner if copied.fact.owner not in ("", self._host.agent) else min(self._sayers)
            self._went_on(place, OtherOwner(peer, copied.fact.epoch))
        if copied.verdict is not Verdict.WAITS:
            self._retry(place)

    def _retry(self, place: Place) -> None:
        if place.slot is not None and place.slot.life.state is State.REFUSED:
            self._host.feed_place(place, Retry())


MOST_CLAIMS: Final = 4096
"""At most this many claims are remembered; of more, the one that was heard first is forgotten."""


class Disputes:
    """Looks at what other agents say that they own. All in the service's actor.

    Args:
        host: the service.
        records: what this agent knows.
        mesh: says what neighbours there are.
        rule: what to ask before a task is born.

    Attributes:
        questions: what other agents are asked.
        births: the tasks that are new here.
        copied: those that may be elsewhere, as this agent's disk is an old copy.
    """

    def __init__(self, host: ClientServiceCore, records: Records, mesh: Mesh, rule: BirthRule) -> None:
        self._host = host
        self._claims: dict[TaskId, OtherOwner] = {}  # the highest claim on each task, believed or not
        self._told: set[TaskId] = set()  # the tasks that were told not to be born
        self._told_of: dict[TaskId, Epoch] = {}  # the other owners of which people were told
        self.questions = Questions(host, mesh)
        self.births = Births(host, records, mesh, rule, self.questions)
        self.copied = CopiedTasks(host, self.questions, self._went_on)

    def begin(self) -> None:
        """The service has begun."""
        self.births.begin()

    def heard(self, news: News) -> None:
        """The registrar has news."""
        match news:
            case NeighbourCame():
                self.births.came(news.peer)
            case KnownCame():
                self.questions.heard(news.peer, news.known)
                if news.known.task_ids:
                    self.births.look_again()
                    self.copied.heard(news.peer, news.known)
                for claim in news.known.claims:
                    self._claimed(claim.task_id, OtherOwner(news.peer, claim.register.epoch, news.known.by.journal))
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
        if self._host.kernel.access.fault(other.peer, "host", _type_of(place)):
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
        self.copied.became_owner(place)
        self.births.is_known(place.task_id)
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
