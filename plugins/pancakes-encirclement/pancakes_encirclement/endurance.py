"""How long a robot lasted, what its battery gave for what, and how well it kept to its circle meanwhile."""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

from pancakes import PancakesError
from pancakes.tools.demo import Run
from pancakes.tools.demo.mission_record import read_lines
from pancakes_encirclement.record import Record, Row, read_record
from pancakes_encirclement.scenario import Scenario, read_scenario

KINDS: Final = ("motion", "sensing", "listening", "sending", "idle")
"""What a battery gives energy for; as in `consumption.csv`."""
SETTLING_S: Final = 30.0
"""The distance from the circle counts from this long after the robot first came to it."""
ARRIVED_SHARE: Final = 0.1
"""The robot has reached the circle if it is this near to it, as a share of its radius."""


@dataclass(frozen=True, slots=True)
class Drain:
    """The energy that a battery has given so far, by kind, in joules."""

    t_s: float
    energy_j: Mapping[str, float]


@dataclass(frozen=True, slots=True)
class Endurance:
    """One run of the mission.

    Attributes:
        lasted_s: when the battery was empty or the mission ended.
        empty: whether the battery was empty.
        levels: (time, level of the battery from 0 to 1).
        off_m: (time, distance from the circle round the target's true position), while it lasted, from `settled_s` on.
        laps: how often the robot went round the target, while it lasted.
        drains: the energy that the battery gave.
    """

    lasted_s: float
    empty: bool
    levels: Sequence[tuple[float, float]]
    off_m: Sequence[tuple[float, float]]
    laps: float
    drains: Sequence[Drain]

    def mean_power_w(self) -> dict[str, float]:
        """Return the mean power while it lasted, by kind."""
        until = [drain for drain in self.drains if drain.t_s <= self.lasted_s]
        if not until or until[-1].t_s <= 0.0:
            return dict.fromkeys(KINDS, 0.0)
        return {kind: until[-1].energy_j[kind] / until[-1].t_s for kind in KINDS}

    def powers_w(self, over_s: float) -> list[tuple[float, float]]:
        """Return (time, mean power of the last `over_s`), while it lasted."""
        points = []
        start = 0
        for drain in self.drains:
            while drain.t_s - self.drains[start].t_s > over_s:
                start += 1
            first = self.drains[start]
            if drain.t_s - first.t_s >= 0.5 * over_s and drain.t_s <= self.lasted_s:
                spent_j = sum(drain.energy_j.values()) - sum(first.energy_j.values())
                points.append((drain.t_s, spent_j / (drain.t_s - first.t_s)))
        return points


def read_endurance(run: Run) -> Endurance:
    """Read the endurance from the files of a mission.

    Raises:
        PancakesError: its files or its configurations cannot be read.
    """
    record, scenario = read_record(run.out), read_scenario(run.configs)
    robot = scenario.first
    if not scenario.movers or robot not in scenario.battery_v:
        raise PancakesError("the energy demo needs a robot in its world, and a person that walks there")
    drains = [drain for name, drain in _drains(run.out / "consumption.csv") if name == robot]
    return endurance(record, scenario, robot, drains, run.ended_s)


def endurance(record: Record, scenario: Scenario, robot: str, drains: Sequence[Drain], ended_s: float) -> Endurance:
    """Compute the endurance; see `read_endurance`."""
    path = record.paths.get(robot, [])
    full_v, empty_v = scenario.battery_v[robot]
    levels = [(row.t_s, (row.battery_v - empty_v) / (full_v - empty_v)) for row in path if row.battery_v is not None]
    # The file has four decimals of a volt.
    emptied_s = next((t_s for t_s, level in levels if level * (full_v - empty_v) < 1e-4), None)
    lasted_s = emptied_s if emptied_s is not None else ended_s
    target = {row.t_s: row for row in record.paths.get(scenario.movers[0], ())}
    pairs = [(row, target[row.t_s]) for row in path if row.t_s in target and row.t_s <= lasted_s]
    return Endurance(
        lasted_s, emptied_s is not None, levels, _off_circle(pairs, scenario.radius_m), _laps(pairs), drains
    )


def _off_circle(pairs: Sequence[tuple[Row, Row]], radius_m: float) -> list[tuple[float, float]]:
    arrived_s = math.inf
    off = []
    for robot, target in pairs:
        off_m = abs(math.hypot(robot.x_m - target.x_m, robot.y_m - target.y_m) - radius_m)
        if arrived_s == math.inf and off_m <= ARRIVED_SHARE * radius_m:
            arrived_s = robot.t_s
        if robot.t_s >= arrived_s + SETTLING_S:
            off.append((robot.t_s, off_m))
    return off


def _laps(pairs: Sequence[tuple[Row, Row]]) -> float:
    """Return how often a robot went round, clockwise."""
    bearings = [math.atan2(robot.y_m - target.y_m, robot.x_m - target.x_m) for robot, target in pairs]
    turned_rad = sum(math.remainder(later - earlier, math.tau) for earlier, later in pairwise(bearings))
    return -turned_rad / math.tau


def share_of(values: Sequence[float], share: float) -> float:
    """Return the value that the given share of values does not exceed."""
    ordered = sorted(values)
    return ordered[min(math.ceil(share * len(ordered)), len(ordered)) - 1]


def _drains(path: Path) -> list[tuple[str, Drain]]:
    return [_drain(path, number, cells) for number, cells in read_lines(path, csv.DictReader)]


def _drain(path: Path, number: int, cells: Mapping[str, Any]) -> tuple[str, Drain]:
    try:
        energy_j = {kind: float(cells[f"{kind}_j"]) for kind in KINDS}
        return cells["name"], Drain(float(cells["t_s"]), energy_j)
    except (KeyError, TypeError, ValueError) as error:
        raise PancakesError(f"{path}: row {number} is not a row of a consumption: {error}") from None
