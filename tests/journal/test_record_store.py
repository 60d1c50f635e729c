"""Stores: an entry goes in without waiting, a call comes back when it is on disk."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence

import pytest

from pancakes.journal import Entry, JournalError, MemoryJournal, ThreadedStore, VirtualStore


class SlowJournal(MemoryJournal):
    """A journal whose first round of writing takes until the test lets it go on, and that notes the rounds."""

    def __init__(self) -> None:
        super().__init__({}, "id")
        self.rounds: list[list[bytes]] = []
        self.writing = threading.Event()
        self.go_on = threading.Event()

    def write(self, batch: Sequence[Entry]) -> None:
        self.rounds.append([entry.data for entry in batch])
        self.writing.set()
        assert self.go_on.wait(10)
        super().write(batch)


class Later:
    """A timer that the test turns."""

    def __init__(self) -> None:
        self.calls: list[tuple[float, Callable[[], None]]] = []

    def __call__(self, delay_s: float, function: Callable[[], None]) -> None:
        self.calls.append((delay_s, function))

    def turn(self) -> None:
        self.calls.pop(0)[1]()


def entry(data: bytes) -> Entry:
    return Entry("task", data.decode(), data)


def never(reason: str) -> None:
    raise AssertionError(reason)


def test_a_threaded_store_calls_back_when_the_entry_is_on_disk() -> None:
    disk: dict[str, bytes] = {}
    store = ThreadedStore(MemoryJournal(disk, "id"))
    there: list[bool] = []
    told = threading.Event()

    def persisted() -> None:
        there.append("task.a.rec" in disk)
        told.set()

    store.persist(entry(b"a"), persisted, never)

    assert told.wait(10)
    assert there == [True]
    store.close()


def test_what_waits_is_written_together_and_told_in_order() -> None:
    journal = SlowJournal()
    store = ThreadedStore(journal)
    told: list[bytes] = []

    def submit(data: bytes) -> None:
        store.persist(entry(data), lambda: told.append(data), never)

    submit(b"a")
    assert journal.writing.wait(10)
    for data in (b"b", b"c", b"d"):
        submit(data)
    journal.go_on.set()
    store.close()

    assert journal.rounds == [[b"a"], [b"b", b"c", b"d"]]
    assert told == [b"a", b"b", b"c", b"d"]


def test_one_entry_at_fault_does_not_fail_those_that_wait_with_it() -> None:
    journal = SlowJournal()
    store = ThreadedStore(journal)
    told: list[str] = []
    store.persist(entry(b"a"), lambda: told.append("a"), never)
    assert journal.writing.wait(10)
    store.persist(entry(b"b"), lambda: told.append("b"), never)
    store.persist(Entry("BAD", "x", b"x"), lambda: told.append("x"), told.append)
    store.persist(entry(b"c"), lambda: told.append("c"), never)
    journal.go_on.set()
    store.close()

    assert told == ["a", "b", "'BAD' is no kind of journal entry: lower-case letters are", "c"]


@pytest.mark.parametrize("kind", ["threaded", "virtual"])
def test_closing_writes_what_waits_and_refuses_what_comes_later(kind: str) -> None:
    disk: dict[str, bytes] = {}
    journal = MemoryJournal(disk, "id")
    store = ThreadedStore(journal) if kind == "threaded" else VirtualStore(journal, Later())
    told: list[str] = []
    store.persist(entry(b"a"), lambda: told.append("a"), never)
    store.close()
    store.persist(entry(b"b"), lambda: told.append("b"), told.append)

    assert told == ["a", "the journal is closed"]
    assert MemoryJournal(disk, "").entries("task") == [entry(b"a")]


def test_a_virtual_store_writes_after_its_delay_in_order() -> None:
    disk: dict[str, bytes] = {}
    later = Later()
    store = VirtualStore(MemoryJournal(disk, "id"), later, latency_s=0.004)
    told: list[str] = []
    store.persist(entry(b"a"), lambda: told.append("a"), never)
    store.persist(entry(b"b"), lambda: told.append("b"), never)

    assert [delay_s for delay_s, _ in later.calls] == [0.004, 0.004]
    assert told == [] and "task.a.rec" not in disk
    later.turn()
    assert told == ["a"] and "task.a.rec" in disk
    later.turn()
    assert told == ["a", "b"]


def test_a_crash_loses_what_was_not_written_and_tells_nobody() -> None:
    disk: dict[str, bytes] = {}
    later = Later()
    store = VirtualStore(MemoryJournal(disk, "id"), later)
    told: list[str] = []
    store.persist(entry(b"a"), lambda: told.append("a"), never)
    later.turn()
    store.persist(entry(b"b"), lambda: told.append("b"), never)
    store.crash()
    later.turn()

    assert told == ["a"]
    assert MemoryJournal(disk, "").entries("task") == [entry(b"a")]


def test_a_virtual_store_reports_a_write_that_fails() -> None:
    class Full(MemoryJournal):
        def write(self, batch: Sequence[Entry]) -> None:
            raise JournalError("No space left on device")

    later = Later()
    store = VirtualStore(Full({}, "id"), later)
    told: list[str] = []
    store.persist(entry(b"a"), lambda: told.append("a"), told.append)
    later.turn()

    assert told == ["No space left on device"]
