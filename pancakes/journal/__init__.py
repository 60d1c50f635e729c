"""What an agent keeps on disk: its identity, and the durable records of its tasks."""

from pancakes.journal.disk import Disk
from pancakes.journal.file import FileJournal, empty
from pancakes.journal.journal import Journal
from pancakes.journal.memory_journal import MemoryJournal
from pancakes.journal.record_table import RecordTable
from pancakes.journal.seal import JournalEntry, JournalError, JournalLost, SetAside
from pancakes.journal.store import RecordStore, ThreadedStore, VirtualStore

__all__ = [
    "Disk",
    "JournalEntry",
    "FileJournal",
    "Journal",
    "JournalError",
    "JournalLost",
    "MemoryJournal",
    "RecordStore",
    "RecordTable",
    "SetAside",
    "ThreadedStore",
    "VirtualStore",
    "empty",
]
