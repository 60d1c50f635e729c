"""What an agent knows about a task only until it crashes."""

from __future__ import annotations

import msgspec


class Volatile(msgspec.Struct, frozen=True):
    """The part of a hand-off that a crash may forget.

    Attributes:
        running: the task's actor is at work here.
        asked: the neighbour that was asked for a reservation; empty where none is.
        freezing: the task is being stopped for that neighbour; its snapshot is to come.
    """

    running: bool = False
    asked: str = ""
    freezing: bool = False
