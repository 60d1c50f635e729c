"""The fences of an agent's actuators: the highest epoch that each has seen of each task, kept on disk.

Without the disk, an agent that is started again would obey a copy of a task that has lost its right long ago.
"""

from __future__ import annotations

from collections.abc import Callable

from pancakes import codecs
from pancakes.journal import Journal, JournalEntry, RecordStore
from pancakes.malformed import MALFORMED, why_malformed
from pancakes.packet import Fence

KIND = "fence"

Epoch = tuple[int, str]

_DECODE: Callable[[bytes], dict[str, Epoch]] = codecs.decoder(dict[str, Epoch])


class Fences:
    """All marks of one agent. An actuator's are asked for and raised by its own task alone, in any thread.

    One journal entry for each actuator holds its marks of all tasks.

    Args:
        journal: read once, here.
        store: what writes to that journal.

    Attributes:
        unread: what the journal has and could not be read, each a sentence.
    """

    def __init__(self, journal: Journal, store: RecordStore) -> None:
        self._store = store
        self.unread: list[str] = []
        self._on_disk: dict[str, dict[str, Epoch]] = {}
        for entry in journal.entries(KIND):
            try:
                self._on_disk[entry.key] = _DECODE(entry.data)
            except MALFORMED as error:
                self.unread.append(
                    f"the journal's fence of the actuator {entry.key} is not used: {why_malformed(error)}"
                )
        self._seen = {actuator: dict(marks) for actuator, marks in self._on_disk.items()}

    def highest(self, actuator: str, task_id: str) -> Epoch | None:
        """Returns the highest epoch that the actuator has seen of a task, on disk or about to be; None: none."""
        return self._seen.get(actuator, {}).get(task_id)

    def holds(self, actuator: str, fence: Fence) -> bool:
        """Returns whether a command under `fence` may be obeyed: its epoch is on disk, and none higher."""
        return self._on_disk.get(actuator, {}).get(fence.task_id) == tuple(fence.epoch)

    def put_up(self, actuator: str, fence: Fence, then: Callable[[], None], failed: Callable[[str], None]) -> None:
        """Begins to write down that the actuator has seen an epoch, which is not lower than the highest. Never waits.

        Args:
            actuator: the actuator's name.
            fence: the task and its epoch.
            then: called, in the store's thread, when it is on disk for good.
            failed: called instead, with the reason, where it could not be written.
        """
        seen = self._seen.setdefault(actuator, {})
        seen[fence.task_id] = (fence.epoch[0], fence.epoch[1])
        marks = dict(seen)

        def written() -> None:
            self._on_disk[actuator] = marks
            then()

        self._store.persist(JournalEntry(KIND, actuator, codecs.encode_small(marks)), written, failed)
