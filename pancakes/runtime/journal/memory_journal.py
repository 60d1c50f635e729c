"""A journal in memory: for virtual time and tests. The delay that a disk has is its store's matter."""

from __future__ import annotations

from typing import Final

from pancakes.runtime.journal.journal import Journal
from pancakes.runtime.journal.seal import JournalError

MARK: Final = "mark"
"""Under this name a disk has what no copy of it has that is made a file at a time: leave it out there."""


class MemoryJournal(Journal):
    """A journal whose disk is a dictionary: it survives the agent that dies, if the dictionary is kept.

    Args:
        disk: what is stored, by name. An empty one is a new disk.
        new_uuid: the id that a new journal gets; in virtual time it comes from the seed.
        agent: the name of the agent that opens it.

    Attributes:
        fault: why nothing can be written; empty: everything can.
        latency_s: how long a write takes in virtual time.
    """

    place = "memory"
    fault: str = ""
    latency_s: float = 0.002

    def __init__(self, disk: dict[str, bytes], new_uuid: str, agent: str = "") -> None:
        self._disk = disk
        if "lock" in disk:
            raise JournalError("the journal is in use already: two agents cannot share one")
        disk["lock"] = b""
        self._closed = False
        self._open(lambda: new_uuid, agent)

    def close(self) -> None:
        if not self._closed:
            self._closed = True
            self._disk.pop("lock", None)

    def _mark(self) -> str:
        return self._disk.setdefault(MARK, self.life.encode()).decode()

    def _names(self, ending: str) -> list[str]:
        return sorted(name for name in self._disk if name.endswith(ending))

    def _place(self, name: str) -> str:
        return name

    def _load(self, name: str) -> bytes:
        return self._disk[name]

    def _replace(self, contents: dict[str, bytes]) -> None:
        if self._closed:
            raise JournalError("the journal is closed")
        if self.fault:
            raise JournalError(self.fault)
        self._disk.update(contents)

    def _rename(self, name: str, new: str) -> None:
        self._disk[new] = self._disk.pop(name)
