"""Tries hard to make missions fail, and prints figures. Run by `scripts/torture`."""

from __future__ import annotations

import os
import sys
import time

import click
from torture.missions import FIGURES, figures_of, fly_all

from pancakes.plugins import Plugins, UnknownPlugin


@click.group()
def torture() -> None:
    """Try hard to make it fail."""


@torture.command()
@click.option("--demo", default="encirclement", show_default=True, help="Which mission.")
@click.option("--seeds", default=200, show_default=True, type=click.IntRange(1), help="How many missions.")
@click.option("--first", default=1, show_default=True, type=click.IntRange(0), help="The first seed.")
@click.option(
    "--jobs", default=os.cpu_count() or 1, show_default=True, type=click.IntRange(1), help="How many at once."
)
@click.option("--faults/--no-faults", default=True, show_default=True, help="Latency, jitter and broken links.")
def missions(demo: str, seeds: int, first: int, jobs: int, faults: bool) -> None:
    """Whole missions in virtual time, a seed each; exit code 0 only where all of them PASS."""
    try:
        Plugins().get("pancakes.demos", demo)
    except UnknownPlugin as error:
        raise click.BadParameter(str(error), param_hint="--demo") from None
    failed: list[int] = []
    figures: dict[str, list[float]] = {}
    began_s = time.monotonic()
    for outcome in fly_all(demo, range(first, first + seeds), faults, jobs):
        for key, value in figures_of(outcome).items():
            figures.setdefault(key, []).append(value)
        summary = outcome.summary
        if summary["verdict"] != "PASS":
            failed.append(outcome.job.seed)
            print(f"seed {outcome.job.seed}: {summary['verdict']}: {'; '.join(summary['reasons'])}", flush=True)
    for name, unit, key in FIGURES:
        if found := sorted(figures.get(key, ())):
            middle = found[len(found) // 2]
            print(f"{name}: {found[0]:.3f} to {found[-1]:.3f} {unit}, median {middle:.3f} {unit}")
    print(f"{seeds} missions of {demo}, in {time.monotonic() - began_s:.0f} s")
    print(f"{seeds - len(failed)} passed, {len(failed)} failed")
    sys.exit(1 if failed else 0)


if __name__ == "__main__":
    torture()
