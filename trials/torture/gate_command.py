"""The command of `scripts/torture` that measures late acts: what still passes the gate of a guarded task."""

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
@click.option("--stops", default=100, show_default=True, type=click.IntRange(1), help="Number of stops, in all.")
@click.option("--fleets", default=2, show_default=True, type=click.IntRange(1), help="Number of parallel fleets.")
@click.option("--seed", default=1, show_default=True, help="Seed of the moments.")
@json_option
def gate(stops: int, fleets: int, seed: int, json_file: Path | None) -> None:
    """Stop the owner of a guarded task for longer than its lease, at random moments, and let it continue.

    The exit code is 0 only if at most one command, one send and one checkpoint came late after each stop.
    """
    began_s = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="pancakes-gate-") as directory:
        tally = run_late_acts(Path(directory), -(-stops // fleets), fleets, seed)
    print(f"{tally.told()}; {time.monotonic() - began_s:.0f} s")
    write(json_file, {**dataclasses.asdict(tally), "most": tally.most})
    sys.exit(0 if tally.most <= 1 else 1)
