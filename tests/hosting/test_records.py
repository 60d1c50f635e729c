"""What the records know of a disk, also of one that is a copy: under which epochs its original owned tasks."""

from __future__ import annotations

import threading
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any, cast

from pancakes.durable.record import NO_EPOCH, Epoch, Phase, Record, TaskId
from pancakes.durable.store import Records
from pancakes.journal import Disk, MemoryJournal, VirtualStore
from pancakes.journal.journal import MARK

TASK = TaskId("a", "Count")
OLD, NEW = Epoch(3, "a"), Epoch(4, "a")
ENDED = threading.Event()
ENDED.set()
SERVICE = cast(Any, SimpleNamespace(name="client", actor_stopped=ENDED))
"""A service that has ended, so it is told of nothing."""


def opened(disk: dict[str, bytes], life: str) -> tuple[Records, Callable[[Record], None]]:
    """Opens the records on a disk; returns them, and what writes one at once."""
    disk.pop("lock", None)
    pending: list[Callable[[], object]] = []
    journal = MemoryJournal(disk, life)
    records = Records(Disk(journal, VirtualStore(journal, lambda delay_s, write: pending.append(write)), []))

    def write(record: Record) -> None:
        records.persist(record, SERVICE)
        while pending:
            pending.pop()()

    return records, write


def test_an_epoch_of_the_original_stays_one_whatever_is_written_until_another_begins() -> None:
    disk: dict[str, bytes] = {}
    records, write = opened(disk, "first")
    write(Record(TASK, Phase.OWNER, OLD, OLD))
    assert records.original_epoch(TASK) == NO_EPOCH
    del disk[MARK]
    records, write = opened(disk, "copy")
    assert records.original_epoch(TASK) == OLD
    write(Record(TASK, Phase.OWNER, OLD, OLD, no=7))
    assert records.original_epoch(TASK) == OLD
    records, write = opened(disk, "copy, again")
    assert records.original_epoch(TASK) == OLD
    write(Record(TASK, Phase.OWNER, NEW, NEW))
    assert records.original_epoch(TASK) == NO_EPOCH
    records, _ = opened(disk, "copy, once more")
    assert records.original_epoch(TASK) == NO_EPOCH


def test_the_task_of_a_name_that_is_here_is_known_after_a_restart_too() -> None:
    disk: dict[str, bytes] = {}
    records, write = opened(disk, "first")
    write(Record(TaskId("b", "Count"), Phase.RELEASED, NO_EPOCH, OLD, peer="b"))
    write(Record(TASK, Phase.OWNER, OLD, OLD))
    assert (records.here("Count"), records.here("Other")) == (TASK, None)
    records, _ = opened(disk, "second")
    assert (records.here("Count"), records.here("Other")) == (TASK, None)
