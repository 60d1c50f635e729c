"""One kind of record on disk: read at the start, seen in memory, written without waiting."""

from collections.abc import Callable

import pytest

from pancakes.journal import Disk, JournalEntry, MemoryJournal, RecordTable, VirtualStore
from pancakes.util import codecs


class Rig:
    """A table of numbers by name, on a journal that writes when it is told to."""

    def __init__(self, contents):
        self.journal = MemoryJournal(contents, "id")
        self.pending: list[Callable[[], object]] = []
        self.store = VirtualStore(self.journal, lambda delay_s, write: self.pending.append(write))
        self.malformed: list[tuple[str, str]] = []
        self.table = RecordTable(
            Disk(self.journal, self.store, []),
            "number",
            codecs.decoder(int),
            lambda key, why: self.malformed.append((key, why)),
        )
        self.told = []

    def write(self, key, number):
        self.table.write(key, number, lambda: self.told.append(key), self.told.append)

    def write_out(self):
        while self.pending:
            self.pending.pop(0)()


@pytest.fixture
def contents():
    return {}


@pytest.fixture
def rig(contents):
    return Rig(contents)


def test_a_record_is_on_disk_once_it_is_written_and_known_as_the_newest_before(rig):
    rig.write("a", 1)
    assert (rig.table.newest, rig.table.on_disk, rig.told) == ({"a": 1}, {}, [])
    rig.write_out()
    assert (rig.table.newest, rig.table.on_disk, rig.told) == ({"a": 1}, {"a": 1}, ["a"])


def test_the_next_start_reads_the_last_record_of_each_key_and_no_other_kind(rig, contents):
    rig.journal.write([JournalEntry("other", "c", codecs.encode(3))])
    for key, number in (("a", 1), ("b", 2), ("a", 4)):
        rig.write(key, number)
    rig.store.close()
    again = Rig(contents)
    assert again.table.newest == again.table.on_disk == {"a": 4, "b": 2}
    assert again.malformed == []


def test_a_record_that_is_written_while_an_earlier_one_waits_is_the_newest(rig):
    rig.write("a", 1)
    rig.write("a", 2)
    rig.pending.pop(0)()
    assert (rig.table.newest, rig.table.on_disk) == ({"a": 2}, {"a": 1})


def test_of_records_that_cannot_be_read_the_key_is_told_and_the_others_are_there(rig, contents):
    rig.journal.write([JournalEntry("number", "bad", b"\xc1"), JournalEntry("number", "good", codecs.encode(1))])
    rig.store.close()
    again = Rig(contents)
    assert again.table.on_disk == {"good": 1}
    ((key, why),) = again.malformed
    assert key == "bad" and "malformed" in why


def test_what_cannot_be_written_is_told_and_is_not_on_disk(rig):
    rig.journal.close()
    rig.write("a", 1)
    rig.write_out()
    assert rig.told == ["the journal is closed"]
    assert rig.table.on_disk == {}
    assert (rig.table.trouble("a"), rig.table.trouble("b")) == ("the journal is closed", "")


def test_a_record_for_which_there_is_no_memory_fails_like_one_for_which_there_is_no_disk(rig, monkeypatch):
    def encode(value):
        raise MemoryError("no memory for 12 MB")

    monkeypatch.setattr(codecs, "encode", encode)
    rig.write("a", 1)
    assert (rig.told, rig.pending, rig.table.on_disk) == (["no memory for 12 MB"], [], {})
