"""A mission that has been flown, read back with nothing but the formats that it promises.

The judge of a demo has code of its own for all this; none of it is used here, so that the two check each other.
"""

from __future__ import annotations

import csv
import json
import math
import threading
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

from pancakes.tools.demo import Loss
from pancakes.tools.demo.conductor import Mission
from pancakes.tools.demo.launcher import NetworkFaults, find_configs, fresh, judge, make_plan, run_of, run_virtual
from pancakes.util.plugins import Plugins

HEADER = ["t_s", "name", "x_m", "y_m", "theta_rad", "v_mps", "omega_radps", "battery_v", "driven_by"]
SCAN = "ScanTarget"
Point = tuple[float, float]


@dataclass(frozen=True)
class Moment:
    """A row of `trajectory.csv`."""

    t_s: float
    name: str
    x_m: float
    y_m: float
    theta_rad: float
    v_mps: float
    omega_radps: float
    battery_v: float | None
    driven_by: str

    @property
    def place(self) -> Point:
        return self.x_m, self.y_m


@dataclass(frozen=True)
class Flight:
    """One mission's results: the files, and what this file alone makes of them."""

    out: Path
    summary: dict[str, Any]
    timing: dict[str, Any]
    events: list[dict[str, Any]]
    paths: dict[str, list[Moment]]

    def told(self, kind: str, agent: str = "", **fields: Any) -> list[dict[str, Any]]:
        """Returns the events of a kind."""
        return [
            event
            for event in self.events
            if event["kind"] == kind
            and agent in ("", event["agent"])
            and all(event.get(key) == value for key, value in fields.items())
        ]

    def driven(self, robot: str, task: str) -> list[Moment]:
        """Returns the moments in which a robot's wheels followed a task."""
        return [moment for moment in self.paths[robot] if moment.driven_by == task]

    def scanned(self, robot: str) -> list[Moment]:
        """Returns the path of a robot from the first to the last moment in which `ScanTarget` drove it."""
        driven = self.driven(robot, SCAN)
        return [moment for moment in self.paths[robot] if driven[0].t_s <= moment.t_s <= driven[-1].t_s]

    def gap_s(self, old: str, new: str) -> float:
        """Returns the time between the last moment of the old holder and the first of the new."""
        return self.driven(new, SCAN)[0].t_s - self.driven(old, SCAN)[-1].t_s

    def both_drove(self, one: str, other: str) -> list[float]:
        """Returns the times at which `ScanTarget` drove two robots."""
        times = {moment.t_s for moment in self.driven(one, SCAN)}
        return [moment.t_s for moment in self.driven(other, SCAN) if moment.t_s in times]

    def radius_errors(self, robot: str, centre: Point, radius_m: float) -> list[float]:
        """Returns how far off the circle a robot was, from 30 s after it came within 10 % of its radius."""
        path = self.scanned(robot)
        off_m = [abs(math.dist(moment.place, centre) - radius_m) for moment in path]
        arrived_s = next(moment.t_s for moment, off in zip(path, off_m, strict=True) if off <= 0.1 * radius_m)
        return [off for moment, off in zip(path, off_m, strict=True) if moment.t_s >= arrived_s + 30.0]

    def clearance_m(self, one: str, other: str, radii_m: float) -> float:
        """Returns the least gap between the edges of two bodies, whose radii sum up to `radii_m`."""
        moments = zip(self.paths[one], self.paths[other], strict=True)
        return min(math.dist(mine.place, theirs.place) for mine, theirs in moments) - radii_m

    def way_m(self, name: str) -> float:
        """Returns how far a body went."""
        return sum(math.dist(one.place, next_one.place) for one, next_one in pairwise(self.paths[name]))


def read_flight(out: Path) -> Flight:
    """Reads what a mission left behind."""
    paths: dict[str, list[Moment]] = {}
    for moment in _moments(out / "trajectory.csv"):
        paths.setdefault(moment.name, []).append(moment)
    events = [json.loads(line) for line in (out / "events.jsonl").read_text(encoding="utf-8").splitlines()]
    summary = json.loads((out / "summary.json").read_text(encoding="utf-8"))
    timing = json.loads((out / "timing.json").read_text(encoding="utf-8"))
    return Flight(out, summary, timing, events, paths)


def _moments(path: Path) -> Iterator[Moment]:
    with path.open(encoding="utf-8", newline="") as file:
        rows = csv.reader(file)
        assert next(rows) == HEADER
        for t_s, name, x_m, y_m, theta_rad, v_mps, omega_radps, battery_v, driven_by in rows:
            moment = Moment(
                float(t_s),
                name,
                float(x_m),
                float(y_m),
                float(theta_rad),
                float(v_mps),
                float(omega_radps),
                float(battery_v) if battery_v else None,
                driven_by,
            )
            numbers = (moment.x_m, moment.y_m, moment.theta_rad, moment.v_mps, moment.omega_radps)
            assert all(math.isfinite(number) for number in numbers)
            yield moment


def fly(
    demo_name: str,
    seed: int,
    out: Path,
    faults: bool,
    sets: Sequence[str] = (),
    duration_s: float | None = None,
    loss: Loss | None = None,
) -> Flight:
    """Runs a mission in virtual time, judges it, and reads it back.

    Args:
        demo_name: the demo.
        seed: the seed of the run.
        out: the folder for its results.
        faults: whether the network has latency, jitter and links that break.
        sets: changes of the configurations, as `--set` takes them.
        duration_s: how long it lasts; None: as long as the demo says.
        loss: replaces the loss that the demo has.
    """
    demo = Plugins().get("pancakes.demos", demo_name)
    if loss is not None:
        demo = replace(demo, loss=loss)
    length_s = demo.duration_s if duration_s is None else duration_s
    plan = make_plan(demo, find_configs(demo), out, seed, 1.0, length_s, tuple(sets), live=False)
    fresh(out)
    mission = Mission(demo.agents, length_s)
    timing = run_virtual(plan, mission, threading.Event(), NetworkFaults(seed) if faults else None)
    judge(plan, run_of(plan, mission), timing)
    return read_flight(out)
