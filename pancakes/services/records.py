"""The records of an agent's tasks, as its services see them: read at the start, written without waiting."""

from __future__ import annotations

from collections.abc import Callable

from msgspec.structs import replace

from pancakes.errors import MigrationError
from pancakes.journal import Entry, Journal, RecordStore
from pancakes.migration.record import Record, TaskId

KIND = "record"


class Records:
    """All durable records of one agent. Any thread.

    Args:
        journal: read once, here.
        store: what writes to that journal.
        log: takes a level and a line about what could not be read.
    """

    def __init__(self, journal: Journal, store: RecordStore, log: Callable[[str, str], None]) -> None:
        self._store = store
        self._records: dict[TaskId, Record] = {}
        self._aside = {aside.key: str(aside) for aside in journal.set_aside if aside.kind == KIND}
        for entry in journal.entries(KIND):
            try:
                record = Record.decode(entry.data)
            except MigrationError as error:
                log("error", f"the journal's record of {entry.key} is not used: {error}")
                continue
            self._records[record.task_id] = record

    def all(self) -> dict[TaskId, Record]:
        """Returns the records as they are on disk."""
        return dict(self._records)

    def lost(self, task_id: TaskId) -> str:
        """Returns how a task's record was lost; empty where it was not.

        Such a task may run elsewhere, for all that this agent knows, so it must not be born here a second time.
        """
        return self._aside.get(str(task_id), "")

    def persist(self, record: Record, service: str, then: Callable[[], None], failed: Callable[[str], None]) -> None:
        """Writes a record.

        Args:
            record: what to write.
            service: the name of the service that keeps it.
            then: called, in the store's thread, when it is on disk for good.
            failed: called instead, with the reason, where it could not be written.
        """
        record = replace(record, service=service)

        def written() -> None:
            self._records[record.task_id] = record
            then()

        try:
            data = record.encode()
        except MemoryError as error:
            failed(str(error))
            return
        self._store.persist(Entry(KIND, str(record.task_id), data), written, failed)

    def close(self) -> None:
        """Writes what still waits, and closes the journal. Waits for the disk."""
        self._store.close()
