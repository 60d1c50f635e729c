"""What a mission leaves behind, read back: the world's own truth, and the events that the agents told."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, TextIO, TypeVar

from pancakes.errors import PancakesError

_T = TypeVar("_T")


class Row(NamedTuple):
    """Where one body was at one moment: a row of `trajectory.csv`."""

    t_s: float
    x_m: float
    y_m: float
    theta_rad: float
    v_mps: float
    omega_radps: float
    battery_v: float | None
    driven_by: str


@dataclass(frozen=True, slots=True)
class Occurrence:
    """Something that an agent said has happened: a line of `events.jsonl`.

    Attributes:
        t_s: mission time.
        agent: who said so.
        kind: what happened.
        fields: the rest of the line.
    """

    t_s: float
    agent: str
    kind: str
    fields: Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class Record:
    """A whole mission.

    Attributes:
        paths: the rows of each body, in the order of time.
        events: the events, in the order of time.
    """

    paths: Mapping[str, list[Row]]
    events: list[Occurrence]

    def running_at_first(self, task: str) -> list[str]:
        """Returns the agents that ran a task already when the mission began: so the launcher's `roster` says."""
        return [event.agent for event in self.told("roster") if task in event.fields.get("tasks", ())]

    def told(self, kind: str, agent: str = "", task: str = "") -> Iterator[Occurrence]:
        """Yields the events of a kind, of one agent and about one task where these are given."""
        for event in self.events:
            if event.kind == kind and agent in ("", event.agent) and task in ("", event.fields.get("task")):
                yield event


def read_record(out_dir: Path) -> Record:
    """Reads `trajectory.csv` and `events.jsonl` of a mission.

    Raises:
        PancakesError: one of them is missing, or is not what it should be; it names the line.
    """
    return Record(_read_paths(out_dir / "trajectory.csv"), _read_events(out_dir / "events.jsonl"))


def _read_paths(path: Path) -> dict[str, list[Row]]:
    paths: dict[str, list[Row]] = {}
    for number, cells in _lines(path, csv.DictReader):
        try:
            battery = cells["battery_v"]
            row = Row(
                float(cells["t_s"]),
                float(cells["x_m"]),
                float(cells["y_m"]),
                float(cells["theta_rad"]),
                float(cells["v_mps"]),
                float(cells["omega_radps"]),
                float(battery) if battery else None,
                cells["driven_by"] or "",
            )
            paths.setdefault(cells["name"], []).append(row)
        except (KeyError, TypeError, ValueError) as error:
            raise PancakesError(f"{path}: row {number} is no row of a trajectory: {error}") from None
    return paths


def _read_events(path: Path) -> list[Occurrence]:
    events = []
    for number, text in _lines(path, iter):
        try:
            fields = json.loads(text)
            event = Occurrence(float(fields.pop("t_s")), str(fields.pop("agent")), str(fields.pop("kind")), fields)
            events.append(event)
        except (AttributeError, KeyError, TypeError, ValueError) as error:
            raise PancakesError(f"{path}: line {number} is no event: {error}") from None
    return sorted(events, key=lambda event: event.t_s)


def _lines(path: Path, split: Callable[[TextIO], Iterable[_T]]) -> Iterator[tuple[int, _T]]:
    try:
        with path.open(encoding="utf-8", newline="") as file:
            yield from enumerate(split(file), start=1)
    except OSError as error:
        raise PancakesError(f"the mission's {path.name} cannot be read: {error.strerror}") from None
