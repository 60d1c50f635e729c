"""Epochs, guardian sets, and the durable record of one task on one agent. Pure.

Each agent keeps one record for each task that it ever had to do with. After a crash only the record decides whether
the task may run here. A record is replaced as a whole, never changed in place. An epoch says who owns a task: each
migration and each take-over raises it, and it is the fencing token of commands to actuators. `Volatile` is the part
of a migration that a crash may forget. `Lost` describes a task whose record cannot be read. `rest_of` says why a task
is not running.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping
from enum import Enum
from itertools import chain
from typing import Annotated, Final, NamedTuple

import msgspec

from pancakes.errors import MigrationError
from pancakes.util import codecs
from pancakes.util.codecs import MALFORMED, why_malformed
from pancakes.util.text import NAME

AgentName = Annotated[str, msgspec.Meta(max_length=64)]
HIGHEST: Final = 2**62
"""No peer may tell of a higher number: what is minted after it must still travel."""


class Epoch(NamedTuple):
    """How often a task was handed over, and which agent minted that number; ordered in this order.

    The next epoch offered is the hand-off's id and the fencing token in one.

    Attributes:
        n: the number; 0 at the task's birth.
        minter: the agent that owned the task when it was minted.
    """

    n: Annotated[int, msgspec.Meta(ge=0, le=HIGHEST)]
    minter: AgentName

    def __str__(self) -> str:
        return f"{self.n}@{self.minter}" if self.minter else "none"


NO_EPOCH: Final = Epoch(0, "")
"""Lower than every epoch that was ever minted."""
MOST_STEP: Final = 10_000_000
"""An epoch may be so much higher than the one before. An adoption of a task whose record was lost takes a step of a
million for each time that it was lost.
"""
MORE_THAN_MOVES: Final = 1_000_000
"""By so much a person's decision raises the epoch of a task that was lost: by more than it can have moved. So no agent
takes the news of it for older than what it knew, and an owner can tell it from a move.
"""


def is_out_of_reach(epoch: Epoch, known: Epoch) -> bool:
    """Returns whether no task comes so far at once: from the highest epoch that is known of it to another one."""
    return epoch.n > known.n + MOST_STEP


MOST_GUARDIANS: Final = 5
"""So many guardians a set has at most: more are slower, and survive nothing that is likely."""


class GuardianId(NamedTuple):
    """A guardian. An agent whose disk was lost, or is a copy, has forgotten pledges, and so is another guardian.

    Attributes:
        agent: the agent's name.
        journal: the id of its journal.
        copy: which copy of that journal it has; empty: the original.
    """

    agent: AgentName
    journal: Annotated[str, msgspec.Meta(max_length=64)]
    copy: Annotated[str, msgspec.Meta(max_length=64)] = ""


GuardianSet = Annotated[tuple[GuardianId, ...], msgspec.Meta(min_length=1, max_length=MOST_GUARDIANS)]


class Guards(msgspec.Struct, frozen=True):
    """The guardians of a task, as its owner has chosen them.

    Attributes:
        epoch: the epoch of the owner that wrote this.
        version: how often that owner has changed them.
        sets: one set of guardians; two, while the second takes over from the first; none: the task is not guarded.
    """

    epoch: Epoch = NO_EPOCH
    version: Annotated[int, msgspec.Meta(ge=0)] = 0
    sets: Annotated[tuple[GuardianSet, ...], msgspec.Meta(max_length=2)] = ()

    def has_quorum(self, members: Collection[GuardianId]) -> bool:
        """Returns whether these are more than half of each set."""
        return bool(self.sets) and all(2 * sum(it in members for it in one) > len(one) for one in self.sets)

    @property
    def forgotten(self) -> bool:
        """Whether these are no guardians any more, as the task was removed."""
        return not self.sets and self.epoch != NO_EPOCH

    def members(self) -> list[GuardianId]:
        """Returns all guardians, each once."""
        return list(dict.fromkeys(chain.from_iterable(self.sets)))

    @property
    def stamp(self) -> tuple[Epoch, int]:
        """Orders the guards of one task: the later is the newer, and those of a later owner always are."""
        return self.epoch, self.version


NO_GUARDS: Final = Guards()
LAST_VERSION: Final = 2**53
"""Of the guards of a task that was removed: an owner changes them less often under one epoch."""


def forgotten_guards(epoch: Epoch) -> Guards:
    """Returns what its guardians are told of a task that was removed; `epoch`: of its last owner."""
    return Guards(epoch, LAST_VERSION)


def newest(*guards: Guards) -> Guards:
    """Returns the newest of several."""
    return max(guards, key=lambda one: one.stamp)


_Name = Annotated[str, msgspec.Meta(pattern=rf"\A{NAME}\Z", max_length=64)]


class TaskId(NamedTuple):
    """A task's identity for life: the agent that it was born on, and its name there.

    It reads `birthplace/name`. Two agents may each have a `GoHome`.
    """

    birthplace: _Name
    name: _Name

    def __str__(self) -> str:
        return f"{self.birthplace}/{self.name}"

    @classmethod
    def parse(cls, text: str) -> TaskId:
        """Reads what `str` wrote.

        Raises:
            MigrationError: the text is not of the form `birthplace/name`.
        """
        birthplace, slash, name = text.partition("/")
        if not (birthplace and slash and name) or "/" in name:
            raise MigrationError(f"{text!r} is no task id: it must read birthplace/name")
        return cls(birthplace, name)


class Phase(Enum):
    """Where one agent stands with one task."""

    ABSENT = "absent"
    """Not here. It may have been offered once: `seen` says up to which epoch."""
    OWNER = "owner"
    """Ours, under `epoch`; the snapshot is the last checkpoint."""
    FROZEN = "frozen"
    """Still ours, stopped; the snapshot is what was offered to `peer` as `offer`."""
    COMMITTED = "committed"
    """Given away: the point of no return. The snapshot is kept until the new owner has it."""
    PREPARED = "prepared"
    """We hold a dormant snapshot from `peer`, which must not run."""
    RELEASED = "released"
    """A tombstone: handed over to `peer`, where packets are forwarded to. Never deleted."""


class Wanted(Enum):
    """What is wanted of a task by the people and tasks that command it; outlives a reboot."""

    RUNNING = "running"
    STOPPED = "stopped"
    FAILED = "failed"
    """Its service gave up on it."""
    DISPUTED = "disputed"
    """`peer` owns it too: it rests until a person decides which of the two lives."""
    REMOVED = "removed"
    """Of a tombstone: it was removed, and is nowhere."""


class Record(msgspec.Struct, frozen=True):
    """The durable record of one task on one agent.

    Attributes:
        task_id: whose record it is.
        phase: where this agent stands with it.
        epoch: the epoch that it runs, or last ran, under here.
        seen: the highest epoch ever seen here; never goes down.
        offer: in FROZEN, COMMITTED and PREPARED, the epoch of the hand-off under way.
        peer: the other side of that hand-off; afterwards, where packets for the task are forwarded to. Of a disputed
            task, the other owner.
        wanted: what the people and tasks that command it want of it.
        incarnation: how often it was started here under `epoch`; a checkpoint of an earlier one is not taken.
        snapshot: an encoded `Snapshot`; empty where this agent holds none.
        sequel: what is to be done here once the task has gone, an encoded `Sequel`; empty: nothing, or nothing more.
        guards: the guardians of a guarded task that this agent owns.
        no: of a guarded task: the how-manieth checkpoint under `epoch` the snapshot is, with what is wanted.
        service: the service that keeps the record; known on disk only, where a tombstone could not tell otherwise.
        copy: the copy of the journal in which `epoch` began here; empty: the original. Known on disk only.
    """

    task_id: TaskId
    phase: Phase = Phase.ABSENT
    epoch: Epoch = NO_EPOCH
    seen: Epoch = NO_EPOCH
    offer: Epoch = NO_EPOCH
    peer: str = ""
    wanted: Wanted = Wanted.RUNNING
    incarnation: int = 0
    snapshot: bytes = b""
    sequel: bytes = b""
    service: str = ""
    guards: Guards = NO_GUARDS
    no: int = 0
    copy: str = ""

    @property
    def unborn(self) -> bool:
        """Whether this agent has never heard of the task."""
        return self.phase is Phase.ABSENT and self.seen == NO_EPOCH

    @property
    def removed(self) -> bool:
        """Whether the task was removed here, and is nowhere as far as this agent knows."""
        return self.phase is Phase.RELEASED and self.wanted is Wanted.REMOVED

    @property
    def may_begin(self) -> bool:
        """Whether the task may begin here anew: this agent has never heard of it, or it was removed."""
        return self.unborn or self.removed

    @property
    def here(self) -> bool:
        """Whether the task is here, or on its way here."""
        return self.phase not in (Phase.ABSENT, Phase.RELEASED)

    @property
    def under_way(self) -> bool:
        """Whether a hand-off of the task is under way, from here or to here."""
        return self.phase in (Phase.FROZEN, Phase.COMMITTED, Phase.PREPARED)

    @property
    def in_doubt(self) -> bool:
        """Whether this agent cannot know by itself whether the task is its own."""
        return self.phase in (Phase.COMMITTED, Phase.PREPARED)

    @property
    def guarded(self) -> bool:
        """Whether its guardians decide which agent may run it."""
        return bool(self.guards.sets)

    def encode(self) -> bytes:
        """Returns the record as msgpack bytes, for the journal."""
        return codecs.encode(self)

    @classmethod
    def decode(cls, data: bytes) -> Record:
        """Reads what `encode` wrote.

        Raises:
            MigrationError: the bytes are no record.
        """
        try:
            return _DECODE(data)
        except MALFORMED as error:
            raise MigrationError(f"these {len(data)} bytes are no record of a task: {why_malformed(error)}") from None


_DECODE: Callable[[bytes], Record] = codecs.decoder(Record)


class Volatile(msgspec.Struct, frozen=True):
    """The part of a hand-off that a crash may forget.

    Attributes:
        running: the task's actor is at work here.
        asked: the neighbour that was asked for a reservation; empty where none is.
        freezing: the task is being stopped for that neighbour; its snapshot is to come.
        again: what was decided last, could not be written, and will be tried again; None: all that was decided is
            written, or being written.
        fresh: of a task that has not begun under its epoch: it goes on exactly where it stood still on its former host.
    """

    running: bool = False
    asked: str = ""
    freezing: bool = False
    again: Record | None = None
    fresh: bool = False


WAS: Final = {
    Phase.ABSENT: "was not here",
    Phase.OWNER: "was here",
    Phase.FROZEN: "was here, and about to be handed over to {peer}",
    Phase.COMMITTED: "was given to {peer}",
    Phase.PREPARED: "was on its way here from {peer}",
    Phase.RELEASED: "was handed over to {peer}",
}
"""What the phase of a record says of the past, for people."""


class Lost(msgspec.Struct, frozen=True):
    """A task of which an agent had a record that it cannot believe. The task may run elsewhere.

    Attributes:
        task_id: the task.
        why: what became of what this agent knew of it, as a clause.
        read: what can be read of it: it is whole, but of another journal; None: nothing.
        times: how often the agent has lost a record of this task.
        heard: the highest epoch that other agents know of.
    """

    task_id: TaskId
    why: str
    read: Record | None = None
    times: int = 1
    heard: Epoch = NO_EPOCH

    @property
    def seen(self) -> Epoch:
        """The highest epoch that is known of the task."""
        return max(self.read.seen, self.heard) if self.read is not None else self.heard

    @property
    def jump(self) -> int:
        """By how much the epoch is higher under which the task is adopted."""
        return self.times * MORE_THAN_MOVES

    @property
    def snapshot(self) -> bytes:
        """What the task can go on from, encoded; empty: nothing."""
        return self.read.snapshot if self.read is not None else b""

    def story(self) -> str:
        """Returns what has happened, as a clause."""
        if self.read is None:
            return self.why
        was = "was removed" if self.read.removed else WAS[self.read.phase].format(peer=self.read.peer)
        return f"{self.why}; as far as it can be read, the task {was}"

    def undecided(self, me: str) -> str:
        """Returns why the task is not started, and what a person can do who wants it to run on `me`."""
        name = f"{me}/{self.task_id.name}"
        return (
            f"it may run elsewhere, and {self.story()}. It stays at rest until you decide: where `pancakes task list`"
            f" shows it on no agent, and none that may have it is off or cut off, `pancakes task adopt {name} --force`"
            f" runs it here; where it runs elsewhere, `pancakes task forget {name}` leaves it there"
        )

    def meaning(self, me: str) -> str:
        """Returns what adopting the task on the agent `me` would mean, for a person who has not yet said `force`."""
        begins = "from what is in that record" if self.snapshot else "as its configuration says, its state is lost"
        return (
            f"of {self.task_id}, {self.story()}. Adopted by force, it runs on {me} ({begins}), under a new epoch. Where"
            f" it runs elsewhere, or rests on an agent that is off or cut off and comes back, there are two of it. So"
            f" first see with `pancakes task list`, while all agents are on, that it runs nowhere. Where it does run,"
            f" `pancakes task forget {me}/{self.task_id.name}` leaves it there. Nothing was done"
        )


WAITS: Final = "waits → "
"""Why a task is not born yet: it waits for what the agents named after this know of it."""
DISK_LOST: Final = "disk lost"
"""Why a task is not born: other agents know of it, so it was born before, and the disk of its birthplace was lost."""
OLD_COPY: Final = "old copy"
"""Why a task stands still: the disk of its agent is an old copy, and it may be elsewhere by now."""


def rest_of(record: Record, otherwise: str = "") -> str:
    """Returns in a word why a task does not run here; `otherwise` where its record does not speak against it."""
    if record.removed:
        return otherwise
    if record.phase in (Phase.COMMITTED, Phase.RELEASED):
        return f"moved → {record.peer}"
    if record.phase is Phase.ABSENT and record.seen != NO_EPOCH:
        return f"moved → {record.peer}" if record.peer else "forgotten"
    if record.phase is Phase.OWNER and record.wanted is not Wanted.RUNNING:
        return record.wanted.value
    return otherwise


def resting(agent: str, tasks: Iterable[str], records: Mapping[TaskId, Record]) -> dict[str, str]:
    """Returns which of an agent's tasks will not start because of their records, and why in a word.

    Args:
        agent: the agent's name.
        tasks: the names of the tasks that its configuration starts.
        records: its records as they are on disk, before anything starts.
    """
    here = {task_id.name: record for task_id, record in records.items() if record.here}
    known = {name: here.get(name) or records.get(TaskId(agent, name)) for name in tasks}
    words = {name: rest_of(record) for name, record in known.items() if record is not None}
    return {name: word for name, word in words.items() if word}
