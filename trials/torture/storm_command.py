"""The command `scripts/torture storms`."""

from __future__ import annotations

import os
import sys
import time
from collections import Counter
from pathlib import Path
from typing import Final

import click
from harness.report import json_option, write
from torture.storms import run_storms

SOUND: Final = 0.01
"""How wrong the clocks of agents may be: far more than a quartz."""
UNSOUND: Final = 0.1
"""How wrong they may not be: then two agents can act, and this must be found; it tests the test."""
CAUGHT_WITHIN: Final = 1000
"""In one of this many storms with such wrong clocks, two agents act."""


@click.command()
@click.option("--seeds", default=10_000, show_default=True, type=click.IntRange(1), help="Number of storms.")
@click.option("--first", default=1, show_default=True, type=click.IntRange(0), help="The first seed.")
@click.option(
    "--jobs", default=os.cpu_count() or 1, show_default=True, type=click.IntRange(1), help="How many at once."
)
@json_option
def storms(seeds: int, first: int, jobs: int, json_file: Path | None) -> None:
    """Run storms of guarded tasks in virtual time: two agents never act at once, and at the end one acts.

    The clock of each agent runs at its own rate, within 1 % of the true one. Then the same with 10 %, which is more
    than leases allow for: this must be caught. A seed does exactly the same again. The exit code is 0 only if no storm
    with 1 % has a violation, and two agents act in one storm with 10 %.
    """
    began_s = time.monotonic()
    violations: dict[int, str] = {}
    counts: Counter[str] = Counter()
    for number, end in enumerate(run_storms(range(first, first + seeds), SOUND, jobs), 1):
        counts += end.counts
        if end.violation:
            violations[end.seed] = end.violation
            print(f"seed {end.seed}: VIOLATION: {end.violation}", flush=True)
        if number % 500 == 0:
            print(f"{number} storms, {len(violations)} violations, {time.monotonic() - began_s:.0f} s", flush=True)
    print(", ".join(f"{count} {name}" for name, count in sorted(counts.items())))
    print(f"{seeds} storms from seed {first}, clocks ±{SOUND:.0%}: {len(violations)} violations")
    caught = first_caught(range(first, first + CAUGHT_WITHIN), jobs)
    print(f"clocks ±{UNSOUND:.0%}: " + (f"two act in seed {caught}" if caught is not None else "NOT CAUGHT"))
    wall_s = time.monotonic() - began_s
    print(f"in {wall_s:.0f} s")
    write(
        json_file,
        {"storms": seeds, "violations": violations, "counts": counts, "caught": caught, "wall_s": wall_s},
    )
    sys.exit(1 if violations or caught is None else 0)


def first_caught(seeds: range, jobs: int) -> int | None:
    """Return a seed in which two agents act because clocks are too wrong; None: no such seed was found."""
    return next((end.seed for end in run_storms(seeds, UNSOUND, jobs) if end.two), None)
