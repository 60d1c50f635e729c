"""Read the files of a mission: the truth of the world, and the events of the agents."""

from __future__ import annotations

import csv
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from pancakes import PancakesError
from pancakes.tools.demo.mission_record import MissionRecord, read_events, read_lines


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


@dataclass(frozen=True, slots=True, kw_only=True)
class Record(MissionRecord):
    """A whole mission.

    Attributes:
        paths: the rows of each body, in the order of time.
    """

    paths: Mapping[str, list[Row]]


def read_record(out_dir: Path) -> Record:
    """Read `trajectory.csv` and `events.jsonl` of a mission.

    Raises:
        PancakesError: one of them is missing, or is not valid; the message names the line.
    """
    return Record(paths=_read_paths(out_dir / "trajectory.csv"), events=read_events(out_dir))


def _read_paths(path: Path) -> dict[str, list[Row]]:
    paths: dict[str, list[Row]] = {}
    for number, cells in read_lines(path, csv.DictReader):
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
            raise PancakesError(f"{path}: row {number} is not a row of a trajectory: {error}") from None
    return paths
