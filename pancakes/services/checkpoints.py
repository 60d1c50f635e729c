"""What was written down last of each task, so that what has not changed is not written again."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

import msgspec

from pancakes import codecs
from pancakes.arrays import saved_array
from pancakes.migration.record import TaskId
from pancakes.task import Nothing, Task
from pancakes.task_messages import Carried


class _Written(msgspec.Struct):
    """What was written down of a task last.

    Attributes:
        plain: what it carried, encoded.
        made_of: of a task without state its settings and its periods, the very objects; None: it has state.
    """

    plain: bytes
    made_of: tuple[Mapping[str, Any], Mapping[str, float]] | None


class Checkpoints:
    """Remembers the last checkpoint of each task. Pure."""

    def __init__(self) -> None:
        self._written: dict[TaskId, _Written] = {}

    def surely_hold(self, task_id: TaskId, task: Task) -> bool:
        """Returns whether a task's own has surely not changed, without a turn of its: most have no state at all."""
        written = self._written.get(task_id)
        return written is not None and written.made_of is not None and task.still_carries(*written.made_of)

    def hold(self, task_id: TaskId, plain: bytes) -> bool:
        """Returns whether this is what was written last; see `plain_of`."""
        written = self._written.get(task_id)
        return written is not None and written.plain == plain

    def take(self, task_id: TaskId, task: Task, carried: Carried, plain: bytes) -> None:
        """Learns that this is being written."""
        made_of = (carried.settings, carried.periods_s) if type(task).State is Nothing else None
        self._written[task_id] = _Written(plain, made_of)

    def forget(self, task_id: TaskId) -> None:
        """Forgets a task; its next checkpoint is written in any case."""
        self._written.pop(task_id, None)


def plain_of(carried: Carried) -> bytes:
    """Returns what a task carries as bytes, which are the same as long as nothing has changed.

    Raises:
        TypeError, OverflowError: its state cannot be encoded.
    """
    return _ENCODE([carried.settings, carried.state, carried.periods_s, carried.heard])


_ENCODE: Final = codecs.encoder(saved_array)
