"""The records of an agent's tasks, as its services see them: read at the start, written without waiting."""

from __future__ import annotations

import threading
from functools import partial

import msgspec
from msgspec.structs import replace

from pancakes.errors import MigrationError
from pancakes.mesh.migration.epoch import NO_EPOCH, Epoch
from pancakes.mesh.migration.record import Record, TaskId
from pancakes.runtime.hosting.lost import Lost
from pancakes.runtime.journal import Disk, JournalEntry, May, RecordTable
from pancakes.runtime.kernel.reference import Reference
from pancakes.runtime.kernel.tell import tell

KIND = "record"


class RecordWritten(msgspec.Struct, frozen=True):
    """The records tell a service that one is on disk for good, or could not be written.

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
    """

    def __init__(self, disk: Disk) -> None:
        self._copy = disk.journal.copy
        self._lost: dict[TaskId, Lost] = {}
        self._claims: dict[TaskId, str] = {}
        for aside in disk.journal.missing:
            if aside.kind == KIND:
                self._lose(aside.key, str(aside), _read(aside.entry), aside.times)
        self._lock = threading.Lock()
        self._by_name: dict[str, tuple[TaskId, ...]] = {}
        self._records = RecordTable(
            disk,
            KIND,
            Record.decode,
            lambda key, why: self._lose(key, f"the journal has it, and it is not used: {why}"),
        )
        for record in self._records.on_disk.values():
            self._note_name(record.task_id)

    def _note_name(self, task_id: TaskId) -> None:
        with self._lock:
            known = self._by_name.get(task_id.name, ())
            if task_id not in known:
                self._by_name[task_id.name] = (*known, task_id)

    def _lose(self, key: str, why: str, read: Record | None = None, times: int = 1) -> None:
        try:
            task_id = TaskId.parse(key)
        except MigrationError:
            return  # no task was ever called so
        self._lost[task_id] = Lost(task_id, f"what this agent knew of it is lost: {why}", read, times)

    def all(self) -> dict[TaskId, Record]:
        """Returns the records as they are on disk."""
        return {record.task_id: record for record in list(self._records.on_disk.values())}

    def get(self, task_id: TaskId) -> Record | None:
        """Returns the record of a task as it is on disk; None: there is none."""
        return self._records.on_disk.get(str(task_id))

    def original_epoch(self, task_id: TaskId) -> Epoch:
        """Returns the epoch of a task that began before this disk was copied; `NO_EPOCH`: it has begun since."""
        record = self._records.on_disk.get(str(task_id))
        return record.epoch if record is not None and record.copy != self._copy else NO_EPOCH

    def service_of(self, task_id: TaskId) -> str:
        """Returns the name of the service whose record of a task is on disk; empty: there is none, or it says none."""
        record = self._records.on_disk.get(str(task_id))
        return record.service if record is not None else ""

    def here(self, name: str) -> TaskId | None:
        """Returns the task of a name that is here, as the disk says; None: no record says that of any."""
        with self._lock:
            task_ids = self._by_name.get(name, ())
        records = (self._records.on_disk.get(str(task_id)) for task_id in task_ids)
        return next((record.task_id for record in records if record is not None and record.here), None)

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
        with self._lock:
            task_ids = self._by_name.get(name, ())
        records = [self._records.on_disk.get(str(task_id)) for task_id in task_ids]
        services = {record.service for record in records if record is not None and record.in_doubt}
        return services | {self.decider_of(lost) for lost in self.all_lost() if lost.task_id.name == name}

    def trouble(self, task_id: TaskId) -> str:
        """Says what keeps a task's record from being written; empty: nothing that is known of."""
        return self._records.trouble(str(task_id))

    def persist(self, record: Record, service: Reference, may: May | None = None) -> None:
        """Writes a record, and tells the service that keeps it `RecordWritten`.

        Args:
            record: the record.
            service: the service.
            may: says, in the store's thread, whether it may be written once its turn has come; None: it may.
        """
        task_id = record.task_id
        self._note_name(task_id)

        def failed(why_not: str) -> None:
            tell(service, RecordWritten(task_id, why_not))

        written = partial(tell, service, RecordWritten(task_id))
        known = self._records.newest.get(str(task_id))
        copy = known.copy if known is not None and known.epoch == record.epoch else self._copy
        self._records.write(str(task_id), replace(record, service=service.name, copy=copy), written, failed, may)


def _read(entry: JournalEntry | None) -> Record | None:
    if entry is None:
        return None
    try:
        return Record.decode(entry.data)
    except MigrationError:
        return None
