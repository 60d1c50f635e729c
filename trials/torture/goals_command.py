"""The command `scripts/torture goals`."""

from __future__ import annotations

import os
import sys
import tempfile
import time
from pathlib import Path

import click
from harness.report import json_option, spread, write
from torture.goals import GoalTally, kill_agents


@click.command()
@click.option("--kills", default=100, show_default=True, type=click.IntRange(1), help="Number of kills.")
@click.option("--seed", default=1, show_default=True, help="Seed of the moments.")
@click.option("--domain", default=77, show_default=True, type=click.IntRange(1, 101), help="DDS domain to use.")
@json_option
def goals(kills: int, seed: int, domain: int, json_file: Path | None) -> None:
    """Kill the agent whose task has a goal at an action server of ROS 2: another one has it reached.

    One kill in five is a stop (SIGSTOP). The first run makes environments with two releases of ROS 2, as the tests do.
    The exit code is 0 only if each goal was reached once by another robot in time, and no robot drove on.
    """
    began_s = time.monotonic()

    def told(tally: GoalTally) -> None:
        print(
            f"{tally.kills.total()} kills, {len(tally.failures)} failures, {time.monotonic() - began_s:.0f} s",
            flush=True,
        )

    with tempfile.TemporaryDirectory(prefix="pancakes-run-") as runtime:
        os.environ["PANCAKES_RUNTIME_DIR"] = runtime
        tally = kill_agents(kills, domain, seed, told)
    figures = tally.figures() | {"wall_s": time.monotonic() - began_s}
    for name, values in (
        ("the robot that was left stood", tally.stood_s),
        ("the next one began", tally.began_s),
        ("it reached the goal, its way not counted,", tally.late_s),
    ):
        if values:
            found = spread(values)
            print(f"{name} after {found['least']:.2f} to {found['most']:.2f} s, median {found['median']:.2f} s")
    print(f"{tally.before} times the goal before was reached once more")
    for sentence in tally.failures:
        print(f"FAILS: {sentence}")
    write(json_file, figures | {"failures": tally.failures})
    sys.exit(1 if tally.failures else 0)
