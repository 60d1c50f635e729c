"""The checkpoints of a task that agents besides its owner hold: it can go on from them once that is lost. Pure."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any, Final

from pancakes.control import Checkpoints
from pancakes.errors import MigrationError
from pancakes.mesh.guarding.guardian_core import GuardRegister
from pancakes.mesh.migration.epoch import Epoch
from pancakes.mesh.migration.record import Phase, Record, TaskId
from pancakes.mesh.migration.snapshot import Snapshot

GUARDIAN: Final = "guardian"
IN_DOUBT: Final = "in doubt"
_KEPT: Final = (Phase.COMMITTED, Phase.PREPARED)


def is_meant(asked: Checkpoints, task_id: TaskId) -> bool:
    """Returns whether a task is asked for."""
    return asked.task in ("", task_id.name) and asked.birthplace in ("", task_id.birthplace)


def of_register(register: GuardRegister, age_s: float, at_least: bool, asked: Checkpoints) -> Iterator[dict[str, Any]]:
    """Yields what a guardian holds of a task, as plain values: one row, or none.

    Args:
        register: what it has on disk.
        age_s: how long ago the task was known to be as the checkpoint says, in host seconds.
        at_least: whether that may be longer ago.
        asked: what is asked for.
    """
    if register.body is None:
        return
    checkpoint = register.checkpoint
    row = _row(register.task_id, register.body.snapshot, checkpoint.epoch, checkpoint.no, asked)
    known = {"held": GUARDIAN, "wanted": register.body.wanted.value, "age_s": age_s, "at_least": at_least}
    sets = [[member.agent for member in members] for members in register.guards.sets]
    seen = max(register.promised, checkpoint.epoch).n
    yield from ({**it, **known, "seen": seen, "guardians": sets, "peer": ""} for it in row)


def of_records(records: Iterable[Record], asked: Checkpoints) -> Iterator[dict[str, Any]]:
    """Yields what an agent holds of tasks whose hand-off is in doubt, as plain values.

    Nothing of such a task is newer than its snapshot, but what it has done on the other agent since.
    """
    for record in records:
        if record.phase not in _KEPT or not is_meant(asked, record.task_id):
            continue
        known = {"held": IN_DOUBT, "wanted": record.wanted.value, "age_s": None, "at_least": True}
        row = _row(record.task_id, record.snapshot, record.offer, 0, asked)
        seen = max(record.seen, record.offer).n
        yield from ({**it, **known, "seen": seen, "guardians": [], "peer": record.peer} for it in row)


def _row(task_id: TaskId, encoded: bytes, epoch: Epoch, no: int, asked: Checkpoints) -> Iterator[dict[str, Any]]:
    try:
        snapshot = Snapshot.decode(encoded)
    except MigrationError:  # what cannot be read is of no use
        return
    row = {"task_id": str(task_id), "type": snapshot.type, "service": snapshot.service}
    body = {"snapshot": encoded} if asked.body else {}
    yield {**row, "epoch": [epoch.n, epoch.minter], "no": no, **body}
