"""One kind of record on disk: read at the start, looked up in memory, written without waiting."""

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
    """The journal of an agent, for the tables that are kept on it.

    Attributes:
        journal: each table reads its records from it when the table is made, before anything is written.
        store: writes to that journal.
        unread: the agent's list of what was found wrong at the start; each record that cannot be read adds a sentence.
    """

    journal: Journal
    store: RecordStore
    unread: list[str]


_T = TypeVar("_T")


class RecordTable(Generic[_T]):
    """All records of one kind, by key. Any thread; of one key, one thread at a time writes.

    Args:
        disk: what the records are kept on; read once, here.
        kind: the kind of their journal entries, in lower-case letters.
        decode: makes a record of the bytes that `codecs.encode` made of it; raises an error if it cannot.
        malformed: called, here, with the key of each record that cannot be read, and why.

    Attributes:
        on_disk: the records as they are on disk.
        newest: the records as they are on disk or about to be. Both change while other threads write: make a list of
            their values before a loop over it.
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

    def write(self, key: str, record: _T, then: Persisted, failed: Failed, may: May | None = None) -> None:
        """Begin to write a record in the place of the one of this key. Never waits.

        Args:
            key: the record's key.
            record: what to write.
            then: called, in the store's thread, when it is on disk for good.
            failed: called instead, with the reason, if it could not be written.
            may: says, in the store's thread, whether it may be written once its turn has come; None: it may.
        """
        self._newest[key] = record

        def written() -> None:
            self._on_disk[key] = record
            then()

        try:
            data = codecs.encode(record)
        except MemoryError as error:
            failed(str(error))
            return
        self._store.persist(JournalEntry(self._kind, key, data), written, failed, may)

    def trouble(self, key: str) -> str:
        """Say what keeps a record from being written; empty: nothing that is known of."""
        return self._store.trouble(self._kind, key)


def _of_another(version: str) -> str:
    """Return what else is to be said of a record that cannot be read."""
    if version == __version__:
        return ""
    written_by = f"Pancakes {version}" if version else "a version of Pancakes before 0.1.0"
    return f"; {written_by} has written it, and this is {__version__}"
