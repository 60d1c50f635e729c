"""What every journal promises, whatever it writes to: one suite for the file and the memory journal."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Protocol

import pytest

from pancakes.journal import FileJournal, Journal, JournalEntry, JournalError, MemoryJournal
from pancakes.journal.journal import MARK


class Disk(Protocol):
    """A disk that outlives the journals on it, and that a test may damage."""

    def open(self, uuid: str = "first") -> Journal: ...

    def names(self) -> list[str]: ...

    def read(self, name: str) -> bytes: ...

    def write(self, name: str, data: bytes) -> None: ...

    def copy(self) -> Disk:
        """Return a copy, as a backup makes one that takes a file at a time."""


class DirectoryDisk:
    def __init__(self, directory: Path) -> None:
        self.directory = directory

    def open(self, uuid: str = "first") -> Journal:
        return FileJournal(self.directory, uuid)

    def names(self) -> list[str]:
        return sorted(path.name for path in self.directory.iterdir())

    def read(self, name: str) -> bytes:
        return (self.directory / name).read_bytes()

    def write(self, name: str, data: bytes) -> None:
        (self.directory / name).write_bytes(data)

    def copy(self) -> DirectoryDisk:
        directory = self.directory.with_name(f"copy{len(list(self.directory.parent.iterdir()))}")
        shutil.copytree(self.directory, directory)
        return DirectoryDisk(directory)


class DictionaryDisk:
    def __init__(self) -> None:
        self.cells: dict[str, bytes] = {}

    def open(self, uuid: str = "first") -> Journal:
        return MemoryJournal(self.cells, uuid)

    def names(self) -> list[str]:
        return sorted(self.cells)

    def read(self, name: str) -> bytes:
        return self.cells[name]

    def write(self, name: str, data: bytes) -> None:
        self.cells[name] = data

    def copy(self) -> DictionaryDisk:
        copy = DictionaryDisk()
        copy.cells.update((name, data) for name, data in self.cells.items() if name != MARK)
        return copy


@pytest.fixture(params=["file", "memory"])
def disk(request: pytest.FixtureRequest, tmp_path: Path) -> Disk:
    return DirectoryDisk(tmp_path / "state") if request.param == "file" else DictionaryDisk()


SCAN = JournalEntry("task", "agent1/ScanTarget", b"on the circle")
HOME = JournalEntry("task", "agent1/GoHome", b"parked")
NAME = "task.agent1%2FScanTarget.rec"


def test_what_was_written_is_there_after_a_restart(disk: Disk) -> None:
    journal = disk.open()
    journal.write([SCAN, HOME])
    journal.close()

    reopened = disk.open()

    assert reopened.read("task", "agent1/ScanTarget") == SCAN
    assert reopened.entries("task") == [HOME, SCAN]
    assert reopened.entries("fence") == []
    assert reopened.set_aside == ()


def test_a_later_entry_takes_the_place_of_an_earlier_one(disk: Disk) -> None:
    journal = disk.open()
    journal.write([SCAN])
    journal.write([HOME, JournalEntry("task", SCAN.key, b"2"), JournalEntry("task", SCAN.key, b"3")])
    journal.close()

    reopened = disk.open()

    assert [entry.data for entry in reopened.entries("task")] == [b"parked", b"3"]


def test_a_journal_keeps_its_id_and_counts_its_boots(disk: Disk) -> None:
    first = disk.open("first")
    first.close()
    second = disk.open("second")

    assert (first.uuid, first.boot) == ("first", 1)
    assert (second.uuid, second.boot) == ("first", 2)


def opened(disk: Disk, life: str) -> tuple[str, bool]:
    """Open a journal, and returns which copy it is, and whether it has just become one."""
    journal = disk.open(life)
    journal.close()
    return journal.copy, journal.copied


def test_a_copy_is_told_from_the_original_and_from_other_copies(disk: Disk) -> None:
    assert opened(disk, "first") == opened(disk, "second") == ("", False)
    backup = disk.copy()
    assert opened(disk, "third") == ("", False)

    one, other = backup.copy(), backup.copy()

    (of_one, is_new), (of_other, _) = opened(one, "fourth"), opened(other, "fifth")
    assert is_new and len({"", of_one, of_other}) == 3
    assert opened(one, "sixth") == (of_one, False)
    assert opened(one.copy(), "seventh")[0] not in (of_one, "")
    assert one.open("eighth").uuid == "first"


def test_two_cannot_have_it_at_once(disk: Disk) -> None:
    journal = disk.open()
    with pytest.raises(JournalError, match="in use"):
        disk.open()
    journal.close()
    disk.open().close()


def test_a_closed_journal_writes_nothing(disk: Disk) -> None:
    journal = disk.open()
    journal.close()
    with pytest.raises(JournalError, match="closed"):
        journal.write([SCAN])


@pytest.mark.parametrize(
    ("damage", "reason"),
    [
        (lambda data: data[:-1], "torn or damaged"),
        (lambda data: data[: len(data) // 2], "torn or damaged"),
        (lambda data: b"", "is empty"),
        (lambda data: data[:-3] + b"xyz", "torn or damaged"),
        (lambda data: b"TOML" + data, "is not a file of a journal"),
    ],
    ids=["last byte missing", "half", "empty", "changed", "another format"],
)
def test_a_damaged_entry_is_set_aside_by_name_and_never_used(
    disk: Disk, damage: Callable[[bytes], bytes], reason: str
) -> None:
    journal = disk.open()
    journal.write([SCAN, HOME])
    journal.close()
    disk.write(NAME, damage(disk.read(NAME)))

    reopened = disk.open()

    assert reopened.read("task", SCAN.key) is None
    assert reopened.entries("task") == [HOME]
    (aside,) = reopened.set_aside
    assert (aside.kind, aside.key) == ("task", "agent1/ScanTarget")
    assert NAME in str(aside) and reason in str(aside)
    assert NAME not in disk.names() and NAME + ".bad" in disk.names()
    reopened.close()
    # It is reported once, and out of the way from then on.
    assert disk.open().set_aside == ()


def test_what_was_set_aside_is_missing_at_each_opening_until_it_is_written_again(disk: Disk) -> None:
    journal = disk.open()
    journal.write([SCAN, HOME])
    journal.close()
    whole = disk.read(NAME)
    for at in range(len(whole)):
        disk.write(NAME, whole[:at] + bytes([whole[at] ^ 1]) + whole[at + 1 :])
        disk.open().close()

    for _ in range(3):
        reopened = disk.open()
        (missing,) = reopened.missing
        assert (missing.kind, missing.key, missing.times) == ("task", "agent1/ScanTarget", len(whole))
        assert missing.entry is None and reopened.read("task", SCAN.key) is None
        reopened.close()

    reopened = disk.open()
    reopened.write([SCAN])
    reopened.close()
    assert disk.open().missing == ()


def test_of_a_journal_that_lost_its_identity_all_is_missing_and_can_be_read(disk: Disk) -> None:
    journal = disk.open("first")
    journal.write([SCAN, HOME])
    journal.close()
    disk.write("identity.identity.rec", b"garbage")
    disk.open("second").close()

    assert [missing.entry for missing in disk.open("third").missing] == [HOME, SCAN]


def test_a_second_damaged_entry_does_not_overwrite_the_first(disk: Disk) -> None:
    disk.open().close()
    for text in (b"one", b"two"):
        disk.write(NAME, text)
        disk.open().close()

    assert disk.read(NAME + ".bad") == b"one"
    assert disk.read(NAME + ".2.bad") == b"two"


def test_an_entry_of_another_journal_is_set_aside(disk: Disk, tmp_path: Path) -> None:
    other = FileJournal(tmp_path / "other", "another-robot")
    other.write([SCAN])
    other.close()
    disk.open().close()
    disk.write(NAME, (tmp_path / "other" / NAME).read_bytes())

    (aside,) = disk.open().set_aside

    assert "belongs to the journal another-robot, this is first" in aside.reason


def test_an_entry_under_a_false_name_is_set_aside(disk: Disk) -> None:
    journal = disk.open()
    journal.write([SCAN])
    journal.close()
    disk.write("task.agent1%2FGoHome.rec", disk.read(NAME))

    reopened = disk.open()

    assert [aside.key for aside in reopened.set_aside] == ["agent1/GoHome"]
    assert reopened.entries("task") == [SCAN]


def test_a_journal_that_lost_its_identity_is_another_one_and_believes_nothing(disk: Disk) -> None:
    journal = disk.open("first")
    journal.write([SCAN])
    journal.close()
    disk.write("identity.identity.rec", b"garbage")

    reopened = disk.open("second")

    assert (reopened.uuid, reopened.boot) == ("second", 1)
    assert reopened.entries("task") == []
    assert len(reopened.set_aside) == 2


@pytest.mark.parametrize("kind", ["", "Task", "task.x", "identity"])
def test_a_kind_is_a_word(disk: Disk, kind: str) -> None:
    with pytest.raises(JournalError, match="not a kind"):
        disk.open().write([JournalEntry(kind, "key", b"")])


def test_keys_may_have_any_letters_but_not_any_length(disk: Disk) -> None:
    journal = disk.open()
    odd = JournalEntry("task", "../agent 1/Straße\n%", b"x")
    journal.write([odd])
    with pytest.raises(JournalError, match="too long"):
        journal.write([JournalEntry("task", "x" * 300, b"")])
    journal.close()

    assert disk.open().entries("task") == [odd]
