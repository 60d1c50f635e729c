"""Run whole missions in virtual time, one per seed and many at once, and summarize them."""

from __future__ import annotations

import multiprocessing
import random
import tempfile
import threading
import time
import tomllib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from pancakes.tools.demo.conductor import Mission
from pancakes.tools.demo.launcher import NetworkFaults, find_configs, fresh, judge, make_plan, run_of, run_virtual
from pancakes.util.plugins import Plugins

BATTERY = "task.World.settings.robots.agent1.battery.capacity_j"
LEAST_SHARE, MOST_SHARE = 0.90, 1.12
"""Levels of agent 1's battery with which the migration falls anywhere on the circle."""


class Job(NamedTuple):
    """One mission: the demo, the seed, the folder, and its difficulties.

    Attributes:
        faults: whether the network has latency, jitter and links that break.
        batteries: whether the seed draws agent 1's battery, and so the place of the migration on the circle.
    """

    demo: str
    seed: int
    out: Path
    faults: bool = True
    batteries: bool = False


class Outcome(NamedTuple):
    """The result of a mission: its summary, and how long it took on this machine."""

    job: Job
    summary: dict[str, Any]
    wall_s: float


def fly(job: Job) -> Outcome:
    """Run one mission in virtual time, and judge it. A mission that raises fails, with the error as its reason."""
    began_s = time.monotonic()
    try:
        demo = Plugins().get("pancakes.demos", job.demo)
        folder = find_configs(demo)
        sets = (_battery(folder, job.seed),) if job.batteries else ()
        plan = make_plan(demo, folder, job.out, job.seed, 1.0, demo.duration_s, sets, live=False)
        fresh(job.out)
        mission = Mission(demo.agents, demo.duration_s)
        timing = run_virtual(plan, mission, threading.Event(), NetworkFaults(job.seed) if job.faults else None)
        summary = judge(plan, run_of(plan, mission), timing)
    except Exception as error:  # an error is a finding, and the other missions must run
        summary = {"verdict": "FAIL", "reasons": [f"{type(error).__name__}: {error}"]}
    return Outcome(job, summary, time.monotonic() - began_s)


def _battery(folder: Path, seed: int) -> str:
    """Draw the level of agent 1's battery; return it as a change of the world's configuration."""
    found: Any = tomllib.loads((folder / "world.toml").read_text(encoding="utf-8"))
    for key in BATTERY.split("."):
        found = found[key]
    drawn = found * random.Random(f"battery/{seed}").uniform(LEAST_SHARE, MOST_SHARE)
    return f"world:{BATTERY}={drawn:.1f}"


def fly_all(demo: str, seeds: Sequence[int], faults: bool, batteries: bool, jobs: int) -> Iterator[Outcome]:
    """Run a mission for each seed, several at once, and yield their results as they end."""
    with tempfile.TemporaryDirectory(prefix="pancakes-torture-") as folder:
        todo = [Job(demo, seed, Path(folder) / str(seed), faults, batteries) for seed in seeds]
        with multiprocessing.get_context("spawn").Pool(jobs) as pool:
            yield from pool.imap_unordered(fly, todo)


FIGURES = (
    ("gap in control", "s", "gap_s"),
    ("hand-over", "s", "handed_over_s"),
    ("radius error, mean", "m", "radius_error_m"),
    ("home error", "m", "home_error_m"),
    ("wall time of a mission", "s", "wall_s"),
)
"""The figures of all missions: the name, the unit and the key in `figures_of`."""


def figures_of(outcome: Outcome) -> dict[str, float]:
    """Return the figures of one mission that its demo has; of several robots, the worst."""
    summary = outcome.summary
    found = {
        "wall_s": outcome.wall_s,
        "gap_s": summary.get("gap_s"),
        "home_error_m": summary.get("home_error_m"),
        "handed_over_s": summary["holders"][0]["end_s"] if len(summary.get("holders", ())) > 1 else None,
        "radius_error_m": _worst_mean(summary.get("radius_error_m")),
    }
    return {key: value for key, value in found.items() if value is not None}


def _worst_mean(errors: Any) -> float | None:
    if not isinstance(errors, dict):
        return None
    if "mean" in errors:
        return float(errors["mean"])
    return max((float(error["mean"]) for error in errors.values() if error), default=None)
