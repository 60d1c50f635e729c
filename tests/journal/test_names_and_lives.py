"""A journal knows the names of the agents that had it, and each opening from all others."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from pancakes import __version__
from pancakes.durable.answers import MOST_AGENTS, Boot, BootMemory
from pancakes.journal import Disk, FileJournal, JournalEntry, JournalError, MemoryJournal, VirtualStore
from pancakes.journal.journal import MOST_NAMES


def test_it_knows_the_names_under_which_it_was_opened_before(tmp_path: Path) -> None:
    def former(agent: str) -> tuple[str, ...]:
        journal = FileJournal(tmp_path, agent=agent)
        journal.close()
        return journal.former

    assert former("a") == former("a") == ()
    assert former("b") == ("a",)
    assert former("a") == ("b",)
    for number in range(2 * MOST_NAMES):
        former(f"c{number}")
    assert former("d") == tuple(f"c{number}" for number in range(MOST_NAMES, 2 * MOST_NAMES))


def test_no_two_openings_are_the_same_life(tmp_path: Path) -> None:
    lives = set()
    for _ in range(3):
        journal = FileJournal(tmp_path)
        lives.add(journal.life)
        journal.close()
    assert len(lives) == 3


def memory(disk: dict[str, bytes], pending: list[Callable[[], object]]) -> BootMemory:
    journal = MemoryJournal(disk, "id")
    return BootMemory(Disk(journal, VirtualStore(journal, lambda delay_s, write: pending.append(write)), []))


def test_what_was_met_is_remembered_over_a_restart_and_written_once_for_each_boot() -> None:
    disk: dict[str, bytes] = {}
    pending: list[Callable[[], object]] = []
    before = memory(disk, pending)
    for _ in range(3):
        assert before.met("a", Boot("disk", 5, "fifth")) is None
    assert len(pending) == 1
    pending.pop()()
    disk.pop("lock")
    again = memory(disk, pending)
    assert again.met("a", Boot("disk", 4, "fourth")) == Boot("disk", 5, "fifth")
    assert again.met("b", Boot("disk", 4, "fourth")) is None, "another agent's number says nothing"
    assert again.met("a", Boot("disk", 6, "sixth")) is None


def test_so_many_agents_are_remembered_and_no_more() -> None:
    disk: dict[str, bytes] = {}
    known = memory(disk, [])
    for number in range(MOST_AGENTS + 1):
        known.met(f"a{number}", Boot("disk", 5, "fifth"))
    copy = Boot("disk", 4, "fourth")
    assert known.met("a0", copy) is not None and known.met(f"a{MOST_AGENTS}", copy) is None


def test_journal_of_a_later_format_is_left_as_it_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Both versions are named; nothing is put aside, so that the later one finds all of it."""
    with monkeypatch.context() as later:
        later.setattr("pancakes.journal.journal.FORMAT", 2)
        later.setattr("pancakes.journal.journal.__version__", "0.9.0")
        journal = FileJournal(tmp_path)
        journal.write([JournalEntry("task", "a/Count", b"x")])
        journal.close()
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir() if path.name != "lock"}
    with pytest.raises(JournalError) as refused:
        FileJournal(tmp_path)
    assert str(refused.value) == (
        f"{tmp_path} is of the format 2, which Pancakes 0.9.0 has written, and this is Pancakes {__version__}, which"
        " reads formats up to 1: start it with that version"
    )
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir() if path.name != "lock"} == before


def test_journal_knows_the_version_that_wrote_it(tmp_path: Path) -> None:
    assert [FileJournal(tmp_path / "a").written_by, reopened(tmp_path / "a").written_by] == ["", __version__]


def reopened(folder: Path) -> FileJournal:
    return FileJournal(shutil.copytree(folder, folder.with_name("copy")))
