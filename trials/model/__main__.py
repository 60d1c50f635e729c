"""Searches the core of migration, its join with a life, and guarded tasks, and shows that it would see a broken rule.

`scripts/check-migration` runs it. All there is to know about the fault models stands in `model.search`,
`model.hosting_search` and `model.guarded_search`.
"""

from __future__ import annotations

import json
import multiprocessing
import os
import sys
import time
from pathlib import Path
from typing import Any

import click
from model import guarded_scenarios, hosting_scenarios
from model.bounds import DEEP, SUITE
from model.guarded_mutants import MUTANTS as GUARDED_MUTANTS
from model.hosting_convictions import CONVICTED_IN
from model.jobs import AnyJob, GuardedJob, Job, JoinedJob, Report, carry_out
from model.mutants import MUTANTS


def tell(report: Report, traces: bool) -> None:
    """Prints what came of one search."""
    result, name = report.result, report.job.name
    if result is None:
        print(f"  ERROR      {name}: {report.fault}", flush=True)
        return
    if report.job.mutant:
        verdict = "convicted " if result.violation else "ESCAPED   "
        tale = f"after {len(result.trace)} steps: {result.violation}" if result.violation else f"in {report.job.bounds}"
        print(f"  {verdict} {name}, {tale}", flush=True)
    else:
        verdict = "VIOLATION " if result.violation else "ok        " if result.complete else "UNFINISHED"
        figures = f"{result.states:>10,} states {result.transitions:>11,} transitions {report.wall_s:6.1f} s"
        print(f"  {verdict} {name:<68} {figures}", flush=True)
    if traces or (not report.job.mutant and result.violation):
        for number, sentence in enumerate(report.trace, 1):
            print(f"      {number:2}. {sentence}", flush=True)


COVERED = {
    "take-over": "taken over",
    "hand-off": "COMMITTED",
    "replaced": "the new guardians are in use",
    "lost disk": "loses its disk",
    "stop": "a stop is answered",
    "adopt": "adopted",
    "overtaken": "an offer is overtaken",
    "goodbye": "a lease ends at a goodbye",
    "packet": "a packet is acknowledged",
}


def tell_covered(reports: list[Report]) -> None:
    """Prints which scenario of guarded tasks came to what."""
    rows = [(r.job.name, r.result.reached) for r in reports if r.result is not None and r.result.reached]
    if not rows:
        return
    print("\nwhat the scenarios of guarded tasks came to:")
    print(f"  {'':<44}{'  '.join(COVERED)}")
    for name, reached in rows:
        marks = ("x" if any(part in it for it in reached) else "." for part in COVERED.values())
        print(f"  {name:<44}{'  '.join(f'{mark:<{len(word)}}' for mark, word in zip(marks, COVERED, strict=True))}")


def as_json(reports: list[Report]) -> dict[str, Any]:
    """Returns the figures for `--json`."""
    searches = [(r.job, r.result, r) for r in reports if not r.job.mutant and r.result is not None]
    return {
        "states": sum(result.states for _, result, _ in searches),
        "transitions": sum(result.transitions for _, result, _ in searches),
        "violations": sum(1 for _, result, _ in searches if result.violation),
        "mutants": [{"name": r.job.mutant, "convicted": r.good, "trace": r.trace} for r in reports if r.job.mutant],
        "bounds": [
            {
                "name": job.name,
                "states": result.states,
                "transitions": result.transitions,
                "complete": result.complete,
                "reached": list(result.reached),
                "trace": r.trace,
            }
            for job, result, r in searches
        ],
    }


def choose(deep: bool, mutants: bool, only: str) -> list[AnyJob]:
    """Returns the searches to make.

    Raises:
        click.BadParameter: `only` names none of them.
    """
    jobs: list[AnyJob] = []
    if not mutants:
        jobs += [Job(bounds) for bounds in (*SUITE, *(DEEP if deep else ()))]
        jobs += [
            JoinedJob(scenario) for scenario in (*hosting_scenarios.SUITE, *(hosting_scenarios.DEEP if deep else ()))
        ]
        guarded = (*guarded_scenarios.SUITE, *(guarded_scenarios.DEEP if deep else ()))
        jobs += [GuardedJob(scenario) for scenario in guarded]
    jobs += [Job(mutant.bounds, mutant.name) for mutant in MUTANTS]
    jobs += [JoinedJob.of(mutant) for mutant in CONVICTED_IN]
    jobs += [GuardedJob(mutant.scenario.title, mutant.name) for mutant in GUARDED_MUTANTS]
    chosen = [job for job in jobs if only in job.name]
    if not chosen:
        names = "".join(f"\n  {job.name}" for job in jobs)
        raise click.BadParameter(f"none of these has {only!r} in its name:{names}", param_hint="--only")
    exact = [job for job in chosen if job.name == only]
    return exact or chosen


def run(jobs: list[AnyJob], processes: int) -> list[Report]:
    """Makes the searches, several at once, and prints each as soon as it and those before it are done."""
    told = ""
    reports: list[Report] = []
    # A process each, so that the memory of a large search is given back.
    with multiprocessing.get_context("spawn").Pool(min(processes, len(jobs)), maxtasksperchild=8) as pool:
        for report in pool.imap(carry_out, jobs):
            if report.job.heading != told:
                told = report.job.heading
                print(told, flush=True)
            tell(report, traces=bool(report.job.mutant))
            reports.append(report)
    return reports


@click.command()
@click.option("--deep", is_flag=True, help="Larger bounds too: minutes, and up to 2 GB of memory for each job.")
@click.option("--mutants", is_flag=True, help="Only the broken variants.")
@click.option("--only", default="", metavar="NAME", help="Only what is named so, or has this in its name.")
@click.option(
    "--jobs", default=os.cpu_count() or 1, show_default=True, type=click.IntRange(1), help="How many at once."
)
@click.option("--json", "json_file", type=click.Path(dir_okay=False, path_type=Path), help="Write the figures there.")
def check_migration(deep: bool, mutants: bool, only: str, jobs: int, json_file: Path | None) -> None:
    """Search the core of migration, its join with a life, and guarded tasks exhaustively, and convict broken variants.

    Every message may be lost, doubled, delayed and overtaken, every agent may crash between any two steps, every
    timer may fire at any time. The exit code is 0 only where no promise is broken and every variant is convicted.
    """
    began_s = time.monotonic()
    reports = run(choose(deep, mutants, only), jobs)
    tell_covered(reports)
    figures = as_json(reports)
    if json_file is not None:
        json_file.write_text(json.dumps(figures, indent=2) + "\n", encoding="utf-8")
    print()
    if figures["bounds"]:
        print(
            f"{figures['states']:,} states, {figures['transitions']:,} transitions, {figures['violations']} violations"
        )
    if figures["mutants"]:
        convicted = sum(mutant["convicted"] for mutant in figures["mutants"])
        print(f"{convicted} of {len(figures['mutants'])} broken variants convicted")
    print(f"{time.monotonic() - began_s:.0f} s")
    sys.exit(0 if all(report.good for report in reports) else 1)


if __name__ == "__main__":
    check_migration()
