"""The command of `scripts/torture` that measures what still gets past the gate of a guarded task."""

from __future__ import annotations

import dataclasses
import sys
import tempfile
import time
from pathlib import Path

import click
from harness.report import json_option, write
from torture.late_acts import run_late_acts


@click.command()
@click.option("--stops", default=100, show_default=True, type=click.IntRange(1), help="How many stops, in all.")
@click.option("--fleets", default=2, show_default=True, type=click.IntRange(1), help="How many fleets at once.")
@click.option("--seed", default=1, show_default=True, help="Draws the moments.")
@json_option
def gate(stops: int, fleets: int, seed: int, json_file: Path | None) -> None:
    """The owner of a guarded task is stopped for longer than its lease, at any moment, and goes on.

    Exit code 0 only where after each stop one command, one send and one checkpoint at most came late.
    """
    began_s = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="pancakes-gate-") as directory:
        tally = run_late_acts(Path(directory), -(-stops // fleets), fleets, seed)
    print(f"{tally.told()}; {time.monotonic() - began_s:.0f} s")
    write(json_file, {**dataclasses.asdict(tally), "most": tally.most})
    sys.exit(0 if tally.most <= 1 else 1)
