"""Writing to the journal without waiting for it: an entry goes in, a call comes back when it is on disk.

Each write is an fsync, and an actor may not wait. So the rim of a hand-off gives its records to a store and
goes on when it is told.
"""

from __future__ import annotations

import threading
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable
from typing import Any, NamedTuple

from pancakes.journal.entry import Entry, JournalError
from pancakes.journal.journal import Journal

Persisted = Callable[[], None]
"""Called when the entry is on disk for good."""
Failed = Callable[[str], None]
"""Called with the reason where it could not be written; the old entry may still be there, or the new one."""


class _Job(NamedTuple):
    entry: Entry
    persisted: Persisted
    failed: Failed


class RecordStore(ABC):
    """Something that makes entries durable, in the order in which they come."""

    @abstractmethod
    def persist(self, entry: Entry, persisted: Persisted, failed: Failed) -> None:
        """Begins to write an entry. Never waits; from any thread.

        Args:
            entry: what to write.
            persisted: called once when it is on disk, after those of all earlier entries.
            failed: called instead where it could not be written.
        """

    @abstractmethod
    def close(self) -> None:
        """Writes what waits, makes the calls that are due, and closes the journal. Waits for that."""


class ThreadedStore(RecordStore):
    """Writes to a journal in a thread of its own, with group commit.

    While one round of writing is under way others come in; they are written together in the next round, so
    that twenty tasks that checkpoint at once cost two rounds and not twenty. The callbacks are made in the
    store's thread, in order; they must not wait (an actor's callback puts a message in its own mailbox).
    An entry that comes after `close` fails.

    Args:
        journal: the journal, which is the store's from now on, and is closed with it: read its entries
            before. Its `uuid`, `boot` and `set_aside` never change.
        name: name of the thread.
    """

    def __init__(self, journal: Journal, name: str = "journal") -> None:
        self._journal = journal
        self._jobs: deque[_Job] = deque()
        self._news = threading.Condition()
        self._closing = False
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def persist(self, entry: Entry, persisted: Persisted, failed: Failed) -> None:
        with self._news:
            if not self._closing:
                self._jobs.append(_Job(entry, persisted, failed))
                self._news.notify()
                return
        failed("the journal is closed")

    def close(self) -> None:
        with self._news:
            self._closing = True
            self._news.notify()
        if threading.current_thread() is not self._thread:
            self._thread.join()

    def _run(self) -> None:
        while batch := self._next_batch():
            _write(self._journal, batch)
        self._journal.close()

    def _next_batch(self) -> list[_Job]:
        """Waits for jobs and returns all there are; none when the store closes."""
        with self._news:
            while not self._jobs and not self._closing:
                self._news.wait()
            batch = list(self._jobs)
            self._jobs.clear()
            return batch


class VirtualStore(RecordStore):
    """Writes to a journal in virtual time: without a thread, after a modelled delay.

    Args:
        journal: the journal, in memory as a rule; it is closed with the store.
        call_later: runs a function in so many seconds of host time, such as a transport's; equal delays
            in the order of the calls.
        latency_s: how long a write takes.
    """

    def __init__(
        self, journal: Journal, call_later: Callable[[float, Callable[[], None]], Any], latency_s: float = 0.002
    ) -> None:
        self._journal = journal
        self._call_later = call_later
        self._latency_s = latency_s
        self._jobs: deque[_Job] = deque()
        self._closed = False

    def persist(self, entry: Entry, persisted: Persisted, failed: Failed) -> None:
        if self._closed:
            failed("the journal is closed")
            return
        self._jobs.append(_Job(entry, persisted, failed))
        self._call_later(self._latency_s, self._write_oldest)

    def close(self) -> None:
        while self._jobs:
            self._write_oldest()
        self._closed = True
        self._journal.close()

    def crash(self) -> None:
        """Ends as a power cut does: what waits is never written, and nobody is told."""
        self._jobs.clear()
        self._closed = True
        self._journal.close()

    def _write_oldest(self) -> None:
        if self._jobs:
            _write(self._journal, [self._jobs.popleft()])


def _write(journal: Journal, batch: list[_Job]) -> None:
    try:
        journal.write([job.entry for job in batch])
    except JournalError as error:
        if len(batch) == 1:
            batch[0].failed(str(error))
            return
        # One entry at fault must not fail those that happened to wait with it.
        for job in batch:
            _write(journal, [job])
    else:
        for job in batch:
            job.persisted()
