"""What was written down last of a task, so that what has not changed is not written again."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

import msgspec

from pancakes.runtime.foundation import codecs
from pancakes.runtime.foundation.arrays import saved_array
from pancakes.runtime.supervision.task_messages import Carried
from pancakes.task import Nothing, Task


class LastCheckpoint(msgspec.Struct, frozen=True):
    """What was written down of a task last.

    Attributes:
        plain: what it carried, encoded; see `plain_of`.
        made_of: of a task without state its settings and its periods, the very objects; None: it has state.
    """

    plain: bytes
    made_of: tuple[Mapping[str, Any], Mapping[str, float]] | None

    def surely_holds(self, task: Task) -> bool:
        """Returns whether a task's own has surely not changed, without a turn of its: most have no state at all."""
        return self.made_of is not None and task.still_carries(*self.made_of)


def last_checkpoint(task: Task, carried: Carried, plain: bytes) -> LastCheckpoint:
    """Returns what is remembered of a checkpoint.

    Args:
        task: the task.
        carried: what it carries.
        plain: the same, encoded.
    """
    return LastCheckpoint(plain, (carried.settings, carried.periods_s) if type(task).State is Nothing else None)


def plain_of(carried: Carried) -> bytes:
    """Returns what a task carries as bytes, which are the same as long as nothing has changed.

    Raises:
        TypeError, OverflowError: its state cannot be encoded.
    """
    return _ENCODE([carried.settings, carried.state, carried.periods_s, carried.heard])


_ENCODE: Final = codecs.encoder(saved_array)
