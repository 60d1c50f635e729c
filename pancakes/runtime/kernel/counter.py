"""A number that several threads may count up without a lock."""

from __future__ import annotations

from itertools import count


class Counter:
    """Counts up, atomically under the interpreter lock.

    Args:
        start: the first number handed out.

    Attributes:
        numbers: the numbers to come; `next` takes one. Any thread.
        take: returns the next number. Any thread.
    """

    __slots__ = ("numbers", "take")

    def __init__(self, start: int = 0) -> None:
        self.numbers = count(start)
        self.take = self.numbers.__next__

    @property
    def value(self) -> int:
        """The number that will be handed out next."""
        # A count cannot be read without moving it, but it says where it stands: "count(7)".
        return int(repr(self.numbers)[6:-1])
