"""The journal: what an agent keeps on disk, its identity and the durable records of its tasks."""

from pancakes.journal.file_journal import FileJournal, empty
from pancakes.journal.journal import (
    DiskUse,
    Journal,
    JournalEntry,
    JournalError,
    JournalLostError,
    MemoryJournal,
    SetAside,
)
from pancakes.journal.record_table import Disk, RecordTable
from pancakes.journal.store import May, RecordStore, ThreadedStore, VirtualStore

__all__ = [
    "Disk",
    "DiskUse",
    "FileJournal",
    "Journal",
    "JournalEntry",
    "JournalError",
    "JournalLostError",
    "May",
    "MemoryJournal",
    "RecordStore",
    "RecordTable",
    "SetAside",
    "ThreadedStore",
    "VirtualStore",
    "empty",
]
