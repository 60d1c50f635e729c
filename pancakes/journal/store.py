"""Write to the journal without waiting: the store calls back once an entry is on disk.

Each write is an fsync, and an actor must not wait. `ThreadedStore` writes in a thread of its own, with group commit:
what comes in during one round is written together in the next. `VirtualStore` does the same in virtual time, after a
modelled delay. An entry that could not be written is retried with a back-off of at most 5 s, and others go before it.
"""

from __future__ import annotations

import math
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import Any, Final, NamedTuple

import msgspec

from pancakes.journal.journal import Journal, JournalEntry, JournalError, JournalLostError, MemoryJournal
from pancakes.util.clock import MonotonicClock

FIRST_PAUSE_S: Final = 0.1
LONGEST_PAUSE_S: Final = 5.0
SAID_EVERY_S: Final = 5.0
"""How often at most it is logged that the journal cannot write, in seconds."""

Key = tuple[str, str]
"""Kind and key of an entry."""


class Saying(NamedTuple):
    """A line for `log`."""

    level: str
    text: str


class _Trouble(msgspec.Struct):
    reason: str
    pause_s: float
    due_s: float


class Troubles:
    """Count failed writes, and decide when to retry. Pure; all times are in seconds of one clock."""

    def __init__(self) -> None:
        self._troubles: dict[Key, _Trouble] = {}
        self._failures = 0  # since the last successful write
        self._since_s = 0.0
        self._said = False  # whether the failure was logged
        self._said_s = -SAID_EVERY_S

    def due_s(self, key: Key) -> float:
        """Return when an entry may be written; 0 if it did not fail recently."""
        trouble = self._troubles.get(key)
        return trouble.due_s if trouble is not None else 0.0

    def reason(self, key: Key) -> str:
        """Return why the last attempt to write an entry failed; empty if it did not."""
        trouble = self._troubles.get(key)
        return trouble.reason if trouble is not None else ""

    def newest(self) -> str:
        """Return the newest reason why an entry could not be written; empty: all could."""
        return next((it.reason for it in reversed(list(self._troubles.values()))), "")

    def worked(self, key: Key) -> None:
        """Note that an entry is on disk."""
        self._troubles.pop(key, None)

    def failed(self, key: Key, reason: str, now_s: float) -> None:
        """Note that an entry could not be written. Each pause until the next attempt is twice the last."""
        trouble = self._troubles.get(key)
        pause_s = FIRST_PAUSE_S if trouble is None else min(2 * trouble.pause_s, LONGEST_PAUSE_S)
        self._troubles[key] = _Trouble(reason, pause_s, now_s + pause_s)
        if not self._failures:
            self._since_s = now_s
        self._failures += 1

    def saying(self, now_s: float) -> Saying | None:
        """Return the log line after a round of writing; None: none is needed."""
        # An entry that was not retried when it was due was given up by its caller.
        for key in [key for key, trouble in self._troubles.items() if trouble.due_s + LONGEST_PAUSE_S < now_s]:
            del self._troubles[key]
        if self._troubles:
            return self._cannot(now_s)
        if not self._said:
            return None  # failures too soon after the last line count for the next one
        text = f"the journal can write again ({_times(self._failures)} in {now_s - self._since_s:.1f} s failed)"
        self._failures, self._said = 0, False
        return Saying("info", text)

    def _cannot(self, now_s: float) -> Saying | None:
        if now_s < self._said_s + SAID_EVERY_S:
            return None
        first, self._said, self._said_s = not self._said, True, now_s
        reason = next(reversed(self._troubles.values())).reason
        if first and self._failures == 1:
            return Saying("error", f"{reason}: it is retried, first soon, then every {LONGEST_PAUSE_S:g} s")
        return Saying("error", f"{reason}: {_times(self._failures)} in {now_s - self._since_s:.1f} s failed")


def _times(failures: int) -> str:
    return f"{failures} {'try' if failures == 1 else 'tries'}"


Persisted = Callable[[], object]
"""Called when the entry is on disk."""
Failed = Callable[[str], None]
"""Called with the reason if it could not be written; the old entry may still be there, or the new one."""
May = Callable[[], str]
"""Returns why an entry may not be written now; empty: it may. Called right before the write."""
Say = Callable[[str, str], None]
"""Takes a level and a line for `log`."""

SLOW_S: Final = 1.0
"""After an entry has waited this long, in seconds, the disk counts as not answering."""


class _Job(msgspec.Struct, eq=False):
    entry: JournalEntry
    persisted: Persisted
    failed: Failed
    since_s: float
    may: May | None
    called: bool = False

    @property
    def key(self) -> Key:
        return self.entry.kind, self.entry.key

    def call(self, reason: str) -> None:
        """Call the callback that is due, once; an empty reason means that the entry is on disk."""
        if self.called:
            return
        self.called = True
        if reason:
            self.failed(reason)
        else:
            self.persisted()


class RecordStore(ABC):
    """Write entries to a journal in the order in which they come.

    If an entry could not be written and comes again soon, it waits up to 5 s, and others go before it. So a caller that
    retries at once neither keeps the machine busy nor fills its log.

    Args:
        journal: the journal, which the store owns from now on and closes.
        now: the clock, in seconds.
        say: logs that the journal cannot write: once, then every 5 s at most, and once when it can again.
    """

    def __init__(self, journal: Journal, now: Callable[[], float], say: Say) -> None:
        self._journal = journal
        self._now = now
        self._say = say
        self._troubles = Troubles()

    @abstractmethod
    def persist(self, entry: JournalEntry, persisted: Persisted, failed: Failed, may: May | None = None) -> None:
        """Begin to write an entry. Never waits; from any thread.

        Args:
            entry: what to write.
            persisted: called once when it is on disk, after the callbacks of earlier entries of its kind and key.
            failed: called instead if it could not be written.
            may: returns why it may not be written when its turn has come; None: it may.
        """

    @abstractmethod
    def trouble(self, kind: str, key: str) -> str:
        """Return why an entry cannot be written now; empty: no known reason. From any thread."""

    def fault(self) -> str:
        """Return why the journal cannot write now; empty: no known reason. From any thread."""
        return self._troubles.newest()

    @abstractmethod
    def close(self) -> None:
        """Write what waits, call the callbacks that are due, and close the journal. Waits for that."""

    def _write(self, batch: Sequence[_Job]) -> None:
        """Write a batch, and call its callbacks. One bad entry does not fail the others in the batch.

        Raises:
            JournalLostError: nothing can be written any more; the callbacks of the rest are not called yet.
        """
        refused = [(job, why_not) for job in batch if job.may is not None and (why_not := job.may())]
        for job, why_not in refused:
            job.call(why_not)
        if refused:
            batch = [job for job in batch if not job.called]
        if not batch:
            return
        try:
            self._journal.write([job.entry for job in batch])
        except JournalLostError:
            raise
        except JournalError as error:
            if len(batch) > 1:
                for job in batch:
                    self._write([job])
                return
            self._troubles.failed(batch[0].key, str(error), self._now())
            batch[0].call(str(error))
        else:
            for job in batch:
                self._troubles.worked(job.key)
                job.call("")

    def _report(self) -> None:
        saying = self._troubles.saying(self._now())
        if saying is not None:
            self._say(*saying)


class ThreadedStore(RecordStore):
    """Write to a journal in a thread of its own, with group commit.

    While one round of writing is in progress, others come in. They are written together in the next round, so twenty
    tasks that checkpoint at once cost two rounds and not twenty. Callbacks run in the store's thread, in order. They
    must not wait (an actor's callback puts a message in its own mailbox). An entry that comes after `close` fails.

    The same thread, which may wait for a disk, checks that the journal is still the one that was opened. If it is not,
    nothing is written any more, and all waiting entries fail.

    Args:
        journal: the journal, which the store owns from now on and closes: read its entries before. The values that it
            read at its opening never change.
        name: name of the thread.
        now: the clock, in seconds.
        say: called in the store's thread when the journal cannot write; see `RecordStore`.
        lost: called once, in the store's thread, with the reason, if the journal is no longer the one that was opened.
        defer: runs a function at the end of the calling actor's turn, or at once outside of a turn: all entries of one
            turn go in one round.
    """

    def __init__(
        self,
        journal: Journal,
        name: str = "journal",
        now: Callable[[], float] = MonotonicClock.now,
        say: Say = lambda level, text: None,
        lost: Callable[[str], None] = lambda reason: None,
        defer: Callable[[Callable[[], None]], None] = lambda function: function(),
    ) -> None:
        super().__init__(journal, now, say)
        self._defer = defer
        self._lost = lost
        self._gone = ""  # why nothing can be written any more
        self._jobs: list[_Job] = []
        self._at_work: list[_Job] = []
        self._news = threading.Condition()
        self._closing = False
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def persist(self, entry: JournalEntry, persisted: Persisted, failed: Failed, may: May | None = None) -> None:
        with self._news:
            if not self._closing and not self._gone:
                self._jobs.append(_Job(entry, persisted, failed, self._now(), may))
                reason = ""
            else:
                reason = self._gone or "the journal is closed"
        if reason:
            failed(reason)
        else:
            self._defer(self._wake)

    def fault(self) -> str:
        with self._news:
            if self._gone:
                return self._gone
            since_s = min((job.since_s for job in self._at_work), default=None)
            newest = super().fault()
        waits_s = self._now() - since_s if since_s is not None else 0.0
        return newest or (self._waits(waits_s) if waits_s >= SLOW_S else "")

    def _waits(self, waits_s: float) -> str:
        return f"the journal has been waiting for the disk for {waits_s:.0f} s ({self._journal.place})"

    def _wake(self) -> None:
        with self._news:
            self._news.notify()

    def trouble(self, kind: str, key: str) -> str:
        with self._news:
            if self._gone:
                return self._gone
            reason = self._troubles.reason((kind, key))
            since_s = min(
                (job.since_s for job in (*self._jobs, *self._at_work) if job.key == (kind, key)), default=None
            )
        waits_s = self._now() - since_s if since_s is not None else 0.0
        if reason or waits_s < SLOW_S:
            return reason
        return self._waits(waits_s)

    def close(self) -> None:
        with self._news:
            self._closing = True
            self._news.notify()
        if threading.current_thread() is not self._thread:
            self._thread.join()

    def _run(self) -> None:
        while (batch := self._next_batch()) is not None:
            try:
                if batch:
                    self._write(batch)
                    self._report()
                else:
                    self._journal.check()
            except JournalLostError as error:
                self._give_up(str(error), batch)
            with self._news:
                self._at_work = []
        self._journal.close()

    def _next_batch(self) -> list[_Job] | None:
        """Wait for jobs and return those that are due; none if the journal must be checked; None: it closes."""
        look_s = self._journal.check_s
        with self._news:
            while True:
                now_s = math.inf if self._closing else self._now()
                due: list[_Job] = []
                late: list[_Job] = []
                for job in self._jobs:
                    (late if self._troubles.due_s(job.key) > now_s else due).append(job)
                if due:
                    self._jobs, self._at_work = late, due
                    return due
                if self._closing:
                    return None
                due_s = min((self._troubles.due_s(job.key) - now_s for job in late), default=None)
                if look_s is None or self._gone:
                    self._news.wait(due_s)
                elif not self._news.wait(min(look_s, due_s if due_s is not None else look_s)):
                    return []

    def _give_up(self, reason: str, batch: Sequence[_Job]) -> None:
        with self._news:
            self._gone = reason
            left, self._jobs = self._jobs, []
        for job in (*batch, *left):
            job.call(reason)
        self._lost(reason)


class VirtualStore(RecordStore):
    """Write to a journal in virtual time: without a thread, after a modelled delay.

    Args:
        journal: the journal, which defines how long a write takes; the store closes it.
        call_later: runs a function in a number of seconds of host time, such as a transport's; equal delays in the
            order of the calls.
        now: the clock, in seconds.
        say: logs that the journal cannot write; see `RecordStore`.
    """

    def __init__(
        self,
        journal: MemoryJournal,
        call_later: Callable[[float, Callable[[], None]], Any],
        now: Callable[[], float] = lambda: 0.0,
        say: Say = lambda level, text: None,
    ) -> None:
        super().__init__(journal, now, say)
        self._call_later = call_later
        self._memory = journal
        self._jobs: dict[_Job, None] = {}
        self._closed = False

    def persist(self, entry: JournalEntry, persisted: Persisted, failed: Failed, may: May | None = None) -> None:
        if self._closed:
            failed("the journal is closed")
            return
        job = _Job(entry, persisted, failed, self._now(), may)
        self._jobs[job] = None
        self._call_later(
            max(self._memory.latency_s, self._troubles.due_s(job.key) - self._now()), lambda: self._write_one(job)
        )

    def trouble(self, kind: str, key: str) -> str:
        return self._troubles.reason((kind, key))

    def close(self) -> None:
        for job in list(self._jobs):
            self._write_one(job)
        self._closed = True
        self._journal.close()

    def crash(self) -> None:
        """End as in a power cut: what waits is never written, and no callback is called."""
        self._jobs.clear()
        self._closed = True
        self._journal.close()

    def _write_one(self, job: _Job) -> None:
        if job in self._jobs:
            del self._jobs[job]
            self._write([job])
            self._report()
