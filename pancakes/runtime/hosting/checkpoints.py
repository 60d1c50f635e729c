"""What was written down last of a task, so that what has not changed is not written again."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import msgspec

from pancakes.errors import MigrationError
from pancakes.mesh.migration.snapshot import why_unwritable
from pancakes.runtime.foundation import codecs
from pancakes.runtime.foundation.arrays import saved_array
from pancakes.runtime.kernel.task_table import SettingsNote
from pancakes.runtime.kernel.task_timer import TaskTimer
from pancakes.runtime.supervision.task_messages import Carried
from pancakes.task import Nothing, Task


class LastCheckpoint(msgspec.Struct, frozen=True):
    """What was written down of a task last.

    Attributes:
        plain: what it carried, encoded; see `plain_of`.
        carried: of a task without state what it carried; None: it has state.
    """

    plain: bytes
    carried: Carried | None

    def surely_holds(self, note: SettingsNote | None, timers: Sequence[TaskTimer]) -> bool:
        """Returns whether what a task carries has surely not changed, without a turn of its: most have no state at all.

        Args:
            note: its settings, as it has entered them.
            timers: its timers.
        """
        carried = self.carried
        return (
            carried is not None
            and note is not None
            and note.plain is carried.settings
            and all(timer.period_s == carried.periods_s.get(timer.method) for timer in timers)
        )


def last_checkpoint(cls: type[Task], carried: Carried, plain: bytes) -> LastCheckpoint:
    """Returns what is remembered of a checkpoint.

    Args:
        cls: the task's class.
        carried: what it carries.
        plain: the same, encoded.
    """
    return LastCheckpoint(plain, carried if cls.State is Nothing else None)


def plain_of(carried: Carried) -> bytes:
    """Returns what a task carries as bytes, which are the same as long as nothing has changed.

    Raises:
        MigrationError: its settings or its state cannot be encoded.
    """
    try:
        return _ENCODE([carried.settings, carried.state, carried.periods_s, carried.heard])
    except codecs.UNENCODABLE as error:
        raise MigrationError(why_unwritable(carried.settings, carried.state, error)) from None


_ENCODE: Final = codecs.encoder(saved_array)
