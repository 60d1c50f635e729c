"""`pancakes demo NAME --seeds`: run many missions in virtual time, and summarise their results."""

from __future__ import annotations

import os
import shlex
import sys
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import click

from pancakes.tools.cli import agent_process
from pancakes.tools.cli.output import Printer, show_text
from pancakes.tools.cli.parent_death import die_with_parent

if TYPE_CHECKING:
    from pancakes.tools.demo import Comparison, Demo
    from pancakes.tools.demo.monte_carlo import MissionOutcome, MissionWishes
    from pancakes.util.plugins import Plugins

MOST_NAMED: Final = 10
"""At most this many missions that did not pass are printed with their reasons; `missions.json` has all."""


class Seeds(click.ParamType):
    """A range of seeds such as `1-200`, or several: `3,17,20-29`."""

    name = "range"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[int, ...]:
        from pancakes.tools.demo.seed_statistics import seeds_of

        if isinstance(value, tuple):
            return value
        try:
            return seeds_of(value)
        except ValueError as error:
            self.fail(str(error), param, ctx)


def run_seeds(
    found: Demo | Comparison,
    seeds: Sequence[int],
    out: Path,
    wishes: MissionWishes,
    jobs: int | None,
    plain: bool,
    printer: Printer,
    plugins: Plugins,
    interrupted: Callable[[], bool],
) -> tuple[bool, int]:
    """Run a demo with many seeds, and print the results.

    Args:
        found: the demo.
        seeds: the seeds.
        out: the folder for the results.
        wishes: the other options of the missions.
        jobs: how many processes run at once; None: one for each core that this process may use.
        plain: print a line for each mission instead of a progress bar.
        printer: prints the results.
        plugins: where drivers and tasks come from.
        interrupted: returns whether the run was interrupted.

    Returns:
        Whether all missions were run, and how many did not pass.

    Raises:
        PancakesError: the demo cannot be run at all, or its results cannot be written.
    """
    from pancakes.tools.demo.demo import Comparison
    from pancakes.tools.demo.launcher import fresh
    from pancakes.tools.demo.monte_carlo import PASSED, fly_many, plan_of

    # Report a fault of all missions once, before anything is written.
    plan_of(found.mission if isinstance(found, Comparison) else found, out, seeds[0], wishes, plugins)
    fresh(out, ("missions.json",))
    count = min(jobs or len(os.sched_getaffinity(0)), len(seeds))
    text = f"{found.title}: {len(seeds)} {_missions(len(seeds))}, {count} at once, results in {nice_path(out)}"
    printer.note(text)
    outcomes: list[MissionOutcome] = []
    failed = 0
    with _progress(len(seeds), plain) as report:
        missions = fly_many(seeds, out, wishes, count, interrupted, partial(_prepare, os.getpid()))
        for outcome in missions:
            outcomes.append(outcome)
            failed += outcome.verdict != PASSED
            report(outcome, failed)
    outcomes.sort(key=lambda outcome: outcome.seed)
    _show(outcomes, out, wishes, printer)
    if len(outcomes) < len(seeds):
        show_text(f"interrupted: {len(outcomes)} of {len(seeds)} missions were run", err=True)
    return len(outcomes) == len(seeds), failed


def _prepare(parent_pid: int) -> None:
    """Tune a worker process for agents, and tie its life to this process."""
    agent_process.tune_interpreter()
    die_with_parent(parent_pid)


def _missions(count: int) -> str:
    return "mission" if count == 1 else "missions"


def _progress(total: int, plain: bool) -> AbstractContextManager[Callable[[MissionOutcome, int], None]]:
    """Return the function that reports each outcome, with the number of failures so far."""
    if plain:
        return nullcontext(_report_line)
    if not sys.stderr.isatty():
        return nullcontext(lambda outcome, failed: None)
    return _Bar(total)


def _report_line(outcome: MissionOutcome, failed: int) -> None:
    why = f": {outcome.reasons[0]}" if outcome.reasons else ""
    show_text(f"seed {outcome.seed}: {outcome.verdict}{why}", err=True)


class _Bar(AbstractContextManager[Callable[..., None]]):
    """A progress bar: how many missions are over, how many of them failed, and the remaining time."""

    def __init__(self, total: int) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

        columns = (BarColumn(), MofNCompleteColumn(), TextColumn("{task.description}"), TimeRemainingColumn())
        self._progress = Progress(*columns, console=Console(stderr=True), transient=True)
        self._task = self._progress.add_task("none failed", total=total)

    def __enter__(self) -> Callable[[MissionOutcome, int], None]:
        self._progress.start()
        return self._report

    def _report(self, outcome: MissionOutcome, failed: int) -> None:
        self._progress.update(self._task, advance=1, description=f"{failed or 'none'} failed")

    def __exit__(self, *error: object) -> None:
        self._progress.stop()


def _show(outcomes: Sequence[MissionOutcome], out: Path, wishes: MissionWishes, printer: Printer) -> None:
    """Print the results of all missions, and write them to `missions.json`."""
    import json

    from pancakes.tools.demo.monte_carlo import PASSED
    from pancakes.tools.demo.seed_statistics import spreads_of, text_of_seeds

    verdicts: dict[str, list[int]] = {}
    for outcome in outcomes:
        verdicts.setdefault(outcome.verdict, []).append(outcome.seed)
    rows = [
        {"verdict": verdict, "missions": len(seeds), "seeds": text_of_seeds(seeds)}
        for verdict, seeds in sorted(verdicts.items(), key=lambda item: (item[0] != PASSED, item[0]))
    ]
    spreads = spreads_of(outcome.summary for outcome in outcomes)
    failed = [outcome for outcome in outcomes if outcome.verdict != PASSED]
    said = [f"seed {outcome.seed}: {text}" for outcome in outcomes for text in outcome.said]
    whole = {
        "demo": wishes.demo,
        "missions": len(outcomes),
        "verdicts": rows,
        "spreads": [asdict(spread) for spread in spreads],
        "failed": [
            {
                "seed": outcome.seed,
                "verdict": outcome.verdict,
                "reasons": list(outcome.reasons),
                "out": str(outcome.out),
                "again": again(outcome.seed, wishes),
            }
            for outcome in failed
        ],
        "said": said,
    }
    try:
        (out / "missions.json").write_text(json.dumps(whole, indent=2, allow_nan=False) + "\n", encoding="utf-8")
    except OSError as error:
        show_text(f"{out / 'missions.json'} cannot be written: {error.strerror}", err=True)
    for text in said:
        show_text(text, err=True)
    differing = [asdict(spread) for spread in spreads if spread.differs]
    lines = []
    for outcome in failed[:MOST_NAMED]:
        lines.append(f"seed {outcome.seed}: {outcome.verdict}")
        lines += [f"  - {reason}" for reason in outcome.reasons]
        lines.append(f"  run again: {again(outcome.seed, wishes)}")
    if len(failed) > MOST_NAMED:
        lines.append(f"{len(failed) - MOST_NAMED} more did not pass: {nice_path(out / 'missions.json')} lists all")
    printer.emit(whole, {"Verdicts": rows, "Spreads": differing}, *lines)


def nice_path(path: Path) -> str:
    """Return a path relative to the present folder if it is below it."""
    relative = os.path.relpath(path)
    return relative if not relative.startswith("..") else str(path)


def again(seed: int, wishes: MissionWishes) -> str:
    """Return the command that runs only this mission again."""
    words = ["pancakes", "demo", wishes.demo, "--virtual", "--seed", str(seed)]
    if wishes.duration_s is not None:
        words += ["--duration", f"{wishes.duration_s:g}"]
    if wishes.configs is not None:
        words += ["--configs", str(wishes.configs)]
    for one in wishes.sets:
        words += ["--set", one]
    words += ["--faults"] * wishes.faults + ["--record"] * wishes.record
    return shlex.join(words)
