"""Stores: an entry goes in without waiting, a call comes back when it is on disk."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence

import pytest

from pancakes.journal import JournalEntry, JournalError, JournalLostError, MemoryJournal, ThreadedStore, VirtualStore


class SlowJournal(MemoryJournal):
    """A journal whose first round of writing takes until the test lets it go on, and that notes the rounds."""

    def __init__(self) -> None:
        super().__init__({}, "id")
        self.rounds: list[list[bytes]] = []
        self.writing = threading.Event()
        self.go_on = threading.Event()

    def write(self, batch: Sequence[JournalEntry]) -> None:
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


def entry(data: bytes) -> JournalEntry:
    return JournalEntry("task", data.decode(), data)


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


def test_what_one_turn_writes_down_goes_in_one_round() -> None:
    journal, put_off = SlowJournal(), list[Callable[[], None]]()
    journal.go_on.set()
    store = ThreadedStore(journal, defer=put_off.append)
    for data in (b"a", b"b", b"c"):
        store.persist(entry(data), lambda: None, never)
    assert not journal.writing.is_set()
    for wake in put_off:
        wake()
    assert journal.writing.wait(10)
    store.close()

    assert journal.rounds == [[b"a", b"b", b"c"]]


def test_one_entry_at_fault_does_not_fail_those_that_wait_with_it() -> None:
    journal = SlowJournal()
    store = ThreadedStore(journal)
    told: list[str] = []
    store.persist(entry(b"a"), lambda: told.append("a"), never)
    assert journal.writing.wait(10)
    store.persist(entry(b"b"), lambda: told.append("b"), never)
    store.persist(JournalEntry("BAD", "x", b"x"), lambda: told.append("x"), told.append)
    store.persist(entry(b"c"), lambda: told.append("c"), never)
    journal.go_on.set()
    store.close()

    assert told == ["a", "b", "'BAD' is not a kind of journal entry: use lower-case letters", "c"]


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
    journal = MemoryJournal(disk, "id")
    journal.latency_s = 0.004
    store = VirtualStore(journal, later)
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
        def write(self, batch: Sequence[JournalEntry]) -> None:
            raise JournalError("No space left on device")

    later = Later()
    store = VirtualStore(Full({}, "id"), later)
    told: list[str] = []
    store.persist(entry(b"a"), lambda: told.append("a"), told.append)
    later.turn()

    assert told == ["No space left on device"]


# A journal that cannot write -----------------------------------------------------------------------------------------


class FullJournal(MemoryJournal):
    """A journal whose disk is full for a time, and that counts the tries."""

    def __init__(self) -> None:
        super().__init__({}, "id")
        self.full = True
        self.tries = 0

    def write(self, batch: Sequence[JournalEntry]) -> None:
        self.tries += 1
        if self.full:
            raise JournalError("the journal cannot write: No space left on device (/state)")
        super().write(batch)


class Time:
    """A clock that stands still until the next call that was put off is due."""

    def __init__(self) -> None:
        self.now_s = 0.0
        self.calls: list[tuple[float, int, Callable[[], None]]] = []

    def call_later(self, delay_s: float, function: Callable[[], None]) -> None:
        self.calls.append((self.now_s + delay_s, len(self.calls), function))

    def run_until(self, time_s: float) -> None:
        while self.calls and (first := min(self.calls))[0] <= time_s:
            self.calls.remove(first)
            self.now_s = first[0]
            first[2]()
        self.now_s = time_s


def test_who_tries_again_at_once_is_held_back_and_what_is_said_of_it_is_little() -> None:
    time, journal = Time(), FullJournal()
    said: list[tuple[float, str, str]] = []
    store = VirtualStore(
        journal, time.call_later, now=lambda: time.now_s, say=lambda level, text: said.append((time.now_s, level, text))
    )
    done: list[float] = []

    def write(data: bytes) -> None:
        store.persist(entry(data), lambda: done.append(time.now_s), lambda reason: write(data))

    write(b"a")
    time.run_until(60.0)

    assert 12 <= journal.tries <= 20
    times = [when for when, _, _ in said]
    assert all(later - earlier > 4.99 for earlier, later in zip(times, times[1:], strict=False))
    full = "the journal cannot write: No space left on device (/state)"
    assert said[0][1:] == ("error", f"{full}: it is retried, first soon, then every 5 s")
    assert said[-1][2].startswith(f"{full}: {journal.tries} tries in ")
    assert store.trouble("task", "a") == full

    journal.full = False
    time.run_until(70.0)
    assert len(done) == 1 and done[0] <= 65.0
    assert said[-1][1] == "info" and said[-1][2].startswith(
        f"the journal can write again ({journal.tries - 1} tries in "
    )
    assert store.trouble("task", "a") == ""


def test_what_did_not_fail_does_not_wait_for_what_did() -> None:
    time, journal = Time(), FullJournal()
    store = VirtualStore(journal, time.call_later, now=lambda: time.now_s)
    for _ in range(6):
        store.persist(entry(b"large"), lambda: None, lambda reason: None)
        time.run_until(time.now_s + 5.0)
    journal.full = False
    done: list[str] = []
    store.persist(entry(b"large"), lambda: done.append("large"), never)
    store.persist(entry(b"small"), lambda: done.append("small"), never)
    time.run_until(time.now_s + 0.01)
    assert "small" in done
    store.close()
    assert sorted(done) == ["large", "small"]


def test_a_journal_that_is_not_the_one_any_more_ends_the_store_within_a_second_and_fails_all_that_comes() -> None:
    class Replaced(MemoryJournal):
        check_s = 0.01

        def check(self) -> None:
            raise JournalLostError("the state directory was replaced")

    told: list[str] = []
    lost = threading.Event()

    def tell(reason: str) -> None:
        told.append(reason)
        lost.set()

    store = ThreadedStore(Replaced({}, "id"), lost=tell)

    assert lost.wait(10)
    store.persist(entry(b"a"), lambda: told.append("written"), told.append)
    store.close()

    assert told == ["the state directory was replaced"] * 2
    assert store.trouble("task", "a") == "the state directory was replaced"


def test_an_entry_is_asked_for_right_before_it_is_written_and_fails_where_it_may_not_be_any_more() -> None:
    journal = SlowJournal()
    store = ThreadedStore(journal)
    told: list[str] = []
    may = [""]
    store.persist(entry(b"a"), lambda: told.append("a"), never)
    assert journal.writing.wait(10)
    store.persist(entry(b"b"), lambda: told.append("b"), told.append, lambda: may[0])
    store.persist(entry(b"c"), lambda: told.append("c"), never)
    may[0] = "its guardians do not answer"
    journal.go_on.set()
    store.close()
    assert sorted(told) == ["a", "c", "its guardians do not answer"]
    assert journal.rounds == [[b"a"], [b"c"]]


def test_an_entry_that_may_not_be_written_does_not_keep_the_next_one_from_it() -> None:
    later = Later()
    store = VirtualStore(MemoryJournal({}, "id"), later)
    told: list[str] = []
    store.persist(entry(b"a"), lambda: told.append("a"), told.append, lambda: "not now")
    store.persist(entry(b"a"), lambda: told.append("a"), told.append, lambda: "")
    store.close()
    assert told == ["not now", "a"]
