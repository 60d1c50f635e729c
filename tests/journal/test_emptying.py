"""Removing what an agent remembers, from outside."""

from pathlib import Path

import pytest

from pancakes.journal import FileJournal, JournalEntry, JournalError, empty


def test_a_journal_is_removed_with_what_was_put_aside_and_all_else_stays(tmp_path: Path) -> None:
    journal = FileJournal(tmp_path / "state")
    journal.write([JournalEntry("record", "a/Walk", b"1"), JournalEntry("record", "a/Stay", b"2")])
    journal.close()
    torn = next((tmp_path / "state").glob("record.*Walk*"))
    torn.write_bytes(b"torn")
    FileJournal(tmp_path / "state").close()
    (tmp_path / "state" / "mine.txt").write_text("mine")

    assert empty(tmp_path / "state")

    assert sorted(path.name for path in (tmp_path / "state").iterdir()) == ["lock", "mark", "mine.txt"]
    again = FileJournal(tmp_path / "state")
    assert (again.boot, again.entries("record"), again.set_aside) == (1, [], ())
    assert again.uuid != journal.uuid
    again.close()


def test_there_may_be_nothing_to_remove(tmp_path: Path) -> None:
    assert not empty(tmp_path / "nowhere")
    assert not (tmp_path / "nowhere").exists()


def test_a_journal_in_use_is_left_as_it_is(tmp_path: Path) -> None:
    journal = FileJournal(tmp_path)
    before = sorted(path.name for path in tmp_path.iterdir())
    with pytest.raises(JournalError, match="is in use by another agent"):
        empty(tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == before
    journal.close()
