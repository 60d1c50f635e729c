"""Many missions, each with faults of its own; prints figures. Run by `scripts/torture`."""

from __future__ import annotations

import multiprocessing
import os
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import NamedTuple

import click

from pancakes.demo.conductor import Mission
from pancakes.demo.launcher import Faults, fresh, judge, run_of, run_virtual
from pancakes.demo.plan import find_configs, make_plan
from pancakes.plugins import Plugins


class Job(NamedTuple):
    """One mission: the demo, the seed, whether the network has faults, and where its files go."""

    demo: str
    seed: int
    faults: bool
    out: Path


class Outcome(NamedTuple):
    """How it went."""

    job: Job
    verdict: str
    reasons: list[str]
    gap_s: float | None
    wall_s: float


def fly(job: Job) -> Outcome:
    """Runs one mission in virtual time, and judges it."""
    began_s = time.monotonic()
    demo = Plugins().get("pancakes.demos", job.demo)
    plan = make_plan(demo, find_configs(job.demo, ""), job.out, job.seed, 1.0, demo.duration_s, (), live=False)
    fresh(job.out)
    mission = Mission(demo.agents, demo.duration_s)
    timing = run_virtual(plan, mission, threading.Event(), Faults(job.seed) if job.faults else None)
    summary = judge(plan, run_of(plan, mission), timing)
    return Outcome(job, summary["verdict"], summary["reasons"], summary.get("gap_s"), time.monotonic() - began_s)


@click.group()
def torture() -> None:
    """Try hard to make it fail."""


@torture.command()
@click.option("--demo", default="encirclement", show_default=True)
@click.option("--seeds", default=200, show_default=True, type=click.IntRange(1), help="How many missions.")
@click.option("--first", default=1, show_default=True, type=click.IntRange(0), help="The first seed.")
@click.option("--jobs", default=os.cpu_count() or 1, show_default=True, type=click.IntRange(1), help="How many at once.")
@click.option("--faults/--no-faults", default=True, show_default=True, help="Latency, jitter and broken links.")
def missions(demo: str, seeds: int, first: int, jobs: int, faults: bool) -> None:
    """Whole missions in virtual time, a seed each; exit code 0 only where all of them PASS."""
    with tempfile.TemporaryDirectory(prefix="pancakes-torture-") as folder:
        todo = [Job(demo, seed, faults, Path(folder) / str(seed)) for seed in range(first, first + seeds)]
        failed: list[Outcome] = []
        gaps_s: list[float] = []
        began_s = time.monotonic()
        with multiprocessing.get_context("spawn").Pool(jobs) as pool:
            for outcome in pool.imap_unordered(fly, todo):
                if outcome.gap_s is not None:
                    gaps_s.append(outcome.gap_s)
                if outcome.verdict != "PASS":
                    failed.append(outcome)
                    print(f"seed {outcome.job.seed}: {outcome.verdict}: {'; '.join(outcome.reasons)}", flush=True)
    passed = seeds - len(failed)
    gaps_s.sort()
    if gaps_s:
        print(f"gap in control: median {gaps_s[len(gaps_s) // 2]:.3f} s, longest {gaps_s[-1]:.3f} s of mission time")
    print(f"{seeds} missions in {time.monotonic() - began_s:.0f} s")
    print(f"{passed} passed, {len(failed)} failed")
    sys.exit(1 if failed else 0)


if __name__ == "__main__":
    torture()
