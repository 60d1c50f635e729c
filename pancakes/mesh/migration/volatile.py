"""What an agent knows about a task only until it crashes."""

from __future__ import annotations

import msgspec

from pancakes.mesh.migration.record import Record


class Volatile(msgspec.Struct, frozen=True):
    """The part of a hand-off that a crash may forget.

    Attributes:
        running: the task's actor is at work here.
        asked: the neighbour that was asked for a reservation; empty where none is.
        freezing: the task is being stopped for that neighbour; its snapshot is to come.
        again: what was decided last, could not be written, and will be tried again; None: all that was decided is
            written, or being written.
        fresh: of a task that has not begun under its epoch: it goes on exactly where it stood still on its former host.
    """

    running: bool = False
    asked: str = ""
    freezing: bool = False
    again: Record | None = None
    fresh: bool = False
