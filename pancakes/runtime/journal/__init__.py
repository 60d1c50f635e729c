"""What an agent keeps on disk: its identity, and the durable records of its tasks."""

from pancakes.runtime.journal.disk import Disk
from pancakes.runtime.journal.file import FileJournal, empty
from pancakes.runtime.journal.journal import DiskUse, Journal
from pancakes.runtime.journal.memory_journal import MemoryJournal
from pancakes.runtime.journal.record_table import RecordTable
from pancakes.runtime.journal.seal import JournalEntry, JournalError, JournalLost, SetAside
from pancakes.runtime.journal.store import May, RecordStore, ThreadedStore, VirtualStore

__all__ = [
    "Disk",
    "DiskUse",
    "JournalEntry",
    "FileJournal",
    "Journal",
    "JournalError",
    "JournalLost",
    "May",
    "MemoryJournal",
    "RecordStore",
    "RecordTable",
    "SetAside",
    "ThreadedStore",
    "VirtualStore",
    "empty",
]
