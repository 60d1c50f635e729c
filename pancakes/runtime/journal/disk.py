"""What an agent's tables are kept on."""

from __future__ import annotations

from typing import NamedTuple

from pancakes.runtime.journal.journal import Journal
from pancakes.runtime.journal.store import RecordStore


class Disk(NamedTuple):
    """The journal of an agent, for the tables that are kept on it.

    Attributes:
        journal: each table reads its records from it when the table is made, before anything is written.
        store: writes to that journal.
        unread: the agent's list of what was found wrong at the start; each record that cannot be read adds a sentence.
    """

    journal: Journal
    store: RecordStore
    unread: list[str]
