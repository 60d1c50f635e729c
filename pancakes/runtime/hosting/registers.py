"""What an agent has on disk as a guardian of tasks."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final

import msgspec

from pancakes.mesh.guarding.guardian_core import GuardRegister
from pancakes.mesh.migration.record import TaskId
from pancakes.runtime.foundation import codecs
from pancakes.runtime.journal import Disk, RecordTable
from pancakes.runtime.kernel.reference import Reference
from pancakes.runtime.kernel.tell import tell

KIND: Final = "guard"


class RegisterWritten(msgspec.Struct, frozen=True):
    """`Registers` tells the guardian that one is on disk for good, or could not be written.

    Attributes:
        task_id: the task.
        why_not: why it could not be written; empty: it is on disk.
    """

    task_id: TaskId
    why_not: str = ""


class Registers:
    """The registers of one guardian. Any thread; of one task, one thread at a time writes.

    A guardian that has lost a register has forgotten its pledge, so it is no guardian of that task any more.

    Args:
        disk: what they are kept on.
    """

    def __init__(self, disk: Disk) -> None:
        self._lost = {aside.key: str(aside) for aside in disk.journal.missing if aside.kind == KIND}

        def malformed(key: str, why: str) -> None:
            self._lost[key] = f"the journal has it, and it cannot be read: {why}"

        self._table = RecordTable(disk, KIND, codecs.decoder(GuardRegister), malformed)

    def all(self) -> Iterable[GuardRegister]:
        """Returns those that are on disk."""
        return list(self._table.on_disk.values())

    def get(self, task_id: TaskId) -> GuardRegister | None:
        """Returns the register of a task that is on disk; None: there is none."""
        return self._table.on_disk.get(str(task_id))

    def lost(self) -> dict[str, str]:
        """Returns what became of those that are lost, by task."""
        return dict(self._lost)

    def write(self, register: GuardRegister, guardian: Reference) -> None:
        """Begins to write a register, and tells the guardian `RegisterWritten`. Never waits."""
        task_id = register.task_id

        def written() -> None:
            tell(guardian, RegisterWritten(task_id))

        def failed(why_not: str) -> None:
            tell(guardian, RegisterWritten(task_id, why_not))

        self._table.write(str(task_id), register, written, failed)
