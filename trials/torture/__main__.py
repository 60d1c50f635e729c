"""`scripts/torture`: try hard to make agents, tasks and missions fail, and print figures."""

from __future__ import annotations

import os
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

import click
from cli.processes import Rig
from harness.ending import interruptible
from harness.report import json_option, spread, write
from torture.fuzz import fuzz as fuzz_agent
from torture.fuzz import unsound
from torture.gate_command import gate
from torture.goals_command import goals
from torture.live_commands import cuts, gap, kills
from torture.load_commands import load
from torture.missions import FIGURES, figures_of, fly_all
from torture.safety_commands import collisions, halts
from torture.schedules import run_schedule, run_schedules
from torture.standstill_command import standstill
from torture.storm_command import storms
from torture.takeover_command import takeovers

from pancakes.util.plugins import Plugins, UnknownPluginError


@click.group()
@click.pass_context
def torture(context: click.Context) -> None:
    """Try hard to make Pancakes fail."""
    context.with_resource(interruptible())


@torture.command()
@click.option("--demo", default="encirclement", show_default=True, help="The mission to run.")
@click.option("--seeds", default=200, show_default=True, type=click.IntRange(1), help="Number of missions.")
@click.option("--first", default=1, show_default=True, type=click.IntRange(0), help="The first seed.")
@click.option(
    "--jobs", default=os.cpu_count() or 1, show_default=True, type=click.IntRange(1), help="How many at once."
)
@click.option("--faults/--no-faults", default=True, show_default=True, help="Latency, jitter and broken links.")
@click.option(
    "--batteries", is_flag=True, help="Draw agent 1's battery, too: then it migrates its task anywhere on the circle."
)
@json_option
def missions(
    demo: str, seeds: int, first: int, jobs: int, faults: bool, batteries: bool, json_file: Path | None
) -> None:
    """Run whole missions in virtual time, one per seed; the exit code is 0 only if all of them PASS."""
    try:
        Plugins().get("pancakes.demos", demo)
    except UnknownPluginError as error:
        raise click.BadParameter(str(error), param_hint="--demo") from None
    failed: dict[int, list[str]] = {}
    figures: dict[str, list[float]] = {}
    began_s = time.monotonic()
    for outcome in fly_all(demo, range(first, first + seeds), faults, batteries, jobs):
        for key, value in figures_of(outcome).items():
            figures.setdefault(key, []).append(value)
        summary = outcome.summary
        if summary["verdict"] != "PASS":
            failed[outcome.job.seed] = summary["reasons"]
            print(f"seed {outcome.job.seed}: {summary['verdict']}: {'; '.join(summary['reasons'])}", flush=True)
    for name, unit, key in FIGURES:
        if found := sorted(figures.get(key, ())):
            middle = found[len(found) // 2]
            print(f"{name}: {found[0]:.3f} to {found[-1]:.3f} {unit}, median {middle:.3f} {unit}")
    print(f"{seeds} missions of {demo}, in {time.monotonic() - began_s:.0f} s")
    print(f"{seeds - len(failed)} passed, {len(failed)} failed")
    write(
        json_file,
        {"missions": seeds, "failed": failed} | {key: spread(figures.get(key, ())) for _, _, key in FIGURES},
    )
    sys.exit(1 if failed else 0)


@torture.command()
@click.option("--frames", default=10_000_000, show_default=True, type=click.IntRange(1), help="Number of frames.")
@click.option("--ended", default=100_000, show_default=True, type=click.IntRange(1), help="Links that must end.")
@click.option("--seed", default=1, show_default=True, help="Seed of the frames.")
@json_option
def fuzz(frames: int, ended: int, seed: int, json_file: Path | None) -> None:
    """Send a live agent frames that are nearly valid, as a member of its fleet, over TLS, after a valid hello.

    The exit code is 0 only if the agent survives, logs no defect, and its memory grows by at most 32 MiB.
    """
    began_s = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="pancakes-fuzz-") as directory:
        rig = Rig(Path(directory))
        try:
            found = fuzz_agent(rig, frames, ended, seed)
        finally:
            rig.close()
    wrong = unsound(found)
    for sentence in wrong[:20]:
        print(sentence)
    print(f"{found.frames} frames, {found.ended} links ended, in {time.monotonic() - began_s:.0f} s")
    print(f"memory: {found.grown_mib:+.1f} MiB; {len(wrong)} faults")
    write(json_file, {"frames": found.frames, "ended": found.ended, "grown_mib": found.grown_mib, "wrong": wrong})
    sys.exit(1 if wrong else 0)


@torture.command()
@click.option("--seeds", default=10_000, show_default=True, type=click.IntRange(1), help="Number of schedules.")
@click.option("--first", default=1, show_default=True, type=click.IntRange(0), help="The first seed.")
@click.option(
    "--jobs", default=os.cpu_count() or 1, show_default=True, type=click.IntRange(1), help="How many at once."
)
@click.option("--trace", is_flag=True, help="Print what happens, a line for each event.")
@json_option
def schedules(seeds: int, first: int, jobs: int, trace: bool, json_file: Path | None) -> None:
    """Run fault schedules of virtual agents with migrating tasks: each task runs at most once, and once at the end.

    A seed that fails does exactly the same again with --first SEED --seeds 1 --trace, which prints what happens.
    The exit code is 0 only if none fails.
    """
    began_s = time.monotonic()
    violations: dict[int, str] = {}
    counts: Counter[str] = Counter()
    healed_s: list[float] = []
    todo = range(first, first + seeds)
    outcomes = (run_schedule(seed, print) for seed in todo) if trace else run_schedules(todo, jobs)
    for outcome in outcomes:
        counts += outcome.counts
        healed_s.append(outcome.healed_s)
        if outcome.violation:
            violations[outcome.seed] = outcome.violation
            print(f"seed {outcome.seed}: VIOLATION: {outcome.violation}", flush=True)
        if len(healed_s) % 1000 == 0:
            print(
                f"{len(healed_s)} schedules, {len(violations)} violations, {time.monotonic() - began_s:.0f} s",
                flush=True,
            )
    healed_s.sort()
    for name, key in COUNTED:
        print(f"{name}: {counts[key]}")
    print(f"healed within: {healed_s[-1]:.2f} s, median {healed_s[len(healed_s) // 2]:.2f} s (virtual time)")
    print(f"{seeds} schedules from seed {first}, in {time.monotonic() - began_s:.0f} s")
    print(f"{len(violations)} violations")
    write(
        json_file,
        {
            "schedules": seeds,
            "violations": violations,
            "counts": {key: counts[key] for _, key in COUNTED},
            "healed_s": spread(healed_s),
            "wall_s": time.monotonic() - began_s,
        },
    )
    sys.exit(1 if violations else 0)


COUNTED = (
    ("agents killed", "kill"),
    ("links broken", "break"),
    ("partitions", "partition"),
    ("moves asked for", "migrate"),
    ("hand-overs ended", "moved"),
    ("other commands", "command"),
    ("hand-over packets", "packet"),
    ("of these lost", "lost"),
    ("of these doubled", "doubled"),
    ("of these late and out of order", "late"),
    ("copies started", "start"),
    ("packets from task to task", "note"),
)
"""The figures of fault schedules: their names for people, and their keys in `Outcome.counts`."""


for live in (kills, cuts, gap, gate, load, standstill, storms, takeovers, collisions, halts, goals):
    torture.add_command(live)


if __name__ == "__main__":
    torture(prog_name="scripts/torture")
