"""Whether something has happened, for threads that ask and never wait."""

from __future__ import annotations


class Flag:
    """What pykka uses of a `threading.Event`, without the memory for threads that wait."""

    __slots__ = ("_on",)

    def __init__(self) -> None:
        self._on = False

    def is_set(self) -> bool:
        """Returns whether it has happened."""
        return self._on

    def set(self) -> None:
        """Says that it has happened."""
        self._on = True
