"""What a journal in a directory has written to its write-ahead file, and what is left of that after a crash."""

from __future__ import annotations

import os
import resource
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from pancakes.journal import FileJournal, JournalEntry, JournalError, file_journal
from pancakes.journal.file_journal import WRITE_AHEAD, read_ahead, seal_batch

LARGE = b"x" * 300_000


@pytest.fixture
def journal(tmp_path: Path) -> FileJournal:
    return FileJournal(tmp_path / "state", "first")


def entry(key: str, data: bytes | str) -> JournalEntry:
    return JournalEntry("task", key, data if isinstance(data, bytes) else data.encode())


def after_a_crash(journal: FileJournal, damage: Callable[[bytes], bytes] = lambda data: data) -> FileJournal:
    """Open a copy of what a journal that is open has on disk, and damages its write-ahead file before."""
    copy = journal.directory.with_name(f"copy{len(list(journal.directory.parent.iterdir()))}")
    shutil.copytree(journal.directory, copy)
    ahead = copy / WRITE_AHEAD
    if ahead.exists():
        ahead.write_bytes(damage(ahead.read_bytes()))
    return FileJournal(copy, "second")


def kept(journal: FileJournal) -> dict[str, bytes]:
    return {it.key: it.data for it in journal.entries("task")}


def test_what_was_written_outlives_a_crash_and_the_newest_counts(journal: FileJournal) -> None:
    journal.write([entry("a", "1"), entry("b", "1")])
    journal.write([entry("a", "2")])

    again = after_a_crash(journal)

    assert (again.uuid, again.boot, again.set_aside) == ("first", 2, ())
    assert kept(again) == {"a": b"2", "b": b"1"}
    assert not (again.directory / WRITE_AHEAD).exists()


@pytest.mark.parametrize("size", [1, file_journal.LARGE_BYTES // 40])
def test_a_batch_costs_one_round_of_the_disk_however_many_entries_it_has(
    journal: FileJournal, monkeypatch: pytest.MonkeyPatch, size: int
) -> None:
    journal.write([entry("a", "1")])
    before, length = journal.use, (journal.directory / WRITE_AHEAD).stat().st_size
    synced: list[str] = []
    fsync = os.fsync

    def spy(handle: int) -> None:
        synced.append(Path(os.readlink(f"/proc/self/fd/{handle}")).name)
        fsync(handle)

    monkeypatch.setattr(os, "fsync", spy)
    journal.write([entry(str(number), "2" * size) for number in range(50)])

    assert synced == [WRITE_AHEAD]
    grown = (journal.directory / WRITE_AHEAD).stat().st_size - length
    assert journal.use == (before.syncs + 1, before.written_bytes + grown)


def test_a_batch_that_was_not_finished_is_as_if_it_had_never_been(journal: FileJournal) -> None:
    journal.write([entry("a", "1")])
    before = len((journal.directory / WRITE_AHEAD).read_bytes())
    journal.write([entry("a", "2"), entry("b", "2")])
    whole = len((journal.directory / WRITE_AHEAD).read_bytes())

    for length in range(before, whole):
        again = after_a_crash(journal, lambda data, length=length: data[:length])  # type: ignore[misc]
        assert (again.uuid, kept(again), again.set_aside) == ("first", {"a": b"1"}, ())
    again = after_a_crash(journal, lambda data: data[:-3] + b"???")
    assert (again.uuid, kept(again)) == ("first", {"a": b"1"})


def test_a_journal_whose_file_is_damaged_before_whole_batches_is_another_one_and_believes_nothing(
    journal: FileJournal,
) -> None:
    journal.write([entry("a", "1")])
    first = len((journal.directory / WRITE_AHEAD).read_bytes())
    journal.write([entry("b", "1")])
    journal.write([entry("a", "2")])

    for at in (0, 8, 20, 50, first, first + 60):
        again = after_a_crash(journal, lambda data, at=at: data[:at] + bytes([data[at] ^ 1]) + data[at + 1 :])  # type: ignore[misc]

        assert (again.uuid, again.boot, kept(again)) == ("second", 1, {})
        identity = again.set_aside[0]
        assert identity.kind == "identity" and f"{WRITE_AHEAD} beside it is damaged" in identity.reason
        assert [it.entry for it in again.missing] == ([entry("a", "1")] if at >= first else [])
        assert (again.directory / (WRITE_AHEAD + ".bad")).exists()
        again.write([entry("b", "3")])
        again.close()
        assert kept(FileJournal(again.directory)) == {"b": b"3"}


def test_the_file_of_another_journal_gives_rise_to_doubt(journal: FileJournal, tmp_path: Path) -> None:
    other = FileJournal(tmp_path / "other", "another-robot")
    other.write([entry("b", "1")])
    journal.write([entry("a", "1")])

    again = after_a_crash(journal, lambda data: (other.directory / WRITE_AHEAD).read_bytes())

    assert again.uuid == "second" and "is of the journal another-robot" in again.set_aside[0].reason
    assert [it.entry for it in again.missing] == [entry("b", "1")]


def test_of_a_journal_that_lost_its_identity_what_was_written_ahead_is_missing_too(journal: FileJournal) -> None:
    journal.write([entry("a", "1")])
    (journal.directory / "identity.identity.rec").unlink()

    again = after_a_crash(journal)

    assert again.uuid == "second" and [it.entry for it in again.missing] == [entry("a", "1")]


def test_a_long_file_is_begun_anew_and_nothing_is_lost(journal: FileJournal, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(file_journal, "MOST_AHEAD_BYTES", 4 * 2**20)
    for number in range(200):
        journal.write([entry(str(number % 7), bytes([number]) * 60_000)])

    assert (journal.directory / WRITE_AHEAD).stat().st_size <= 4 * 2**20
    assert kept(after_a_crash(journal)) == kept(journal)


def test_so_is_one_with_many_entries(journal: FileJournal, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(file_journal, "MOST_AHEAD", 20)
    journal.write([entry(str(number), "1") for number in range(20)])
    assert len(list(journal.directory.glob("task.*"))) == 0
    journal.write([entry("1", "2"), entry("20", "1")])

    assert len(list(journal.directory.glob("task.*"))) == 20
    assert kept(after_a_crash(journal)) == kept(journal)
    assert len(kept(journal)) == 21


def test_large_entries_have_files_of_their_own_at_once_and_no_older_one_takes_their_place(journal: FileJournal) -> None:
    journal.write([entry("a", "1"), entry("b", "1")])
    journal.write([entry("c", LARGE)])
    assert kept(after_a_crash(journal)) == {"a": b"1", "b": b"1", "c": LARGE}
    journal.write([entry("a", LARGE)])
    assert kept(after_a_crash(journal)) == {"a": LARGE, "b": b"1", "c": LARGE}
    journal.write([entry("a", "2")])
    assert kept(after_a_crash(journal)) == {"a": b"2", "b": b"1", "c": LARGE}


def test_where_another_program_has_removed_or_cut_the_file_nothing_is_lost(journal: FileJournal) -> None:
    ahead = journal.directory / WRITE_AHEAD
    for number, left in enumerate((None, 0, 10)):
        journal.write([entry("a", str(number))])
        ahead.unlink() if left is None else os.truncate(ahead, left)
        journal.write([entry("b", str(number))])
        assert kept(after_a_crash(journal)) == {"a": b"%d" % number, "b": b"%d" % number}


def test_what_a_full_disk_has_cut_is_written_over(journal: FileJournal) -> None:
    long = 1000 * b"1"  # other files are shorter than the one that is cut
    journal.write([entry("a", long)])
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, ((journal.directory / WRITE_AHEAD).stat().st_size + 20, limits[1]))
    try:
        with pytest.raises(JournalError, match="cannot write: File too large"):
            journal.write([entry("b", "1")])
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert kept(after_a_crash(journal)) == {"a": long}
    journal.write([entry("c", "1")])

    again = after_a_crash(journal)
    assert (again.uuid, kept(again)) == ("first", {"a": long, "c": b"1"})


def test_a_journal_that_is_closed_leaves_a_file_for_each_entry(journal: FileJournal) -> None:
    journal.write([entry("a", "1"), entry("b", "1")])
    journal.close()

    names = sorted(path.name for path in journal.directory.iterdir())
    assert names == ["identity.identity.rec", "lock", "mark", "reserve", "task.a.rec", "task.b.rec"]


def test_one_that_has_much_written_ahead_leaves_that_to_the_next_opening(journal: FileJournal) -> None:
    journal.write([entry(str(number), "1") for number in range(101)])
    journal.close()
    assert not list(journal.directory.glob("task.*"))

    again = FileJournal(journal.directory)

    assert len(kept(again)) == len(list(journal.directory.glob("task.*"))) == 101


def test_a_file_is_read_up_to_what_cannot_be_believed() -> None:
    one, two = seal_batch("x", [entry("a", "1")]), seal_batch("x", [entry("b", "2")])

    assert read_ahead(b"") == ([], False)
    assert [batch.entries for batch in read_ahead(one + two).batches] == [(entry("a", "1"),), (entry("b", "2"),)]
    assert read_ahead(one + two[:-1]) == (read_ahead(one).batches, False)
    assert read_ahead(one[:-1] + two) == ([], True)
    assert read_ahead(b"junk" + two) == ([], True)
    assert read_ahead(one + b"junk" + two) == (read_ahead(one).batches, True)
