"""How a task gets leave to start."""

from __future__ import annotations

from enum import Enum


class Leave(Enum):
    """By what a start of a hosted task gets leave."""

    ENTRY = "entry"
    """By a new entry in its record, which says that it runs."""
    WANTED = "wanted"
    """By an entry, also where another task has its actuators just now: it follows once these are free."""
    AGAIN = "again"
    """By an entry that says that it runs again; the actor that ran before is gone."""
    RECOVERED = "recovered"
    """By its record as it was found on disk."""
    GRANTED = "granted"
    """It has leave: its record says that it runs."""
