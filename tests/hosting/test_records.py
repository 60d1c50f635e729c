"""What the records of an agent know of its disk."""

from __future__ import annotations

import threading
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any, cast

from pancakes.durable.record import Record, TaskId
from pancakes.durable.register import Epoch, Identity, Register, Standing
from pancakes.durable.store import Records
from pancakes.journal import Disk, MemoryJournal, VirtualStore

A, B = Identity("a", "first"), Identity("b")
TASK = TaskId("a", "Count")
OWNED = Record(TASK, Register(Epoch(3, A), 0, ((A,),), state=b"s", promised=Epoch(3, A)), A, service="client")
LEFT = Record(TaskId("b", "Count"), Register(Epoch(4, B), -1, ((B,),)), A)
ENDED = threading.Event()
ENDED.set()
WRITER = cast(Any, SimpleNamespace(name="Registrar", actor_stopped=ENDED))
"""An actor that has ended, so it is told of nothing."""


def opened(disk: dict[str, bytes], me: Identity) -> tuple[Records, Callable[[Record], None]]:
    """Open the records on a disk; return them, and what writes one at once."""
    disk.pop("lock", None)
    pending: list[Callable[[], object]] = []
    journal = MemoryJournal(disk, me.journal)
    records = Records(Disk(journal, VirtualStore(journal, lambda delay_s, write: pending.append(write)), []), me, {})

    def write(record: Record) -> None:
        records.write(record, WRITER)
        while pending:
            pending.pop()()

    return records, write


def test_agent_with_another_identity_owns_nothing_of_its_former_self() -> None:
    disk: dict[str, bytes] = {}
    records, write = opened(disk, A)
    write(OWNED)
    assert records.get(TASK) == OWNED and OWNED.standing is Standing.OWNER
    copy = A._replace(copy="1")
    records, _ = opened(disk, copy)
    record = records.get(TASK)
    assert record is not None and record.me == copy
    assert (record.standing, record.was_ours, record.snapshot) == (Standing.RELEASED, True, b"s")


def test_task_of_a_name_that_is_here_is_known_after_a_restart_too() -> None:
    disk: dict[str, bytes] = {}
    records, write = opened(disk, A)
    write(LEFT)
    write(OWNED)
    assert (records.here("Count"), records.here("Other")) == (TASK, None)
    records, _ = opened(disk, A)
    assert (records.here("Count"), records.here("Other")) == (TASK, None)
    assert records.service_of(TASK) == "client"
