"""Read the files of a mission in a sensor field: the truth about each node, and the events of the agents."""

from __future__ import annotations

import csv
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from pancakes import PancakesError
from pancakes.tools.demo.mission_record import MissionRecord, read_events, read_lines

Table = Mapping[str, Any]


class Row(NamedTuple):
    """The state of one node at one moment: a row of `field.csv`. The last four are None without a battery."""

    t_s: float
    celsius: float
    moving: bool
    level: float | None
    listening: bool | None
    spent_j: float | None
    sending_j: float | None


@dataclass(frozen=True, slots=True, kw_only=True)
class Record(MissionRecord):
    """A whole mission.

    Attributes:
        nodes: the rows of each node, in the order of time.
    """

    nodes: Mapping[str, list[Row]]


def read_record(out_dir: Path) -> Record:
    """Read `field.csv` and `events.jsonl` of a mission.

    Raises:
        PancakesError: one of them is missing, or is not valid; the message names the line.
    """
    path = out_dir / "field.csv"
    nodes: dict[str, list[Row]] = {}
    for number, cells in read_lines(path, csv.DictReader):
        try:
            nodes.setdefault(cells["node"], []).append(_row(cells))
        except (KeyError, TypeError, ValueError) as error:
            raise PancakesError(f"{path}: row {number} is not a row of a field: {error}") from None
    return Record(nodes=nodes, events=read_events(out_dir))


def _row(cells: Mapping[str, str]) -> Row:
    counts = bool(cells["level"])
    spent = [float(cells[f"{cause}_j"]) for cause in ("idle", "sensing", "listening", "sending")] if counts else []
    return Row(
        float(cells["t_s"]),
        float(cells["celsius"]),
        cells["moving"] == "1",
        float(cells["level"]) if counts else None,
        cells["radio"] == "1" if counts else None,
        sum(spent) if counts else None,
        spent[-1] if counts else None,
    )


def find_task(configs: Mapping[str, Table], kind: str) -> tuple[str, str, Table]:
    """Return the first task of a type: its agent, its name, and its table.

    Args:
        configs: the agents' configurations, by the agent's name (`pancakes.tools.demo.Run.configs`).
        kind: the type.

    Raises:
        PancakesError: no agent has one.
    """
    for agent, config in configs.items():
        for name, task in config.get("tasks", {}).items():
            if task.get("type") == kind:
                return agent, name, task
    raise PancakesError(f"none of the agents {', '.join(configs)} has a task of the type {kind!r}")
