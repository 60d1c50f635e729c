"""One kind of record on disk: read at the start, looked up in memory, written in the background."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Generic, NamedTuple, TypeVar

from pancakes import __version__
from pancakes.errors import PancakesError
from pancakes.journal.journal import Journal, JournalEntry
from pancakes.journal.store import Failed, May, Persisted, RecordStore
from pancakes.util import codecs
from pancakes.util.codecs import MALFORMED, why_malformed


class Disk(NamedTuple):
    """The journal of an agent, for its record tables.

    Attributes:
        journal: each table reads its records from it when the table is made, before anything is written.
        store: writes to that journal.
        unread: the agent's list of faults at the start; each record that cannot be read adds a sentence.
    """

    journal: Journal
    store: RecordStore
    unread: list[str]


_T = TypeVar("_T")


class RecordTable(Generic[_T]):
    """All records of one kind, by key. Any thread, but only one thread at a time may write a key.

    Args:
        disk: where the records are stored; read once, here.
        kind: the kind of their journal entries, in lower-case letters.
        decode: decodes a record that `codecs.encode` encoded; raises an error if it cannot.
        malformed: called, here, with the key of each record that cannot be read, and the reason.

    Attributes:
        on_disk: the records as they are on disk.
        newest: the records as they are on disk or will soon be. Both change while other threads write: copy their
            values to a list before a loop.
    """

    on_disk: Mapping[str, _T]
    newest: Mapping[str, _T]

    def __init__(
        self, disk: Disk, kind: str, decode: Callable[[bytes], _T], malformed: Callable[[str, str], None]
    ) -> None:
        self._store = disk.store
        self._kind = kind
        self._on_disk: dict[str, _T] = {}
        self.on_disk = self._on_disk
        for entry in disk.journal.entries(kind):
            try:
                self._on_disk[entry.key] = decode(entry.data)
            except (PancakesError, *MALFORMED) as error:
                malformed(entry.key, why_malformed(error) + _of_another(disk.journal.written_by))
        self._newest = dict(self._on_disk)
        self.newest = self._newest

    def write(self, key: str, record: _T, persisted: Persisted, failed: Failed, may: May | None = None) -> None:
        """Begin to write a record, replacing the one with this key. Never waits.

        Args:
            key: the record's key.
            record: what to write.
            persisted: called, in the store's thread, when it is on disk.
            failed: called instead, with the reason, if it could not be written.
            may: returns, in the store's thread, why it may not be written when its turn has come; None: it may.
        """
        self._newest[key] = record

        def written() -> None:
            self._on_disk[key] = record
            persisted()

        try:
            data = codecs.encode(record)
        except MemoryError as error:
            failed(str(error))
            return
        self._store.persist(JournalEntry(self._kind, key, data), written, failed, may)

    def trouble(self, key: str) -> str:
        """Return why a record cannot be written now; empty: no known reason."""
        return self._store.trouble(self._kind, key)


def _of_another(version: str) -> str:
    """Return the end of the message for a record that cannot be read: which version wrote it."""
    if version == __version__:
        return ""
    written_by = f"Pancakes {version}" if version else "a version of Pancakes before 0.1.0"
    return f"; {written_by} has written it, and this is {__version__}"
