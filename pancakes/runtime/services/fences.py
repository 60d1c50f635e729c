"""The fences of an agent's actuators: the highest epoch that each has seen of each task, kept on disk.

Without the disk, an agent that is started again would obey a copy of a task that has lost its right long ago.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

from pancakes.packet import Fence
from pancakes.runtime.foundation import codecs
from pancakes.runtime.journal import Disk, RecordTable
from pancakes.runtime.services.fence_rule import Mark

KIND = "fence"


class Fences:
    """All marks of one agent. An actuator's are asked for and written by its own task alone, in any thread.

    One journal entry for each actuator holds its marks of all tasks.

    Args:
        disk: what they are kept on.
    """

    def __init__(self, disk: Disk) -> None:
        def malformed(actuator: str, why: str) -> None:
            disk.unread.append(f"the journal's fence of the actuator {actuator} is not used: {why}")

        self._marks = RecordTable(disk, KIND, codecs.decoder(dict[str, Mark]), malformed)

    def of(self, actuator: str) -> Mapping[str, Mark]:
        """Returns what an actuator has seen, by task, on disk or about to be."""
        return self._marks.newest.get(actuator, {})

    def highest(self, actuator: str, task_id: str) -> Mark | None:
        """Returns the highest epoch that the actuator has seen of a task, on disk or about to be; None: none."""
        return self.of(actuator).get(task_id)

    def obeys(self, actuator: str, fence: Fence) -> bool:
        """Returns whether a command under `fence` may be obeyed: its epoch is on disk, and none higher."""
        mark = self._marks.on_disk.get(actuator, {}).get(fence.task_id)
        return mark is not None and (mark.n, mark.minter) == tuple(fence.epoch)

    def write(
        self, actuator: str, task_id: str, mark: Mark, then: Callable[[], None], failed: Callable[[str], None]
    ) -> None:
        """Begins to write down what an actuator has seen of a task. Never waits.

        Args:
            actuator: the actuator's name.
            task_id: the task.
            mark: what it has seen.
            then: called, in the store's thread, when it is on disk for good.
            failed: called instead, with the reason, where it could not be written.
        """
        self._marks.write(actuator, {**self.of(actuator), task_id: mark}, then, failed)
