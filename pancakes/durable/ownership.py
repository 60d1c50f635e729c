"""Who owns a task: what agents ask and tell each other about that, and what follows. Pure.

An agent alone cannot know whether a task runs elsewhere if its disk was lost, or if its disk is an old copy. So
agents exchange what they own (`Owned`), know (`AskTasks`, `TasksKnown`, `WhereIs`, `TaskAt`) and remember of each
other's boots (`BootRemembered`). `birth_of` decides whether a new task may begin, and `copied_task` whether a task on
an old copy of a disk may go on.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Sequence
from enum import Enum
from typing import Annotated, Final, NamedTuple

import msgspec

from pancakes.durable.record import NO_EPOCH, Epoch, Phase, Record, TaskId
from pancakes.packet import packet_type

MOST_ASKED: Final = 256
"""So many tasks are asked about at once."""


class TaskFact(msgspec.Struct, frozen=True):
    """What an agent knows of a task.

    Attributes:
        task_id: the task.
        owner: the agent that has it, as far as is known; empty: it is not known.
        epoch: the highest epoch that is known of it.
        removed: whether it was removed, and is nowhere.
    """

    task_id: TaskId
    owner: str
    epoch: Epoch
    removed: bool = False


Asked = Annotated[tuple[TaskId, ...], msgspec.Meta(max_length=MOST_ASKED)]


@packet_type("task.ask")
class AskTasks(msgspec.Struct, frozen=True):
    """Asks the census of another agent what that one knows of tasks.

    Attributes:
        task_ids: the tasks.
    """

    task_ids: Asked


@packet_type("task.known")
class TasksKnown(msgspec.Struct, frozen=True):
    """The answer to `AskTasks`.

    Attributes:
        task_ids: the tasks that were asked about.
        facts: what the sender knows; of the other tasks nothing.
    """

    task_ids: Asked
    facts: Annotated[tuple[TaskFact, ...], msgspec.Meta(max_length=MOST_ASKED)]


def fact_of(me: str, record: Record) -> TaskFact | None:
    """Returns what the record of a task on the agent `me` says; None: nothing."""
    if record.unborn:
        return None
    ours = record.phase in (Phase.OWNER, Phase.FROZEN)
    offered = record.offer if record.phase in (Phase.COMMITTED, Phase.PREPARED) else NO_EPOCH
    owner, epoch = me if ours else record.peer, max(record.seen, record.epoch, offered)
    return TaskFact(record.task_id, owner, epoch, record.removed)


def newest_fact(facts: Iterable[TaskFact | None]) -> TaskFact | None:
    """Returns the fact with the highest epoch; None: there is none. A task is removed under the epoch that it has."""
    known = [fact for fact in facts if fact is not None]
    return max(known, key=lambda fact: (fact.epoch, fact.removed), default=None)


def questions(task_ids: Sequence[TaskId]) -> list[AskTasks]:
    """Returns the packets that ask about tasks."""
    return [AskTasks(tuple(task_ids[at : at + MOST_ASKED])) for at in range(0, len(task_ids), MOST_ASKED)]


IN_ONE_PACKET: Final = 256
"""So many claims are told at once."""
MOST: Final = 4096
"""So many claims of one agent are remembered; of more, the one that was heard first is forgotten."""
MOST_AGENTS: Final = 1024
"""Of so many agents they are; of more, the one that has said nothing for longest is forgotten."""


class OwnerClaim(msgspec.Struct, frozen=True):
    """An agent owns a task.

    Attributes:
        task_id: the task.
        epoch: under which epoch.
    """

    task_id: TaskId
    epoch: Epoch


@packet_type("task.owned")
class Owned(msgspec.Struct, frozen=True):
    """Tells the census of another agent what this one owns: all when a link comes up, and what is new after that.

    Attributes:
        claims: the tasks.
    """

    claims: Annotated[tuple[OwnerClaim, ...], msgspec.Meta(max_length=IN_ONE_PACKET)]


def claims_of(records: Iterable[Record]) -> list[OwnerClaim]:
    """Returns what an agent with these records owns."""
    ours = (Phase.OWNER, Phase.FROZEN)
    return [OwnerClaim(record.task_id, record.epoch) for record in records if record.phase in ours]


def in_packets(claims: list[OwnerClaim]) -> Iterator[Owned]:
    """Yields the bodies of the packets that tell of claims."""
    for first in range(0, len(claims), IN_ONE_PACKET):
        yield Owned(tuple(claims[first : first + IN_ONE_PACKET]))


class Claims:
    """What other agents claim: of each, its highest claim on each task.

    A claim does not grow false: an agent that owns the task later owns it under a higher epoch.
    """

    def __init__(self) -> None:
        self._of: dict[str, dict[TaskId, OwnerClaim]] = {}  # by the agent, the one heard last at the end

    def heard(self, peer: str, claim: OwnerClaim) -> None:
        """Learns of a claim."""
        theirs = self._of[peer] = self._of.pop(peer, {})
        known = theirs.get(claim.task_id)
        if known is None or known.epoch <= claim.epoch:
            theirs[claim.task_id] = claim
        if len(theirs) > MOST:
            del theirs[next(iter(theirs))]
        if len(self._of) > MOST_AGENTS:
            del self._of[next(iter(self._of))]

    def of(self, task_id: TaskId) -> tuple[str, OwnerClaim] | None:
        """Returns the highest claim on a task, of equal ones the latest, and the agent that made it; None: none."""
        found = [(peer, theirs[task_id]) for peer, theirs in self._of.items() if task_id in theirs]
        return max(reversed(found), key=lambda it: it[1].epoch, default=None)

    def by_peer(self) -> dict[str, dict[TaskId, OwnerClaim]]:
        """Returns the highest claim on each task, by the agent that made it."""
        found: dict[str, dict[TaskId, OwnerClaim]] = {}
        for task_id in {task_id: None for theirs in self._of.values() for task_id in theirs}:
            if (highest := self.of(task_id)) is not None:
                found.setdefault(highest[0], {})[task_id] = highest[1]
        return found


MOST_JOURNALS: Final = 4
"""Of so many journals of one agent the boots are remembered, the newest: a disk that was replaced may come back."""


class Boot(NamedTuple):
    """One life of an agent.

    Attributes:
        journal: the id of its journal.
        number: how often that was opened.
        life: drawn anew at each opening.
    """

    journal: str
    number: int
    life: str

    def is_before(self, other: Boot) -> bool:
        """Returns whether a disk that is at this boot lacks what happened in the other one."""
        if self.journal != other.journal:
            return False
        return self.number < other.number or (self.number == other.number and self.life != other.life)


class BootsSeen(msgspec.Struct, frozen=True):
    """What an agent remembers of another one.

    Attributes:
        boots: its latest boot with each journal, the journal that was met last at the end.
    """

    boots: tuple[Boot, ...] = ()

    def after(self, boot: Boot) -> Boot | None:
        """Returns what is remembered and cannot be: that boot has a disk without it. None: there is nothing."""
        return next((known for known in self.boots if boot.is_before(known)), None)

    def with_(self, boot: Boot) -> BootsSeen:
        """Returns what is remembered once that boot was met; of a copy nothing is."""
        if boot in self.boots or self.after(boot) is not None:
            return self
        others = tuple(known for known in self.boots if known.journal != boot.journal)
        return BootsSeen((*others, boot)[-MOST_JOURNALS:])


@packet_type("task.boot")
class BootRemembered(msgspec.Struct, frozen=True):
    """Tells the census of an agent that its disk is an old copy, as the sender remembers a later boot of its journal.

    Attributes:
        journal: the id of that journal.
        number: the latest boot that the sender remembers.
        life: what was drawn at it.
    """

    journal: Annotated[str, msgspec.Meta(max_length=64)]
    number: int
    life: Annotated[str, msgspec.Meta(max_length=64)]

    @property
    def boot(self) -> Boot:
        """The boot that the sender remembers."""
        return Boot(self.journal, self.number, self.life)


@packet_type("task.where")
class WhereIs(msgspec.Struct, frozen=True):
    """Asks an agent's courier which agent has a task. Answered by `TaskAt`.

    Attributes:
        task_id: the task, as `birthplace/name`.
    """

    task_id: str


@packet_type("task.at")
class TaskAt(msgspec.Struct, frozen=True):
    """Says which agent has a task, as far as is known here.

    Attributes:
        task_id: the task.
        peer: the agent that has it, which may be the one that says so; empty: that is not known here.
        epoch: the highest epoch that is known of it; where it is here, the one that it runs under.
        acts: if it is here and guarded: whether its guardians let it act now. Else they may have another agent run it.
    """

    task_id: str
    peer: str = ""
    epoch: Epoch = NO_EPOCH
    acts: bool = True


def whereabouts(me: str, task_id: str, record: Record | None) -> TaskAt:
    """Returns what an agent says of a task of which it has this record; None: it has none."""
    if record is None:
        return TaskAt(task_id)
    match record.phase:
        case Phase.OWNER | Phase.FROZEN:
            return TaskAt(task_id, me, record.epoch)
        case Phase.COMMITTED:
            return TaskAt(task_id, record.peer, record.offer)
        case Phase.RELEASED:
            return TaskAt(task_id, record.peer, record.seen)
        case _:  # any agent may offer a task, and only one that gave it away knows to which other
            return TaskAt(task_id)


DEFAULT_WAIT_S: Final = 10.0
"""So long the birth of a task waits for agents that have not said what they know of it, in host seconds."""


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
    known: Sequence[TaskFact] = ()
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
    fact: TaskFact | None = None


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
    """It stands still until all that say so have told what they know of it."""
    ELSEWHERE = "elsewhere"
    """It went on after the copy was made: it stands still until a person decides."""


class CopiedTask(msgspec.Struct, frozen=True):
    """What becomes of a task, and why.

    Attributes:
        verdict: what becomes of it.
        missing: the agents that have still to tell what they know of it.
        fact: what tells of a later owner; None: nothing does.
    """

    verdict: CopyVerdict
    missing: tuple[str, ...] = ()
    fact: TaskFact | None = None


def copied_task(epoch: Epoch, sayers: Collection[str], told: Collection[str], known: Sequence[TaskFact]) -> CopiedTask:
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
