"""What an agent has on disk for one task: its register, and what the agent must know besides. Pure.

`Record` is the entry in the journal. `Lost` is a record that cannot be believed. `rest_of` says in a word why a task
does not run here. The register itself, and the rules by which it changes, are in `register` and `rules`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Annotated, Final, NamedTuple

import msgspec

from pancakes.durable.register import (
    BLANK,
    MORE_THAN_MIGRATIONS,
    NO_EPOCH,
    NOBODY,
    AgentName,
    Epoch,
    Identity,
    Register,
    Standing,
    Wanted,
    members_in,
    standing_of,
)
from pancakes.errors import MigrationError
from pancakes.util import codecs
from pancakes.util.codecs import MALFORMED, why_malformed
from pancakes.util.text import NAME

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
        """Return what `str` wrote.

        Raises:
            MigrationError: the text is not of the form `birthplace/name`.
        """
        birthplace, slash, name = text.partition("/")
        if not (birthplace and slash and name) or "/" in name:
            raise MigrationError(f"{text!r} is no task id: it must read birthplace/name")
        return cls(birthplace, name)


class Record(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What an agent has on disk for one task.

    Attributes:
        task_id: the task.
        register: the register; its state is an encoded `Snapshot`.
        me: the agent as it was when it wrote this. If it has another identity now, its disk is a copy, or was replaced.
        service: the service that looks after the task; empty: none does here, as the agent only guards it.
        type: entry point name of its class.
        lease_s: how long a lease on it is, in host seconds.
        sequel: what to do here once the task has gone, an encoded `Sequel`; empty: nothing, or nothing more.
        gave: the agent to which this one gave the task last; empty: none. Unlike the register, no other agent's word
            changes it.
    """

    task_id: TaskId
    register: Register = BLANK
    me: Identity = NOBODY
    service: str = ""
    type: str = ""
    lease_s: float = 5.0
    sequel: bytes = b""
    gave: AgentName = ""

    @property
    def standing(self) -> Standing:
        """Where the agent stands with the task."""
        return standing_of(self.me, self.register)

    @property
    def epoch(self) -> Epoch:
        """The epoch under which the register was written."""
        return self.register.epoch

    @property
    def seen(self) -> Epoch:
        """The highest epoch that is known here."""
        return max(self.register.epoch, self.register.promised)

    @property
    def snapshot(self) -> bytes:
        """The newest checkpoint, encoded; empty: none is here."""
        return self.register.state or b""

    @property
    def wanted(self) -> Wanted:
        """What is wanted of the task."""
        return self.register.wanted

    @property
    def unborn(self) -> bool:
        """Whether this agent has never heard of the task."""
        return self.register.epoch == NO_EPOCH

    @property
    def removed(self) -> bool:
        """Whether the task was removed, and is nowhere as far as this agent knows."""
        return self.register.wanted is Wanted.REMOVED

    @property
    def may_begin(self) -> bool:
        """Whether the task may begin here: this agent has never heard of it, or it was removed."""
        return self.unborn or self.removed

    @property
    def owned(self) -> bool:
        """Whether this agent owns the task, and has promised it to nobody."""
        return self.standing in (Standing.OWNER, Standing.OFFERED, Standing.DISPUTED)

    @property
    def disputed(self) -> bool:
        """Whether the task is paused here because another agent owns it too; a copy of the disk keeps that."""
        is_copy = self.was_ours and self.wanted is Wanted.DISPUTED and not self.gave
        return is_copy or self.standing is Standing.DISPUTED

    @property
    def here(self) -> bool:
        """Whether the task is here, or on its way here or from here."""
        return self.owned or self.in_doubt

    @property
    def in_doubt(self) -> bool:
        """Whether this agent cannot know by itself whether the task is its own."""
        return self.standing in (Standing.YIELDED, Standing.HEIR)

    @property
    def under_way(self) -> bool:
        """Whether a migration of the task is under way, from here or to here."""
        return self.standing in (Standing.OFFERED, Standing.YIELDED, Standing.HEIR)

    @property
    def guarded(self) -> bool:
        """Whether other agents decide with its owner which one may run the task."""
        return bool(self.register.sets) and not self.register.unguarded

    @property
    def members(self) -> list[Identity]:
        """All members, each once, in the order in which they were chosen."""
        return members_in(self.register.sets)

    @property
    def peer(self) -> str:
        """The other agent: to which it was offered or given, from which it comes, or which has it; empty: none."""
        match self.standing:
            case Standing.OFFERED:
                return self.register.heir.agent
            case Standing.YIELDED:
                return self.register.promised.minter.agent
            case Standing.HEIR | Standing.RELEASED | Standing.MEMBER if not self.removed:
                owner = self.register.owner.agent
                return owner if owner != self.me.agent else self.gave
            case _:
                return ""

    @property
    def was_ours(self) -> bool:
        """Whether a former self of this agent owned the task, whose disk was replaced by a copy."""
        return self.register.owner != self.me and self.register.owner.agent == self.me.agent

    @property
    def goes_on(self) -> bool:
        """Whether the task continues here under a new epoch, on a copy of the disk of a former self."""
        return self.was_ours and not self.guarded and not self.gave and not self.disputed

    def encode(self) -> bytes:
        """Return the record as msgpack bytes, for the journal."""
        return codecs.encode(self)

    @classmethod
    def decode(cls, data: bytes) -> Record:
        """Return what `encode` wrote.

        Raises:
            MigrationError: the bytes are no record.
        """
        try:
            return _DECODE(data)
        except MALFORMED as error:
            raise MigrationError(f"these {len(data)} bytes are no record of a task: {why_malformed(error)}") from None


_DECODE: Callable[[bytes], Record] = codecs.decoder(Record)


WAS: Final = {
    Standing.NONE: "was not here",
    Standing.OWNER: "was here",
    Standing.DISPUTED: "was here, and on another agent too",
    Standing.OFFERED: "was here, and about to go to {peer}",
    Standing.YIELDED: "was given to {peer}",
    Standing.HEIR: "was on its way here from {peer}",
    Standing.MEMBER: "was with {peer}, and guarded here",
    Standing.RELEASED: "was with {peer}",
}
"""What the standing of a record says of the past, for people."""


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
        """By how much the epoch is higher under which the task is taken up again."""
        return self.times * MORE_THAN_MIGRATIONS

    @property
    def snapshot(self) -> bytes:
        """What the task can go on from, encoded; empty: nothing."""
        return self.read.snapshot if self.read is not None else b""

    def story(self) -> str:
        """Return what has happened, as a clause."""
        if self.read is None:
            return self.why
        was = "was removed" if self.read.removed else WAS[self.read.standing].format(peer=self.read.peer)
        return f"{self.why}; as far as it can be read, the task {was}"

    def undecided(self, me: str) -> str:
        """Return why the task is not started, and what a person can do."""
        name = f"{me}/{self.task_id.name}"
        return (
            f"it may run elsewhere, and {self.story()}. It stays at rest until you decide: where `pancakes task list`"
            f" shows it on no agent, and none that may have it is off or cut off, `pancakes task recover {name} --here`"
            f" runs it here; if it runs elsewhere, `pancakes task recover {name} --not-here` leaves it there"
        )


WAITS: Final = "waits → "
"""Why a task is not born yet: it waits for what the agents named after this know of it."""
DISK_LOST: Final = "disk lost"
"""Why a task is not born: other agents know of it, so it was born before, and the disk of its birthplace was lost."""
MOVED: Final = "moved → "
"""Why a task does not run here: it was given to the agent named after this."""
OLD_COPY: Final = "old copy"
"""Why a task is paused: the disk of its agent is an old copy, and it may be elsewhere by now."""


def rest_of(record: Record, otherwise: str = "") -> str:
    """Return in a word why a task does not run here; `otherwise` if its record does not speak against it."""
    if record.removed or record.unborn:
        return otherwise
    standing = record.standing
    if record.was_ours and record.guarded:
        return OLD_COPY
    if record.disputed:
        return record.wanted.value
    if record.goes_on:
        return otherwise if record.wanted is Wanted.RUNNING else record.wanted.value
    if standing in (Standing.YIELDED, Standing.RELEASED, Standing.MEMBER):
        return f"{MOVED}{record.peer}" if record.peer else otherwise or "forgotten"
    if standing in (Standing.OWNER, Standing.DISPUTED) and record.wanted is not Wanted.RUNNING:
        return record.wanted.value
    return otherwise


def why_not_here(record: Record) -> str:
    """Return why this agent can neither start nor stop the task, as a sentence."""
    task_id, peer = record.task_id, record.peer
    if record.removed:
        return f"{task_id} was removed"
    if record.disputed:
        return dispute_of(record)
    match record.standing:
        case Standing.OFFERED:
            return f"{task_id} is being handed over to {peer}"
        case Standing.YIELDED:
            return f"{task_id} was given to {peer}, which has not yet said that it has it"
        case Standing.HEIR:
            return f"{task_id} is on its way here from {peer}, which has not yet given it away"
        case Standing.OWNER:
            return f"{task_id} is here already"
        case _:
            if peer:
                return f"{task_id} moved to {peer}"
            recover = f"`pancakes task recover {record.me}/{task_id.name}`"
            return f"{task_id} is not here: it was forgotten; {recover} has it run here all the same"


def dispute_of(record: Record) -> str:
    """Return why a disputed task is paused, and what a person can do, as a sentence."""
    return (
        f"{record.task_id} is owned by another agent too: it is paused on {record.me} (epoch {record.epoch}) until you"
        f" decide with `pancakes task recover AGENT/{record.task_id.name}` which of the two lives"
    )


def resting(agent: str, tasks: Iterable[str], records: Mapping[TaskId, Record]) -> dict[str, str]:
    """Return which of an agent's tasks will not start because of their records, and why in a word.

    Args:
        agent: the agent's name.
        tasks: the names of the tasks that its configuration starts.
        records: its records as they are on disk, before anything starts.
    """
    here = {task_id.name: record for task_id, record in records.items() if record.here}
    known = {name: here.get(name) or records.get(TaskId(agent, name)) for name in tasks}
    words = {name: rest_of(record) for name, record in known.items() if record is not None}
    return {name: word for name, word in words.items() if word}
