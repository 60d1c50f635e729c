"""The command `scripts/torture takeovers`."""

from __future__ import annotations

import sys
import tempfile
import time
from contextlib import nullcontext
from pathlib import Path

import click
from harness.report import json_option, write
from torture.guarded_faults import Takeovers
from torture.strokes import KINDS
from torture.takeover_tally import TakeoverTally


@click.command()
@click.option("--faults", default=1000, show_default=True, type=click.IntRange(1), help="Number of faults.")
@click.option("--fleets", default=4, show_default=True, type=click.IntRange(1), help="Number of parallel fleets.")
@click.option("--seed", default=1, show_default=True, help="Seed of the faults.")
@click.option(
    "--resume",
    type=click.Path(file_okay=False, path_type=Path),
    metavar="DIR",
    help="Save the tally in this directory after each case; an interrupted run continues from it.",
)
@click.option("--only", multiple=True, type=click.Choice(KINDS), help="Only faults of this kind; may be repeated.")
@click.option("--calm", is_flag=True, help="Make one fault at a time, to measure the duration of take-overs.")
@json_option
def takeovers(
    faults: int,
    fleets: int,
    seed: int,
    resume: Path | None,
    only: tuple[str, ...],
    calm: bool,
    json_file: Path | None,
) -> None:
    """Strike real agents that guard a task with all kinds of faults: two never act at once, and then one continues.

    A fleet has four agents; half of the faults come during hand-offs and take-overs. The exit code is 0 only if no two
    acts had a passed epoch, at most one act was late for each stop of each thread, each packet to the task had its
    effect exactly once, the task never stayed paused, and each kind of fault occurred.
    """
    began_s = time.monotonic()
    kinds = only or KINDS

    def told(tally: TakeoverTally) -> None:
        line = f"{tally.faults.total()} faults, {tally.late} late, {tally.doubled} doubled"
        line += f", {len(tally.wrong)} packets wrong, {len(tally.standstills)} standstills"
        print(f"{line}, {time.monotonic() - began_s:.0f} s", flush=True)

    if resume is not None:
        resume.mkdir(parents=True, exist_ok=True)
    with nullcontext(str(resume)) if resume else tempfile.TemporaryDirectory(prefix="pancakes-takeovers-") as kept:
        tally = Takeovers(Path(kept), seed, calm=calm, kinds=kinds, told=told).run(faults, fleets)
    for line in tally.told():
        print(line)
    wall_s = time.monotonic() - began_s
    print(f"in {wall_s:.0f} s")
    failures = tally.failures(kinds)
    for sentence in failures:
        print(f"FAILS: {sentence}")
    write(json_file, tally.figures() | {"failures": failures, "wall_s": wall_s})
    sys.exit(1 if failures else 0)
