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


class _OnDisk(msgspec.Struct, frozen=True):
    register: GuardRegister
    copy: str


class Registers:
    """The registers of one guardian. Any thread; of one task, one thread at a time writes.

    A guardian that has lost a register has forgotten its pledge, so it is no guardian of that task any more. One whose
    journal is a copy has none: what it has promised since is not in them.

    Args:
        disk: what they are kept on.
    """

    def __init__(self, disk: Disk) -> None:
        self._lost = {aside.key: str(aside) for aside in disk.journal.missing if aside.kind == KIND}
        self._copy, self._copied = disk.journal.copy, disk.journal.copied

        def malformed(key: str, why: str) -> None:
            self._lost[key] = f"the journal has it, and it cannot be read: {why}"

        self._table = RecordTable(disk, KIND, codecs.decoder(_OnDisk), malformed)

    def all(self) -> Iterable[GuardRegister]:
        """Returns those that are on disk."""
        return [it.register for it in list(self._table.on_disk.values()) if it.copy == self._copy]

    def of_original(self) -> list[TaskId]:
        """Returns the tasks that the original guards, at the first start of a copy."""
        found = list(self._table.on_disk.values()) if self._copied else []
        return [it.register.task_id for it in found if it.copy != self._copy]

    def get(self, task_id: TaskId) -> GuardRegister | None:
        """Returns the register of a task that is on disk; None: there is none."""
        found = self._table.on_disk.get(str(task_id))
        return found.register if found is not None and found.copy == self._copy else None

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

        self._table.write(str(task_id), _OnDisk(register, self._copy), written, failed)
