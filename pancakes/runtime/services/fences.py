"""The fences of an agent's actuators: the highest epoch that each has seen of each task, kept on disk.

Without the disk, an agent that is started again would obey a copy of a task that has lost its right long ago.
"""

from __future__ import annotations

from collections.abc import Callable

from pancakes.packet import Fence
from pancakes.runtime.foundation import codecs
from pancakes.runtime.journal import Disk, RecordTable

KIND = "fence"

Epoch = tuple[int, str]


class Fences:
    """All marks of one agent. An actuator's are asked for and raised by its own task alone, in any thread.

    One journal entry for each actuator holds its marks of all tasks.

    Args:
        disk: what they are kept on.
    """

    def __init__(self, disk: Disk) -> None:
        def malformed(actuator: str, why: str) -> None:
            disk.unread.append(f"the journal's fence of the actuator {actuator} is not used: {why}")

        self._marks = RecordTable(disk, KIND, codecs.decoder(dict[str, Epoch]), malformed)

    def highest(self, actuator: str, task_id: str) -> Epoch | None:
        """Returns the highest epoch that the actuator has seen of a task, on disk or about to be; None: none."""
        return self._marks.newest.get(actuator, {}).get(task_id)

    def holds(self, actuator: str, fence: Fence) -> bool:
        """Returns whether a command under `fence` may be obeyed: its epoch is on disk, and none higher."""
        return self._marks.on_disk.get(actuator, {}).get(fence.task_id) == tuple(fence.epoch)

    def put_up(self, actuator: str, fence: Fence, then: Callable[[], None], failed: Callable[[str], None]) -> None:
        """Begins to write down that the actuator has seen an epoch, which is not lower than the highest. Never waits.

        Args:
            actuator: the actuator's name.
            fence: the task and its epoch.
            then: called, in the store's thread, when it is on disk for good.
            failed: called instead, with the reason, where it could not be written.
        """
        marks = dict(self._marks.newest.get(actuator, {}))
        marks[fence.task_id] = (fence.epoch[0], fence.epoch[1])
        self._marks.write(actuator, marks, then, failed)
