"""Which recording is to go on is kept in the journal."""

import pytest

from pancakes.journal import JournalEntry, MemoryJournal, VirtualStore
from pancakes.services.wanted_recording import KIND, Wanted, WantedRecording


@pytest.fixture
def disk():
    return {}


def opened(disk):
    """Returns what is known after a start of the agent, and its store, which writes when it is closed."""
    journal = MemoryJournal(disk, "3f0c2d8e-0000-4000-8000-000000000000")
    store = VirtualStore(journal, lambda delay_s, write: None)
    return WantedRecording(journal, store), store


def test_what_is_wanted_is_known_after_a_restart_once_it_is_on_disk(disk):
    wanted, store = opened(disk)
    assert (wanted.now, wanted.on_disk, wanted.unread) == (None, None, [])
    told = []
    first = Wanted("/tmp/r.mcap", {"channels": ["system"]})
    wanted.want(first, lambda: told.append("written"), told.append)
    assert (wanted.now, wanted.on_disk, told) == (first, None, [])
    store.close()
    assert (wanted.on_disk, told) == (first, ["written"])
    wanted, _ = opened(disk)
    assert wanted.now == wanted.on_disk == first


def test_what_is_not_wanted_any_more_does_not_go_on(disk):
    wanted, store = opened(disk)
    for it in (Wanted("/tmp/r.mcap"), None):
        wanted.want(it, lambda: None, pytest.fail)
    store.close()
    assert opened(disk)[0].now is None


def test_each_log_service_has_a_recording_of_its_own(disk):
    journal = MemoryJournal(disk, "3f0c2d8e-0000-4000-8000-000000000000")
    store = VirtualStore(journal, lambda delay_s, write: None)
    WantedRecording(journal, store, "audit").want(Wanted("/tmp/audit.mcap"), lambda: None, pytest.fail)
    store.close()
    journal = MemoryJournal(disk, "3f0c2d8e-0000-4000-8000-000000000000")
    assert WantedRecording(journal, store).now is None
    assert WantedRecording(journal, store, "audit").now == Wanted("/tmp/audit.mcap")


def test_what_cannot_be_read_is_told_and_nothing_goes_on(disk):
    journal = MemoryJournal(disk, "3f0c2d8e-0000-4000-8000-000000000000")
    journal.write([JournalEntry(KIND, "log/Recorder", b"\xc1")])
    journal.close()
    wanted, _ = opened(disk)
    assert wanted.now is None
    (sentence,) = wanted.unread
    assert sentence.startswith("the journal does not say any more which recording is to go on: ")
