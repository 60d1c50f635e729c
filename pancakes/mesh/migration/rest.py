"""Why a task does not run on an agent that knows it: it moved away, it was stopped, or it failed. Pure."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Final

from pancakes.mesh.migration.epoch import NO_EPOCH
from pancakes.mesh.migration.record import Phase, Record, TaskId, Wanted

WAITS: Final = "waits → "
"""Why a task is not born yet: it waits for what the agents named after this know of it."""
DISK_LOST: Final = "disk lost"
"""Why a task is not born: other agents know of it, so it was born before, and the disk of its birthplace was lost."""
OLD_COPY: Final = "old copy"
"""Why a task stands still: the disk of its agent is an old copy, and it may be elsewhere by now."""


def rest_of(record: Record, otherwise: str = "") -> str:
    """Returns in a word why a task does not run here; `otherwise` where its record does not speak against it."""
    if record.removed:
        return otherwise
    if record.phase in (Phase.COMMITTED, Phase.RELEASED):
        return f"moved → {record.peer}"
    if record.phase is Phase.ABSENT and record.seen != NO_EPOCH:
        return f"moved → {record.peer}" if record.peer else "forgotten"
    if record.phase is Phase.OWNER and record.wanted is not Wanted.RUNNING:
        return record.wanted.value
    return otherwise


def resting(agent: str, tasks: Iterable[str], records: Mapping[TaskId, Record]) -> dict[str, str]:
    """Returns which of an agent's tasks will not start because of their records, and why in a word.

    Args:
        agent: the agent's name.
        tasks: the names of the tasks that its configuration starts.
        records: its records as they are on disk, before anything starts.
    """
    here = {task_id.name: record for task_id, record in records.items() if record.here}
    known = {name: here.get(name) or records.get(TaskId(agent, name)) for name in tasks}
    words = {name: rest_of(record) for name, record in known.items() if record is not None}
    return {name: word for name, word in words.items() if word}
