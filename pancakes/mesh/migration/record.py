"""What an agent knows for good about one task: its durable record (PROTOCOL: migration, names).

Each agent keeps one record for each task that it ever had to do with. The record, and nothing else,
decides after a crash whether the task may run here. It is replaced as a whole, never changed in place.
"""

from __future__ import annotations

from collections.abc import Callable
from enum import Enum
from typing import Annotated, NamedTuple

import msgspec

from pancakes.errors import MigrationError
from pancakes.mesh.migration.epoch import NO_EPOCH, Epoch
from pancakes.mesh.migration.guards import NO_GUARDS, Guards
from pancakes.runtime.foundation import codecs
from pancakes.runtime.foundation.malformed import MALFORMED, why_malformed
from pancakes.runtime.foundation.names import NAME

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
