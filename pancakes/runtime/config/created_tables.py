"""The tasks that were created on an agent, as tables that its configuration could have."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from pancakes.errors import MigrationError
from pancakes.mesh.migration.record import Phase, Record, Wanted
from pancakes.mesh.migration.snapshot import Snapshot
from pancakes.runtime.foundation.arrays import without_arrays


def created_tables(agent: str, records: Iterable[Record]) -> dict[str, dict[str, Any]]:
    """Returns the tables `[task.NAME]` of the tasks that were born on an agent and are there, by name.

    Those that its file names are among them where there are records of them.

    Args:
        agent: the agent's name.
        records: its records.
    """
    tables: dict[str, dict[str, Any]] = {}
    for record in sorted(records, key=lambda it: it.task_id):
        here = record.phase in (Phase.OWNER, Phase.FROZEN) and record.task_id.birthplace == agent
        if here and record.snapshot:
            try:
                snapshot = Snapshot.decode(record.snapshot)
            except MigrationError:
                continue  # its service has said so
            tables[record.task_id.name] = table_of(snapshot, record.wanted is Wanted.RUNNING)
    return tables


def table_of(snapshot: Snapshot, start: bool) -> dict[str, Any]:
    """Returns the table `[task.NAME]` of a task as it is; `start`: whether it is to run from the start.

    Its settings are those that it has now, and so is its rate. What has no value is None.
    """
    guard: Mapping[str, Any] = snapshot.guard or {"guard": 0}
    return {
        "type": snapshot.type,
        "service": snapshot.service,
        "start": start,
        "rate_hz": _rate_hz(snapshot),
        "settings": without_arrays(snapshot.settings),
        "restart": dict(snapshot.restart),
        "durability": snapshot.durability,
        "migrate": snapshot.migrate,
        **guard,
    }


def _rate_hz(snapshot: Snapshot) -> float | None:
    """Returns the rate of its first timer; None: as its class says."""
    period_s = next(iter(snapshot.periods_s.values()), None)
    if period_s is None or not period_s > 0.0:
        return snapshot.rate_hz
    return round(1.0 / period_s, 9)
