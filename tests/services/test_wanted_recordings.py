"""Which recording must continue is kept in the journal."""

import pytest

from pancakes.journal import Disk, JournalEntry, MemoryJournal, VirtualStore
from pancakes.services.log import KIND, NOTHING, WantedRecording, wanted_recordings

PATH = "log/Recorder"


@pytest.fixture
def disk():
    return {}


def opened(disk):
    """Returns what is known after a start of the agent, its store, which writes when it is closed, and what is told."""
    journal = MemoryJournal(disk, "3f0c2d8e-0000-4000-8000-000000000000")
    store = VirtualStore(journal, lambda delay_s, write: None)
    unread: list[str] = []
    return wanted_recordings(Disk(journal, store, unread)), store, unread


def test_what_is_wanted_is_known_after_a_restart(disk):
    wanted, store, unread = opened(disk)
    assert (wanted.newest, wanted.on_disk, unread) == ({}, {}, [])
    first = WantedRecording("/tmp/r.mcap", {"channels": ["system"]})
    wanted.write(PATH, first, lambda: None, pytest.fail)
    wanted.write("audit/Recorder", NOTHING, lambda: None, pytest.fail)
    store.close()
    wanted, _, unread = opened(disk)
    assert wanted.newest == wanted.on_disk == {PATH: first, "audit/Recorder": NOTHING}
    assert unread == []


def test_what_cannot_be_read_is_told_and_nothing_goes_on(disk):
    journal = MemoryJournal(disk, "3f0c2d8e-0000-4000-8000-000000000000")
    journal.write([JournalEntry(KIND, PATH, b"\xc1")])
    journal.close()
    wanted, _, (sentence,) = opened(disk)
    assert wanted.newest == {}
    assert sentence.startswith("the journal has lost which recording must continue: ")
