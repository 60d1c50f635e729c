"""What an agent keeps in its journal about tasks: their records, and accounts of migrations.

Everything is read once at the start, and written without waiting: the writer is told when its entry is on disk, or
why not. Any thread may read. A record that cannot be read is listed as lost, because forgetting one silently could
start a task twice.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, Final

import msgspec

from pancakes.durable.old_records import GUARD, OldRecords
from pancakes.durable.record import Lost, Record, TaskId
from pancakes.durable.register import Identity
from pancakes.errors import MigrationError
from pancakes.journal import Disk, JournalEntry, May, RecordTable
from pancakes.kernel.mailbox import Reference, tell
from pancakes.migration import MigrationReport
from pancakes.util import codecs
from pancakes.util.codecs import MALFORMED

RECORD = "record"


class RecordWritten(msgspec.Struct, frozen=True):
    """The records tell the registrar that one is on disk for good, or could not be written.

    Attributes:
        task_id: the task whose record it is.
        why_not: why it could not be written; empty: it is on disk.
    """

    task_id: TaskId
    why_not: str = ""


class Records:
    """All durable records of one agent. Any thread.

    Args:
        disk: what they are kept on.
        me: this agent as an owner and member of tasks.
        journals: the id of the journal that each other agent had last, by name; for records of earlier versions.
    """

    def __init__(self, disk: Disk, me: Identity, journals: Mapping[str, str]) -> None:
        old = OldRecords((it.data for it in disk.journal.entries(GUARD)), me, journals)

        def decode(data: bytes) -> Record:
            try:
                return msgspec.structs.replace(Record.decode(data), me=me)
            except MigrationError as error:
                try:
                    return old.record(data)
                except MALFORMED:
                    raise error from None

        self._lost: dict[TaskId, Lost] = {}
        self._claims: dict[TaskId, str] = {}
        for aside in disk.journal.missing:
            if aside.kind == RECORD:
                self._lose(aside.key, str(aside), _read(aside.entry), aside.times)
        self._records = RecordTable(
            disk,
            RECORD,
            decode,
            lambda key, why: self._lose(key, f"the journal has it, and it is not used: {why}"),
        )
        self._only_guarded = {
            str(it.task_id): it for it in old.guarded(it.task_id for it in self._records.on_disk.values())
        }

    def _lose(self, key: str, why: str, read: Record | None = None, times: int = 1) -> None:
        try:
            task_id = TaskId.parse(key)
        except MigrationError:
            return  # no task was ever called so
        self._lost[task_id] = Lost(task_id, f"what this agent knew of it is lost: {why}", read, times)

    def all(self) -> dict[TaskId, Record]:
        """Returns the records as they are on disk."""
        found = {record.task_id: record for record in list(self._records.on_disk.values())}
        others = {it.task_id: it for it in self._only_guarded.values() if it.task_id not in found}
        return {**others, **found}

    def get(self, task_id: TaskId) -> Record | None:
        """Returns the record of a task as it is on disk; None: there is none."""
        key = str(task_id)
        return self._records.on_disk.get(key) or self._only_guarded.get(key)

    def service_of(self, task_id: TaskId) -> str:
        """Returns the name of the service whose record of a task is on disk; empty: there is none, or it says none."""
        record = self._records.on_disk.get(str(task_id))
        return record.service if record is not None else ""

    def here(self, name: str) -> TaskId | None:
        """Returns the task of a name that is here, as the disk says; None: no record says that of any.

        What a former self of this agent owned, whose disk was replaced by a copy, is here too if no other task is.
        """
        named = self._named(name)
        found = [record for record in named if record.here] or [record for record in named if record.was_ours]
        return found[0].task_id if found else None

    def _named(self, name: str) -> list[Record]:
        return [record for record in list(self._records.on_disk.values()) if record.task_id.name == name]

    def lost(self, task_id: TaskId) -> Lost | None:
        """Returns what is known of a task whose record was lost; None: it was not, or has been decided about since.

        Such a task may run elsewhere, for all that this agent knows, so it must not be born here a second time. That
        holds over any number of starts, until its agent has a record of it again: because a person has decided, or
        because another agent has handed it over.
        """
        return None if str(task_id) in self._records.on_disk else self._lost.get(task_id)

    def all_lost(self) -> list[Lost]:
        """Returns all of them that are undecided."""
        return [lost for task_id, lost in self._lost.items() if str(task_id) not in self._records.on_disk]

    def claim(self, task_id: TaskId, service: str) -> None:
        """Learns which service has a place for a task from its start on: what is decided about it is decided there."""
        self._claims[task_id] = service

    def decider_of(self, lost: Lost) -> str:
        """Returns the service that decides about a task whose record was lost."""
        told = lost.read.service if lost.read is not None else ""
        return self._claims.get(lost.task_id) or told or "client"

    def services_in_doubt(self, name: str) -> set[str]:
        """Returns the services that have something to decide about a task of this name."""
        services = {record.service for record in self._named(name) if record.in_doubt}
        return services | {self.decider_of(lost) for lost in self.all_lost() if lost.task_id.name == name}

    def trouble(self, task_id: TaskId) -> str:
        """Says what keeps a task's record from being written; empty: nothing that is known of."""
        return self._records.trouble(str(task_id))

    def write(self, record: Record, writer: Reference, may: May | None = None) -> None:
        """Begin to write a record, and tell the writer `RecordWritten`. Never waits.

        Args:
            record: the record.
            writer: the actor that is told.
            may: says, in the store's thread, whether it may be written once its turn has come; None: it may.
        """
        task_id = record.task_id

        def failed(why_not: str) -> None:
            tell(writer, RecordWritten(task_id, why_not))

        self._records.write(str(task_id), record, partial(tell, writer, RecordWritten(task_id)), failed, may)


def _read(entry: JournalEntry | None) -> Record | None:
    if entry is None:
        return None
    try:
        return Record.decode(entry.data)
    except MigrationError:
        return None


LEDGER: Final = "ledger"
KEPT: Final = 100
"""How many are kept for each agent; the newest takes the place of the oldest."""


class Kept(msgspec.Struct, frozen=True):
    """One account, and when it was written down.

    Attributes:
        number: its place in the order of all moves from this agent, from 1.
        boot: in which life of the agent: mission time begins again with each.
        mission_s: the mission time at which the move was over.
        reason: why it came to nothing, or (moved all the same) what had come between; else empty.
        ledger: the account.
    """

    number: int
    boot: int
    mission_s: float
    reason: str
    ledger: MigrationReport


class MigrationReports:
    """The newest accounts of one agent. Any thread adds to them, and asks for them.

    The journal deletes nothing, so its entries go round: account 101 is written in the place of account 1.

    Args:
        disk: what they are kept on.
        log: takes a level and a line about what could not be written.
    """

    def __init__(self, disk: Disk, log: Callable[[str, str], None]) -> None:
        def malformed(key: str, why: str) -> None:
            disk.unread.append(f"the journal's account {key} of a move is not used: {why}")

        self._log = log
        self._boot = disk.journal.boot
        self._lock = threading.Lock()  # guards the number of the last one
        self._accounts = RecordTable(disk, LEDGER, codecs.decoder(Kept), malformed)
        self._last = max((kept.number for kept in self._accounts.newest.values()), default=0)

    def add(self, ledger: MigrationReport, reason: str, mission_s: float) -> None:
        """Keeps an account, and begins to write it down; that of a migration is kept once. Never waits.

        Args:
            ledger: the account.
            reason: why the move came to nothing, or what had come between; else empty.
            mission_s: mission time.
        """

        def failed(why: str) -> None:
            self._log("warning", f"the account of the move of {ledger.task_id} is not in the journal: {why}")

        if ledger.offer and any(
            (kept.ledger.task_id, kept.ledger.offer) == (ledger.task_id, ledger.offer) for kept in self._newest()
        ):
            # The agent was killed after it was written and before the task's record said so.
            return
        with self._lock:
            self._last = number = self._last + 1
        kept = Kept(number, self._boot, mission_s, reason, ledger)
        self._accounts.write(f"{number % KEPT:02d}", kept, lambda: None, failed)

    def _newest(self) -> list[Kept]:
        return sorted(self._accounts.newest.values(), key=lambda kept: kept.number)

    def plain(self) -> list[dict[str, Any]]:
        """Return the reports, oldest first, as plain values: the fields of `MigrationReport` and of `Kept`."""
        return [
            {
                "number": kept.number,
                "boot": kept.boot,
                "mission_s": kept.mission_s,
                "reason": kept.reason,
                **_plain(kept.ledger),
            }
            for kept in self._newest()
        ]


def _plain(ledger: MigrationReport) -> dict[str, Any]:
    plain = msgspec.to_builtins(ledger)
    # As another agent gets it over the wire, which knows no tuples.
    return {**plain, "lines": list(plain["lines"])}
